// The quotient of numbers brought to full length: over < 2^62, under from 2^30 to 2^31 (or zero).
// Restoring, a bit a cycle; 34 cycles after `start` the result lies there until the next.
module fg_divide (
    input wire clk,
    input wire start,
    input wire [61:0] over,
    input wire [30:0] under,
    output wire [65:0] value,
    output reg none  // divided by zero: the value is 2^62 and is not shifted
);
  reg [31:0] rest, low, quotient;
  reg [30:0] divisor;
  reg [5:0] left;
  reg nothing;
  wire [32:0] next = {rest, low[31]};
  wire [32:0] less = next - {2'd0, divisor};

  always @(posedge clk)
    if (start) begin
      rest <= {2'd0, over[61:32]};
      low <= over[31:0];
      quotient <= 32'd0;
      divisor <= under;
      left <= 6'd32;
      none <= (under == 31'd0) && (over != 62'd0);
      nothing <= over == 62'd0;
    end else if (left != 6'd0) begin
      left <= left - 6'd1;
      low <= {low[30:0], 1'b0};
      rest <= less[32] ? next[31:0] : less[31:0];
      quotient <= {quotient[30:0], ~less[32]};
    end
  assign value = none ? 66'h0_4000_0000_0000_0000 : nothing ? 66'd0 : {34'd0, quotient};
endmodule
