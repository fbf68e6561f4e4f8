// The digits of log2 m behind the point, for m from 1 to 2 with 30 bits behind the point: m is squared,
// and where it reaches 2 the digit is one. 184 cycles after `start`.
module fg_logarithm (
    input wire clk,
    input wire start,
    input wire [31:0] m,
    output wire [65:0] value
);
  reg [31:0] now;
  reg [29:0] digits;
  reg [4:0] left;
  reg [2:0] wait_;
  // verilator lint_off UNUSEDSIGNAL
  wire signed [67:0] square;
  // verilator lint_on UNUSEDSIGNAL
  fg_multiply multiply (.clk(clk), .x({2'd0, now}), .y({2'd0, now}), .product(square));
  wire [33:0] next = square[63:30];

  always @(posedge clk)
    if (start) begin
      now <= m;
      digits <= 30'd0;
      left <= 5'd30;
      wait_ <= 3'd5;
    end else if (left != 5'd0) begin
      wait_ <= wait_ == 3'd0 ? 3'd5 : wait_ - 3'd1;
      if (wait_ == 3'd0) begin
        left <= left - 5'd1;
        digits <= {digits[28:0], next[31]};
        now <= next[31] ? {1'b0, next[31:1]} : next[31:0];
      end
    end
  assign value = {36'd0, digits};
  // verilator lint_off UNUSEDSIGNAL
  wire unused = &next[33:32];
  // verilator lint_on UNUSEDSIGNAL
endmodule
