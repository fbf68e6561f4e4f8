// The units beside the first lane: quotients, roots, logarithms, angles, some of each kind, 4 at most.
//
// A unit is started with the number that was held before, and the next. The unit's number is its kind, and above that
// which of them. What it has made lies there two registers after it is asked for, with a shift and a sign.
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
  // What comes is kept for a cycle before any unit takes it, and which unit is to start is told to each by itself.
  // verilator lint_off UNUSEDSIGNAL
  reg signed [65:0] came, held;  // not all of it where a unit is left out
  reg came_below, held_below, holds;
  reg [6:0] came_length, held_length;
  wire [63:0] whole_x = came[63:0];
  wire unused = &{start, unit};
  // verilator lint_on UNUSEDSIGNAL
  always @(posedge clk) begin
    came <= x;
    came_below <= below;
    came_length <= length;
    holds <= hold;
    if (holds) begin
      held <= came;
      held_below <= came_below;
      held_length <= came_length;
    end
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
        reg mine;
        always @(posedge clk) begin
          mine <= start && unit == {n[1:0], 2'd0};
          if (mine) begin
            minus_ <= held_below ^ came_below;
            by_ <= {1'b0, came_length} - {1'b0, held_length};
          end
        end
        assign quotients_minus[n] = minus_;
        assign quotients_by[n*8+:8] = by_;
        fg_divide divide (.clk(clk), .start(mine), .over(held[61:0]), .under(came[30:0]), .value(quotients[n*66+:66]), .none(quotients_none[n]));
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
        reg mine;
        always @(posedge clk) begin
          mine <= start && unit == {n[1:0], 2'd1};
          if (mine) begin
            none_ <= came_below || came == 66'sd0;
            by_ <= 8'd0 - {2'd0, came_length[6:1]};
          end
        end
        assign roots[n*66+:66] = none_ ? 66'd0 : root;
        assign roots_by[n*8+:8] = by_;
        fg_root unit_ (.clk(clk), .start(mine), .x(whole_x), .value(root));
      end else begin : no_roots
        assign roots[n*66+:66] = 66'd0;
        assign roots_by[n*8+:8] = 8'd0;
      end
      if (n < LOGARITHMS) begin : has_logarithms
        reg mine;
        always @(posedge clk) mine <= start && unit == {n[1:0], 2'd2};
        fg_logarithm unit_ (.clk(clk), .start(mine), .m(came[31:0]), .value(logarithms[n*66+:66]));
      end else begin : no_logarithms
        assign logarithms[n*66+:66] = 66'd0;
      end
      if (n < ANGLES) begin : has_angles
        reg mine;
        always @(posedge clk) mine <= start && unit == {n[1:0], 2'd3};
        fg_angle unit_ (.clk(clk), .start(mine), .along(held), .up(came), .value(angles[n*66+:66]));
      end else begin : no_angles
        assign angles[n*66+:66] = 66'd0;
      end
    end
  endgenerate

  // First which of a kind, then which kind.
  reg [65:0] quotient, root, logarithm, angle;
  reg signed [7:0] quotient_by, root_by;
  reg quotient_none, quotient_minus;
  reg [1:0] kind;
  always @(posedge clk) begin
    case (asked[3:2])
      `define TAKEN(m) begin quotient <= quotients[m*66+:66]; quotient_by <= quotients_by[m*8+:8]; \
          quotient_none <= quotients_none[m]; quotient_minus <= quotients_minus[m]; root <= roots[m*66+:66]; \
          root_by <= roots_by[m*8+:8]; logarithm <= logarithms[m*66+:66]; angle <= angles[m*66+:66]; end
      2'd0: `TAKEN(0)
      2'd1: `TAKEN(1)
      2'd2: `TAKEN(2)
      default: `TAKEN(3)
    endcase
    kind <= asked[1:0];
    by <= kind == 2'd0 ? quotient_by : kind == 2'd1 ? root_by : 8'sd0;
    whole <= kind == 2'd0 && quotient_none;
    minus <= kind == 2'd0 && quotient_minus;
    made <= kind == 2'd0 ? quotient : kind == 2'd1 ? root : kind == 2'd2 ? logarithm : angle;
  end
endmodule
