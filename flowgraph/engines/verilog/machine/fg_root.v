// The whole part of the square root of a number below 2^64, digit by digit; 33 cycles after `start`.
module fg_root (
    input wire clk,
    input wire start,
    input wire [63:0] x,
    output wire [65:0] value
);
  reg [63:0] low;
  reg [31:0] rest, root;
  reg [5:0] left;
  // Twice the digits so far and one more: where it goes into the rest, the next digit is one.
  wire [33:0] next = {rest, low[63:62]};
  // verilator lint_off UNUSEDSIGNAL
  wire [34:0] less = {1'b0, next} - {1'b0, root, 2'd1};  // not negative, it has 32 bits but for the last
  // verilator lint_on UNUSEDSIGNAL

  always @(posedge clk)
    if (start) begin
      low <= x;
      rest <= 32'd0;
      root <= 32'd0;
      left <= 6'd32;
    end else if (left != 6'd0) begin
      left <= left - 6'd1;
      low <= {low[61:0], 2'd0};
      rest <= less[34] ? next[31:0] : less[31:0];
      root <= {root[30:0], ~less[34]};
    end
  assign value = {34'd0, root};
endmodule
