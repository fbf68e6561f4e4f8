// A lane of the machine: a term a cycle, added up to sums.
//
// `code` is the lane's part of a microword, three registers before `a` and `b` are there, the words that it reads.
// Behind 24 registers lie the word that its sum becomes and the place where it goes. The first lane has the units
// beside, and the kinds of terms that they need.
module fg_lane #(
    parameter WIDTH = 24,  // bits of a word of a real number
    parameter WIDE = 24,  // and of one that is held in a wider word
    parameter PLACE = 12,  // bits of an address of the memory
    parameter CODE = 67,  // bits of the lane's part of a microword
    parameter ROWS = 0,  // whether there are largest terms
    parameter FIRST_LANE = 1,
    parameter DIVIDES = 1,  // how many units there are of each kind
    parameter ROOTS = 1,
    parameter LOGARITHMS = 1,
    parameter ANGLES = 1
) (
    input wire clk,
    input wire [CODE-1:0] code,
    input wire [35:0] a,
    input wire [35:0] b,
    output reg [35:0] result,
    output wire [PLACE-1:0] to,
    output reg write,  // to the memory
    output reg index,  // to the indices
    output reg cut  // the word did not fit
);
  // The part of a microword, from its end: kind, shift, minus, first, limit, last shift, floor, mode, places d b a,
  // and with rows, whether a, b, d go along and the largest is wanted.
  localparam KIND = 0, SHIFT = 4, MINUS = 12, FIRST = 13, LIMIT = 14, LAST = 18, FLOOR = 26, MODE = 27;
  localparam D = 31, B = 31 + PLACE, PEAK = 34 + 3 * PLACE;
  // Kinds of terms.
  localparam [3:0] MUL = 1, SEL = 2, SELN = 3, DYN = 4, AND = 5, OR = 6, XOR = 7, BITS = 8, NORM = 9, NORM_EVEN = 10,
      TAKE = 11, ISNAN = 12;  // GET, 13, is its word at the place that the machine has worked out
  // What becomes of a sum.
  localparam [3:0] FIT = 1, RAW = 2, U32 = 3, S32 = 4, LT = 5, LE = 6, EQ = 7, NE = 8, HOLD = 9, START = 10, FIT_WIDE = 11, INDEX = 12;
  localparam signed [65:0] MOST = (66'sd1 <<< (WIDTH - 1)) - 66'sd1;
  localparam signed [65:0] MOST_WIDE = (66'sd1 <<< (WIDE - 1)) - 66'sd1;
  localparam [35:0] NAN = 36'h8_0000_0000;


  // Each microword goes along beside what it does: `AT(n, field)` is n registers behind.
  reg [CODE*24-1:0] line;
  always @(posedge clk) line <= {line[CODE*23-1:0], code};
  `define AT(n, field) CODE * (n - 1) + field

  // -- operands: 3 registers behind the decoder lie a and b --------------------------------------------------
  wire [3:0] kind3 = line[`AT(3, KIND)+:4];
  reg signed [33:0] x4, y4;
  reg [35:0] size4;
  reg below4, zero4, no_a4, no_b4;
  reg signed [8:0] by4;
  always @(posedge clk) begin
    x4 <= kind3 == AND ? a[33:0] & b[33:0] : kind3 == OR ? a[33:0] | b[33:0] : kind3 == XOR ? a[33:0] ^ b[33:0] : a[33:0];
    y4 <= b[33:0];
    size4 <= a[35] ? -a : a;
    below4 <= a[35];
    zero4 <= b == 36'd0;
    no_a4 <= a == NAN;
    no_b4 <= b == NAN;
    by4 <= kind3 != DYN ? 9'sd0 : b[35:8] == {28{b[35]}} ? $signed(b[8:0]) : b[35] ? -9'sd256 : 9'sd255;
  end

  // The length of a number in bits.
  function [5:0] length_of(input [35:0] v);
    integer k;
    begin
      length_of = 6'd0;
      for (k = 0; k < 36; k = k + 1) if (v[k]) length_of = k[5:0] + 6'd1;
    end
  endfunction

  wire [3:0] kind4 = line[`AT(4, KIND)+:4];
  reg signed [33:0] x5, y5, size5;
  reg [5:0] length5;
  reg signed [8:0] by5;
  reg below5, no5;
  always @(posedge clk) begin
    x5 <= kind4 == SEL && zero4 || kind4 == SELN && !zero4 || kind4 == 4'd0 || kind4 == TAKE ? 34'sd0 :
        kind4 == ISNAN ? {33'd0, no_a4} : x4;
    y5 <= kind4 == MUL ? y4 : 34'sd1;
    size5 <= size4[33:0];
    length5 <= length_of(size4);
    by5 <= by4;
    below5 <= below4;
    no5 <= kind4 == SEL ? no_a4 && !zero4 : kind4 == SELN ? no_a4 && zero4 : kind4 == MUL ? no_a4 || no_b4 : kind4 == DYN && no_a4;
  end

  wire [3:0] kind5 = line[`AT(5, KIND)+:4];
  wire norm5 = FIRST_LANE != 0 && (kind5 == NORM || kind5 == NORM_EVEN);
  wire even = FIRST_LANE != 0 && kind5 == NORM_EVEN && (length5[0] ^ line[`AT(5, FLOOR)]);
  wire signed [8:0] shift5 = {line[`AT(5, SHIFT)+7], line[`AT(5, SHIFT)+:8]};
  wire [6:0] length = {1'b0, length5} + {6'd0, even};
  reg signed [33:0] x6, y6;
  reg signed [9:0] by6;
  reg [6:0] length6;
  reg below6, no6;
  always @(posedge clk) begin
    x6 <= FIRST_LANE != 0 && kind5 == BITS ? {28'd0, length5} : norm5 ? size5 : x5;
    y6 <= y5;
    by6 <= {shift5[8], shift5} + (norm5 ? {3'd0, length} : {by5[8], by5});
    length6 <= norm5 ? length : 7'd0;
    below6 <= norm5 && below5;
    no6 <= no5;
  end

  // -- the product, three registers more ---------------------------------------------------------------------
  // verilator lint_off UNUSEDSIGNAL
  wire signed [67:0] product9;
  // verilator lint_on UNUSEDSIGNAL
  fg_multiply multiply (.clk(clk), .x(x6), .y(y6), .product(product9));
  reg signed [9:0] by7, by8, by9;
  reg [7:0] seen7, seen8, seen9;  // sign and length, which the units need
  reg no7, no8, no9;
  always @(posedge clk) begin
    by7 <= by6;
    by8 <= by7;
    by9 <= by8;
    seen7 <= {below6, length6};
    seen8 <= seen7;
    seen9 <= seen8;
    no7 <= no6;
    no8 <= no7;
    no9 <= no8;
  end

  // -- or what a unit has made --------------------------------------------------------------------------------
  wire [65:0] made9;
  wire signed [7:0] made_by9;
  wire made_whole9, made_minus9;
  wire take9 = FIRST_LANE != 0 && line[`AT(9, KIND)+:4] == TAKE;
  reg signed [65:0] term10;
  reg signed [9:0] by10;
  reg minus10, no10;
  always @(posedge clk) begin
    term10 <= take9 ? made9 : product9[65:0];
    by10 <= !take9 ? by9 : made_whole9 ? 10'sd0 : by9 + {{2{made_by9[7]}}, made_by9};
    minus10 <= line[`AT(9, MINUS)] ^ (take9 && made_minus9);
    no10 <= no9;
  end

  // -- the term, shifted and cut ------------------------------------------------------------------------------
  reg signed [65:0] term11;
  reg signed [7:0] by11;
  always @(posedge clk) begin
    term11 <= term10;
    by11 <= by10 > 10'sd62 ? 8'sd63 : by10 < -10'sd62 ? -8'sd62 : by10[7:0];
  end
  wire signed [65:0] term15;
  fg_shift shift (.clk(clk), .x(term11), .by(by11), .floor(line[`AT(11, FLOOR)]), .y(term15));
  reg [3:0] minus, no;
  always @(posedge clk) begin
    minus <= {minus[2:0], minus10};
    no <= {no[2:0], no10};
  end
  reg minus15, no15;
  always @(posedge clk) begin
    minus15 <= minus[3];
    no15 <= no[3];
  end
  reg signed [65:0] most15, least15;  // 2^(62 - limit); without a limit the largest of all
  wire [3:0] limit14 = line[`AT(14, LIMIT)+:4];
  always @(posedge clk) begin
    most15 <= limit14 == 4'd15 ? 66'sh1_ffff_ffff_ffff_ffff : $signed(66'h0_4000_0000_0000_0000 >> limit14);
    least15 <= limit14 == 4'd15 ? -66'sh2_0000_0000_0000_0000 : -$signed(66'h0_4000_0000_0000_0000 >> limit14);
  end
  reg signed [65:0] term16, most16, least16, term17;
  reg over16, under16, minus16, no16, minus17, no17;
  always @(posedge clk) begin
    term16 <= term15;
    most16 <= most15;
    least16 <= least15;
    over16 <= term15 > most15;
    under16 <= term15 < least15;
    minus16 <= minus15;
    no16 <= no15;
    term17 <= over16 ? most16 : under16 ? least16 : term16;
    minus17 <= minus16;
    no17 <= no16;
  end

  // -- the sum ------------------------------------------------------------------------------------------------
  reg signed [65:0] sum;
  reg no18;
  wire signed [65:0] base;
  wire peak17;
  generate
    if (ROWS != 0 && FIRST_LANE != 0) begin : peaks
      // The largest of the terms instead: a term is smaller where what is left of the sum without it is more than 0.
      // verilator lint_off UNUSEDSIGNAL
      wire signed [65:0] left = minus17 ? sum + term17 : sum - term17;
      // verilator lint_on UNUSEDSIGNAL
      assign peak17 = line[`AT(17, PEAK)] && !line[`AT(17, FIRST)] && !left[65];
      assign base = line[`AT(17, FIRST)] || line[`AT(17, PEAK)] ? 66'sd0 : sum;
    end else begin : no_peaks
      assign peak17 = 1'b0;
      assign base = line[`AT(17, FIRST)] ? 66'sd0 : sum;
    end
  endgenerate
  always @(posedge clk) begin
    if (!peak17) sum <= minus17 ? base - term17 : base + term17;
    no18 <= no17 | (no18 & ~line[`AT(17, FIRST)]);
  end

  // -- the whole, shifted -------------------------------------------------------------------------------------
  wire signed [65:0] whole22;
  fg_shift last (.clk(clk), .x(sum), .by(line[`AT(18, LAST)+:8]), .floor(line[`AT(18, FLOOR)]), .y(whole22));
  reg [3:0] none;
  reg [7:0] seen[0:12];
  integer k;
  always @(posedge clk) begin
    none <= {none[2:0], no18};
    seen[0] <= seen9;
    for (k = 1; k < 13; k = k + 1) seen[k] <= seen[k-1];
  end
  wire no22 = none[3];
  wire below22 = seen[12][7];
  wire [6:0] length22 = seen[12][6:0];
  wire [3:0] mode22 = line[`AT(22, MODE)+:4];

  // -- what becomes of it: first how it compares, then the word ---------------------------------------------------
  wire wide22 = mode22 == FIT_WIDE;
  reg over23, under23, below23, zero23, no23;
  reg signed [35:0] whole23, most23;
  always @(posedge clk) begin
    over23 <= whole22 > (wide22 ? MOST_WIDE : MOST);
    under23 <= whole22 < (wide22 ? -MOST_WIDE : -MOST);
    below23 <= whole22[65];
    zero23 <= whole22 == 66'sd0;
    no23 <= no22;
    whole23 <= whole22[35:0];
    most23 <= wide22 ? MOST_WIDE[35:0] : MOST[35:0];
  end
  wire [3:0] mode23 = line[`AT(23, MODE)+:4];
  assign to = line[`AT(24, D)+:PLACE];
  always @(posedge clk) begin
    cut <= 1'b0;
    write <= mode23 != 4'd0 && mode23 != HOLD && mode23 != START && mode23 != INDEX;
    index <= ROWS != 0 && mode23 == INDEX;
    case (mode23)
      FIT, FIT_WIDE: begin
        result <= no23 ? NAN : over23 ? most23 : under23 ? -most23 : whole23;
        cut <= !no23 && (over23 || under23);
      end
      U32: result <= {4'd0, whole23[31:0]};
      S32: result <= {{4{whole23[31]}}, whole23[31:0]};
      LT: result <= {35'd0, below23 && !no23};
      LE: result <= {35'd0, (below23 || zero23) && !no23};
      EQ: result <= {35'd0, zero23 && !no23};
      NE: result <= {35'd0, !zero23 || no23};
      RAW, INDEX: result <= no23 ? NAN : whole23;
      default: result <= 36'd0;
    endcase
  end

  // -- the units ----------------------------------------------------------------------------------------------
  generate
    if (FIRST_LANE != 0) begin : beside
      fg_units #(
          .DIVIDES(DIVIDES), .ROOTS(ROOTS), .LOGARITHMS(LOGARITHMS), .ANGLES(ANGLES)
      ) units (
          .clk(clk), .hold(mode22 == HOLD), .start(mode22 == START), .unit(line[`AT(22, D)+:4]), .x(whole22),
          .below(below22), .length(length22), .asked(line[`AT(7, B)+:4]), .made(made9), .by(made_by9),
          .whole(made_whole9), .minus(made_minus9)
      );
    end else begin : none_beside
      assign made9 = 66'd0;
      assign made_by9 = 8'sd0;
      assign made_whole9 = 1'b0;
      assign made_minus9 = 1'b0;
      // verilator lint_off UNUSEDSIGNAL
      wire unused = &{below22, length22};
      // verilator lint_on UNUSEDSIGNAL
    end
  endgenerate
endmodule
