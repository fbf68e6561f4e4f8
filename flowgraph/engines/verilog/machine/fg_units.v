// The units beside the first lane: quotients, roots, logarithms, angles, some of each kind, 4 at most.
//
// A unit is started with the number that was held before, and the next. The unit's number is its kind, and above that
// which of them. What it has made lies there a register after it is asked for, with a shift and a sign.
module fg_units #(
    parameter DIVIDES = 1,
    parameter ROOTS = 1,
    parameter LOGARITHMS = 1,
    parameter ANGLES = 1
) (
    input wire clk,
    input wire hold,
    input wire start,
    input wire [3:0] unit,
    input wire signed [65:0] x,
    input wire below,  // of a number brought to full length: its sign, and how long it was
    input wire [6:0] length,
    input wire [3:0] asked,
    output reg [65:0] made,
    output reg signed [7:0] by,
    output reg whole,  // it is not shifted
    output reg minus
);
  // verilator lint_off UNUSEDSIGNAL
  reg signed [65:0] held;  // not all of it where a unit is left out
  reg held_below;
  reg [6:0] held_length;
  wire [63:0] whole_x = x[63:0];
  wire unused = &{start, unit, below, length};
  // verilator lint_on UNUSEDSIGNAL
  always @(posedge clk)
    if (hold) begin
      held <= x;
      held_below <= below;
      held_length <= length;
    end

  // Each kind's results, four of each; what is not there is zero.
  wire [66*4-1:0] quotients, roots, logarithms, angles;
  wire [8*4-1:0] quotients_by, roots_by;
  wire [3:0] quotients_none, quotients_minus;
  genvar n;
  generate
    for (n = 0; n < 4; n = n + 1) begin : each
      if (n < DIVIDES) begin : divides
        reg minus_;
        reg [7:0] by_;
        wire mine = start && unit == {n[1:0], 2'd0};
        always @(posedge clk)
          if (mine) begin
            minus_ <= held_below ^ below;
            by_ <= {1'b0, length} - {1'b0, held_length};
          end
        assign quotients_minus[n] = minus_;
        assign quotients_by[n*8+:8] = by_;
        fg_divide divide (.clk(clk), .start(mine), .over(held[61:0]), .under(x[30:0]), .value(quotients[n*66+:66]), .none(quotients_none[n]));
      end else begin : no_divides
        assign quotients[n*66+:66] = 66'd0;
        assign quotients_by[n*8+:8] = 8'd0;
        assign quotients_none[n] = 1'b0;
        assign quotients_minus[n] = 1'b0;
      end
      if (n < ROOTS) begin : has_roots
        reg none_;
        reg [7:0] by_;
        wire [65:0] root;
        wire mine = start && unit == {n[1:0], 2'd1};
        always @(posedge clk)
          if (mine) begin
            none_ <= below || x == 66'sd0;
            by_ <= 8'd0 - {2'd0, length[6:1]};
          end
        assign roots[n*66+:66] = none_ ? 66'd0 : root;
        assign roots_by[n*8+:8] = by_;
        fg_root unit_ (.clk(clk), .start(mine), .x(whole_x), .value(root));
      end else begin : no_roots
        assign roots[n*66+:66] = 66'd0;
        assign roots_by[n*8+:8] = 8'd0;
      end
      if (n < LOGARITHMS) begin : has_logarithms
        fg_logarithm unit_ (.clk(clk), .start(start && unit == {n[1:0], 2'd2}), .m(x[31:0]), .value(logarithms[n*66+:66]));
      end else begin : no_logarithms
        assign logarithms[n*66+:66] = 66'd0;
      end
      if (n < ANGLES) begin : has_angles
        fg_angle unit_ (.clk(clk), .start(start && unit == {n[1:0], 2'd3}), .along(held), .up(x), .value(angles[n*66+:66]));
      end else begin : no_angles
        assign angles[n*66+:66] = 66'd0;
      end
    end
  endgenerate

  wire [1:0] which = asked[3:2];
  always @(posedge clk) begin
    by <= 8'sd0;
    whole <= 1'b0;
    minus <= 1'b0;
    case (asked[1:0])
      2'd0: begin
        made <= quotients[which*66+:66];
        by <= quotients_by[which*8+:8];
        whole <= quotients_none[which];
        minus <= quotients_minus[which];
      end
      2'd1: begin
        made <= roots[which*66+:66];
        by <= roots_by[which*8+:8];
      end
      2'd2: made <= logarithms[which*66+:66];
      default: made <= angles[which*66+:66];
    endcase
  end
endmodule
