// x 2^-by, rounded to the nearest, halves upwards; to the left up to +-2^62. Four registers deep.
// `by` runs from -62 to 62; 63 makes zero. With `floor` a shift to the right rounds down.
module fg_shift (
    input wire clk,
    input wire signed [65:0] x,
    input wire signed [7:0] by,
    input wire floor,
    output reg signed [65:0] y
);
  // One bit is kept below the last, to round by: z is 2x.
  reg signed [66:0] z1, z2, z3;
  wire [5:0] m0 = size[5:0];
  reg left1, left2, left3, over1, over2, over3, floor1, floor2, floor3;
  reg [3:0] rest1;
  reg [1:0] rest2;
  wire left = by[7];

  // verilator lint_off UNUSEDSIGNAL
  wire [7:0] size = left ? 8'd0 - by : by;
  // verilator lint_on UNUSEDSIGNAL

  // To the left, what falls off and the sign behind it must be alike.
  wire signed [66:0] x2 = {x, 1'b0};
  always @(posedge clk) begin
    left1 <= left;
    floor1 <= floor;
    rest1 <= m0[3:0];
    over1 <= 1'b0;
    case ({left, m0[5:4]})
      3'b000: z1 <= x2;
      3'b001: z1 <= x2 >>> 16;
      3'b010: z1 <= x2 >>> 32;
      3'b011: z1 <= x2 >>> 48;
      3'b100: z1 <= x2;
      3'b101: begin z1 <= x2 <<< 16; over1 <= x2[66:50] != {17{x2[66]}}; end
      3'b110: begin z1 <= x2 <<< 32; over1 <= x2[66:34] != {33{x2[66]}}; end
      default: begin z1 <= x2 <<< 48; over1 <= x2[66:18] != {49{x2[66]}}; end
    endcase
    if (left) z1[66] <= x2[66];
    if (m0 == 6'd63) z1 <= 67'd0;
  end

  always @(posedge clk) begin
    left2 <= left1;
    floor2 <= floor1;
    rest2 <= rest1[1:0];
    over2 <= over1;
    case ({left1, rest1[3:2]})
      3'b000: z2 <= z1;
      3'b001: z2 <= z1 >>> 4;
      3'b010: z2 <= z1 >>> 8;
      3'b011: z2 <= z1 >>> 12;
      3'b100: z2 <= z1;
      3'b101: begin z2 <= z1 <<< 4; over2 <= over1 | (z1[66:62] != {5{z1[66]}}); end
      3'b110: begin z2 <= z1 <<< 8; over2 <= over1 | (z1[66:58] != {9{z1[66]}}); end
      default: begin z2 <= z1 <<< 12; over2 <= over1 | (z1[66:54] != {13{z1[66]}}); end
    endcase
    if (left1) z2[66] <= z1[66];
  end

  always @(posedge clk) begin
    left3 <= left2;
    floor3 <= floor2;
    over3 <= over2;
    case ({left2, rest2})
      3'b000: z3 <= z2;
      3'b001: z3 <= z2 >>> 1;
      3'b010: z3 <= z2 >>> 2;
      3'b011: z3 <= z2 >>> 3;
      3'b100: z3 <= z2;
      3'b101: begin z3 <= z2 <<< 1; over3 <= over2 | (z2[66:65] != {2{z2[66]}}); end
      3'b110: begin z3 <= z2 <<< 2; over3 <= over2 | (z2[66:64] != {3{z2[66]}}); end
      default: begin z3 <= z2 <<< 3; over3 <= over2 | (z2[66:63] != {4{z2[66]}}); end
    endcase
    if (left2) z3[66] <= z2[66];
  end

  wire round = z3[0] & ~left3 & ~floor3;
  always @(posedge clk)
    if (over3) y <= z3[66] ? -66'sh1_0000_0000_0000_0000 : 66'sh1_0000_0000_0000_0000;
    else y <= $signed(z3[66:1]) + $signed({65'd0, round});
endmodule
