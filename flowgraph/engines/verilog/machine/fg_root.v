// The whole part of the square root of a number below 2^62 + 1, a bit a cycle; 33 cycles after `start`.
module fg_root (
    input wire clk,
    input wire start,
    input wire [63:0] x,
    output wire [65:0] value
);
  reg [63:0] rest, root, bit_;
  wire [63:0] trial = root | bit_;  // its places are lower than those of the root

  always @(posedge clk)
    if (start) begin
      rest <= x;
      root <= 64'd0;
      bit_ <= 64'h4000_0000_0000_0000;
    end else if (bit_ != 64'd0) begin
      bit_ <= bit_ >> 2;
      if (rest >= trial) begin
        rest <= rest - trial;
        root <= (root >> 1) | bit_;
      end else root <= root >> 1;
    end
  assign value = {2'd0, root};
endmodule
