// x y of signed numbers of 34 bits, in four products of 17 bits, so that each has a multiplier of its own.
// Three registers deep.
module fg_multiply (
    input wire clk,
    input wire signed [33:0] x,
    input wire signed [33:0] y,
    output reg signed [67:0] product
);
  wire signed [17:0] xl = {1'b0, x[16:0]}, yl = {1'b0, y[16:0]};
  wire signed [17:0] xh = {x[33], x[33:17]}, yh = {y[33], y[33:17]};
  reg signed [35:0] ll, lh, hl, hh;
  reg signed [67:0] outer;
  reg signed [36:0] middle;

  always @(posedge clk) begin
    ll <= xl * yl;
    lh <= xl * yh;
    hl <= xh * yl;
    hh <= xh * yh;
    outer <= {hh[33:0], ll[33:0]};
    middle <= {lh[35], lh} + {hl[35], hl};
    product <= outer + {{14{middle[36]}}, middle, 17'd0};
  end
  // verilator lint_off UNUSEDSIGNAL
  wire unused = &{ll[35:34], hh[35:34]};
  // verilator lint_on UNUSEDSIGNAL
endmodule
