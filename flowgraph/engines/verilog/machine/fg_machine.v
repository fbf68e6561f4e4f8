// A microcoded machine for the arithmetic of fixed point.
//
// Each microword is a term of a sum: two words of the memory, what is made of them (`kind`), a shift, a sign.
// The last term of a sum (`mode` is not 0) shifts the whole, cuts it to a word and writes it. One term a cycle;
// a word can be read by the microword LATENCY after that which writes it. With ROWS a loop of the program goes over
// the elements of rows, a term is repeated for each of them, and a row is read at a place that was computed. Quotients, roots, logarithms and
// angles are made beside, in units that are started by a sum and asked by a term.
//
// While `ready` is 1 the host writes words (`put`) and reads them (`word` is what lies at `at` three cycles
// earlier), and starts a run at a place of the program.
module fg_machine #(
    parameter WIDTH = 24,  // bits of a word of a real number
    parameter WIDE = 24,  // and of one that is held in a wider word
    parameter PLACE = 12,  // bits of an address of the memory
    parameter STEP = 12,  // bits of an address of the program
    parameter WORDS = 4096,
    parameter STEPS = 4096,
    parameter ROWS = 0,  // whether there are loops and computed places
    parameter INDICES = 2,  // how many of these are kept
    parameter LANE = 1,  // bits of the number of an element
    parameter DIVIDES = 1,  // which units there are
    parameter ROOTS = 1,
    parameter LOGARITHMS = 1,
    parameter ANGLES = 1,
    parameter MEMORY = "data.hex",
    parameter PROGRAM = "program.hex"
) (
    input wire clk,
    input wire reset,
    output wire ready,
    input wire start,
    input wire [STEP-1:0] from,
    input wire put,
    input wire [PLACE-1:0] at,
    input wire [35:0] put_word,
    output wire [35:0] word,
    output reg [31:0] cut  // words that did not fit, so far
);
  // The microword, from its end: kind, shift, minus, first, limit, last shift, floor, mode, halt, places d b a.
  // With rows: whether a, b, d go along, repeat, running, back, round, peak, loop.
  localparam CODE = 4 + 8 + 1 + 1 + 4 + 8 + 1 + 4 + 1 + 3 * PLACE + (ROWS != 0 ? 9 : 0);
  localparam KIND = 0, SHIFT = 4, MINUS = 12, FIRST = 13, LIMIT = 14, LAST = 18, FLOOR = 26, MODE = 27, HALT = 31;
  localparam D = 32, B = 32 + PLACE, A = 32 + 2 * PLACE, MARKS = 32 + 3 * PLACE;
  localparam A_MOVES = MARKS, B_MOVES = MARKS + 1, D_MOVES = MARKS + 2, REPEAT = MARKS + 3, RUNNING = MARKS + 4, BACK = MARKS + 5,
      ENDS = MARKS + 6, PEAK = MARKS + 7, LOOP = MARKS + 8;
  // Kinds of terms.
  localparam [3:0] MUL = 1, SEL = 2, SELN = 3, DYN = 4, AND = 5, OR = 6, XOR = 7, BITS = 8, NORM = 9, NORM_EVEN = 10,
      TAKE = 11, ISNAN = 12, GET = 13;
  // What becomes of a sum.
  localparam [3:0] FIT = 1, RAW = 2, U32 = 3, S32 = 4, LT = 5, LE = 6, EQ = 7, NE = 8, HOLD = 9, START = 10, FIT_WIDE = 11, INDEX = 12;
  localparam AHEAD = ROWS != 0 ? 4 : 0;
  localparam DEPTH = 23;  // from the microword to the written word, but for those
  localparam signed [65:0] MOST = (66'sd1 <<< (WIDTH - 1)) - 66'sd1;
  localparam signed [65:0] MOST_WIDE = (66'sd1 <<< (WIDE - 1)) - 66'sd1;
  localparam [35:0] NAN = 36'h8_0000_0000;

  // -- the program ------------------------------------------------------------------------------------------
  (* ram_style = "block" *) reg [CODE-1:0] program_[0:STEPS-1];
  initial $readmemh(PROGRAM, program_);
  reg [STEP-1:0] step;
  // Two registers behind the memory: its own clock-to-out is the longest of all.
  reg [CODE-1:0] fetched, next_code, code;
  reg running, live1, live2, live3;
  reg [5:0] draining;
  wire hold, jump;
  wire [STEP-1:0] back;
  assign ready = !running && draining == 6'd0;
  always @(posedge clk) begin
    if (!hold) begin
      fetched <= program_[step];
      next_code <= fetched;
      code <= live2 ? next_code : {CODE{1'b0}};
      live1 <= running;
      live2 <= live1;
      live3 <= live2;
    end
    if (reset) begin
      running <= 1'b0;
      live1 <= 1'b0;
      live2 <= 1'b0;
      live3 <= 1'b0;
      draining <= 6'd0;
      step <= {STEP{1'b0}};
    end else if (start && ready) begin
      running <= 1'b1;
      step <= from;
      draining <= DEPTH + AHEAD + 6'd2;
    end else if (running) begin
      if (!hold) step <= jump ? back : step + 1'b1;
      if (!hold && live3 && code[HALT]) begin
        running <= 1'b0;
        live1 <= 1'b0;
        live2 <= 1'b0;
      end
    end else if (draining != 6'd0) draining <= draining - 6'd1;
    if (!hold && live3 && code[HALT]) code <= {CODE{1'b0}};
  end

  // -- loops: `lane` is the first of the elements that a round makes, `placed` a microword with its places ------
  wire [CODE-1:0] placed;
  wire write_index;
  reg [PLACE-1:0] to;
  reg [35:0] written;
  generate
    if (ROWS != 0) begin : rows
      reg [LANE-1:0] lane, last, by;
      reg [STEP-1:0] begins;
      wire at_last = lane == last;
      assign hold = code[REPEAT] && !at_last;
      assign jump = code[BACK] && !at_last;
      assign back = begins;
      always @(posedge clk) begin
        if (code[LOOP]) begin
          lane <= {LANE{1'b0}};
          last <= code[A+:LANE];
          by <= code[B+:LANE];
          begins <= step - {{STEP-2{1'b0}}, 2'd2};
        end else if (code[REPEAT] || code[ENDS]) lane <= at_last ? {LANE{1'b0}} : lane + by;
      end

      // Of a term that is repeated, the first begins the sum, and the last, or each, ends it.
      reg [CODE-1:0] code1, code2, code3, code4;
      reg [LANE-1:0] lane1, lane2, lane3;
      (* ram_style = "block" *) reg [PLACE-1:0] index_[0:INDICES-1];
      localparam INDEX_BITS = INDICES > 2 ? $clog2(INDICES) : 1;
      reg [INDEX_BITS-1:0] index_place;
      reg [PLACE-1:0] index_read, index3;
      always @(posedge clk) begin
        code1 <= code;
        if (code[LOOP]) code1 <= {CODE{1'b0}};
        if (code[REPEAT]) begin
          code1[FIRST] <= code[FIRST] && lane == {LANE{1'b0}};
          if (!at_last && !code[RUNNING]) code1[MODE+:4] <= 4'd0;
        end
        lane1 <= lane;
        index_place <= code[B+:INDEX_BITS] + (code[B_MOVES] ? lane_of(lane) : {INDEX_BITS{1'b0}});
        code2 <= code1;
        lane2 <= lane1;
        index_read <= index_[index_place];
        code3 <= code2;
        lane3 <= lane2;
        index3 <= index_read;
        code4 <= code3;
        code4[A+:PLACE] <= code3[A+:PLACE] + (code3[KIND+:4] == GET ? index3 : code3[A_MOVES] ? {{PLACE-LANE{1'b0}}, lane3} : {PLACE{1'b0}});
        if (code3[B_MOVES]) code4[B+:PLACE] <= code3[B+:PLACE] + {{PLACE-LANE{1'b0}}, lane3};
        if (code3[D_MOVES]) code4[D+:PLACE] <= code3[D+:PLACE] + {{PLACE-LANE{1'b0}}, lane3};
        if (write_index) index_[to[INDEX_BITS-1:0]] <= written[35] ? {PLACE{1'b0}} : written[PLACE-1:0];
      end
      function [INDEX_BITS-1:0] lane_of(input [LANE-1:0] x);
        integer n;
        for (n = 0; n < INDEX_BITS; n = n + 1) lane_of[n] = n < LANE ? x[n] : 1'b0;
      endfunction
      assign placed = code4;
    end else begin : no_rows
      assign hold = 1'b0;
      assign jump = 1'b0;
      assign back = {STEP{1'b0}};
      assign placed = code;
      // verilator lint_off UNUSEDSIGNAL
      wire unused = write_index;
      // verilator lint_on UNUSEDSIGNAL
    end
  endgenerate

  // Each microword goes along beside what it does: `w(n)` is n registers behind the decoder.
  reg [CODE*DEPTH-1:0] line;
  always @(posedge clk) line <= {line[CODE*(DEPTH-1)-1:0], placed};
  `define AT(n, field) CODE * (n - 1) + field

  // -- the memory: two copies, so that two words are read a cycle -------------------------------------------
  (* ram_style = "block" *) reg [35:0] memory_a[0:WORDS-1];
  (* ram_style = "block" *) reg [35:0] memory_b[0:WORDS-1];
  initial $readmemh(MEMORY, memory_a);
  initial $readmemh(MEMORY, memory_b);
  reg write;
  reg [PLACE-1:0] a_place, b_place;
  reg [35:0] a_read, b_read, a4, b4;
  always @(posedge clk) begin
    a_place <= ready ? at : placed[A+:PLACE];
    b_place <= placed[B+:PLACE];
    a_read <= memory_a[a_place];
    b_read <= memory_b[b_place];
    a4 <= a_read;
    b4 <= b_read;
    if (write) begin
      memory_a[to] <= written;
      memory_b[to] <= written;
    end
  end
  assign word = a4;

  // -- operands: 3 registers behind the decoder lie a4 and b4 ------------------------------------------------
  wire [3:0] kind3 = line[`AT(3, KIND)+:4];
  reg signed [33:0] x4, y4;
  reg [35:0] size4;
  reg below4, zero4, no_a4, no_b4;
  reg signed [8:0] by4;
  always @(posedge clk) begin
    x4 <= kind3 == AND ? a4[33:0] & b4[33:0] : kind3 == OR ? a4[33:0] | b4[33:0] : kind3 == XOR ? a4[33:0] ^ b4[33:0] : a4[33:0];
    y4 <= b4[33:0];
    size4 <= a4[35] ? -a4 : a4;
    below4 <= a4[35];
    zero4 <= b4 == 36'd0;
    no_a4 <= a4 == NAN;
    no_b4 <= b4 == NAN;
    by4 <= kind3 != DYN ? 9'sd0 : b4[35:8] == {28{b4[35]}} ? $signed(b4[8:0]) : b4[35] ? -9'sd256 : 9'sd255;
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
  wire even = kind5 == NORM_EVEN && (length5[0] ^ line[`AT(5, FLOOR)]);
  wire signed [8:0] shift5 = {line[`AT(5, SHIFT)+7], line[`AT(5, SHIFT)+:8]};
  wire [6:0] length = {1'b0, length5} + {6'd0, even};
  reg signed [33:0] x6, y6;
  reg signed [9:0] by6;
  reg [6:0] length6;
  reg below6, no6;
  always @(posedge clk) begin
    x6 <= kind5 == BITS ? {28'd0, length5} : kind5 == NORM || kind5 == NORM_EVEN ? size5 : x5;
    y6 <= y5;
    by6 <= {shift5[8], shift5} + (kind5 == NORM || kind5 == NORM_EVEN ? {3'd0, length} : {by5[8], by5});
    length6 <= length;
    below6 <= below5;
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
  wire [65:0] quotient, root, logarithm, angle;
  reg signed [7:0] quotient_by, root_by;
  reg quotient_minus, root_none;
  wire quotient_none;
  wire take9 = line[`AT(9, KIND)+:4] == TAKE;
  wire [1:0] unit9 = line[`AT(9, B)+:2];
  reg signed [65:0] term10;
  reg signed [9:0] by10;
  reg minus10, no10;
  always @(posedge clk) begin
    term10 <= product9[65:0];
    by10 <= by9;
    minus10 <= line[`AT(9, MINUS)];
    no10 <= no9;
    if (take9) case (unit9)
      2'd0: begin
        term10 <= quotient;
        by10 <= quotient_none ? 10'sd0 : by9 + {{2{quotient_by[7]}}, quotient_by};
        minus10 <= line[`AT(9, MINUS)] ^ quotient_minus;
      end
      2'd1: begin
        term10 <= root_none ? 66'd0 : root;
        by10 <= by9 + {{2{root_by[7]}}, root_by};
      end
      2'd2: term10 <= logarithm;
      default: term10 <= angle;
    endcase
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
  wire [3:0] limit15 = line[`AT(15, LIMIT)+:4];
  wire signed [65:0] most15 = $signed(66'h0_4000_0000_0000_0000 >> limit15);
  reg signed [65:0] term16;
  reg minus16, no16;
  always @(posedge clk) begin
    term16 <= limit15 == 4'd15 ? term15 : term15 > most15 ? most15 : term15 < -most15 ? -most15 : term15;
    minus16 <= minus15;
    no16 <= no15;
  end

  // -- the sum ------------------------------------------------------------------------------------------------
  reg signed [65:0] sum;
  reg no17;
  wire signed [65:0] base;
  wire peak16;
  generate
    if (ROWS != 0) begin : peaks
      // The largest of the terms instead: a term is smaller where what is left of the sum without it is more than 0.
      // verilator lint_off UNUSEDSIGNAL
      wire signed [65:0] left = minus16 ? sum + term16 : sum - term16;
      // verilator lint_on UNUSEDSIGNAL
      assign peak16 = line[`AT(16, PEAK)] && !line[`AT(16, FIRST)] && !left[65];
      assign base = line[`AT(16, FIRST)] || line[`AT(16, PEAK)] ? 66'sd0 : sum;
    end else begin : no_peaks
      assign peak16 = 1'b0;
      assign base = line[`AT(16, FIRST)] ? 66'sd0 : sum;
    end
  endgenerate
  always @(posedge clk) begin
    if (!peak16) sum <= minus16 ? base - term16 : base + term16;
    no17 <= no16 | (no17 & ~line[`AT(16, FIRST)]);
  end

  // -- the whole, shifted -------------------------------------------------------------------------------------
  wire signed [65:0] whole21;
  fg_shift last (.clk(clk), .x(sum), .by(line[`AT(17, LAST)+:8]), .floor(line[`AT(17, FLOOR)]), .y(whole21));
  reg [3:0] none;
  reg [7:0] seen[0:11];
  integer k;
  always @(posedge clk) begin
    none <= {none[2:0], no17};
    seen[0] <= seen9;
    for (k = 1; k < 12; k = k + 1) seen[k] <= seen[k-1];
  end
  wire no21 = none[3];
  wire below21 = seen[11][7];
  wire [6:0] length21 = seen[11][6:0];

  // -- what becomes of it -------------------------------------------------------------------------------------
  wire [3:0] mode21 = line[`AT(21, MODE)+:4];
  wire signed [65:0] most = mode21 == FIT_WIDE ? MOST_WIDE : MOST;
  wire over = whole21 > most, under = whole21 < -most;
  wire [35:0] least = 36'd0 - most[35:0];
  reg [35:0] result22;
  reg write22, index22, index23;
  assign write_index = index23;
  reg cut22;
  always @(posedge clk) begin
    cut22 <= 1'b0;
    write22 <= mode21 != 4'd0 && mode21 != HOLD && mode21 != START && mode21 != INDEX;
    index22 <= mode21 == INDEX;
    case (mode21)
      FIT, FIT_WIDE: begin
        result22 <= no21 ? NAN : over ? most[35:0] : under ? least : whole21[35:0];
        cut22 <= !no21 && (over || under);
      end
      U32: result22 <= {4'd0, whole21[31:0]};
      S32: result22 <= {{4{whole21[31]}}, whole21[31:0]};
      LT: result22 <= {35'd0, whole21[65] && !no21};
      LE: result22 <= {35'd0, (whole21[65] || whole21 == 66'sd0) && !no21};
      EQ: result22 <= {35'd0, whole21 == 66'sd0 && !no21};
      NE: result22 <= {35'd0, whole21 != 66'sd0 || no21};
      RAW, INDEX: result22 <= no21 ? NAN : whole21[35:0];
      default: result22 <= 36'd0;
    endcase
    if (reset) cut <= 32'd0;
    else if (cut22) cut <= cut + 32'd1;
    write <= ready ? put : write22;
    index23 <= index22;
    to <= ready ? at : line[`AT(22, D)+:PLACE];
    written <= ready ? put_word : result22;
  end

  // -- the units ----------------------------------------------------------------------------------------------
  // verilator lint_off UNUSEDSIGNAL
  reg signed [65:0] held;  // not all of it where a unit is left out
  // verilator lint_on UNUSEDSIGNAL
  reg held_below;
  reg [6:0] held_length;
  wire started = mode21 == START;
  wire [1:0] unit21 = line[`AT(21, D)+:2];
  always @(posedge clk) begin
    if (mode21 == HOLD) begin
      held <= whole21;
      held_below <= below21;
      held_length <= length21;
    end
    if (started && unit21 == 2'd0) begin
      quotient_minus <= held_below ^ below21;
      quotient_by <= {1'b0, length21} - {1'b0, held_length};
    end
    if (started && unit21 == 2'd1) begin
      root_none <= below21 || whole21 == 66'sd0;
      root_by <= 8'd0 - {2'd0, length21[6:1]};
    end
  end
  generate
    if (DIVIDES != 0) begin : divides
      fg_divide unit (.clk(clk), .start(started && unit21 == 2'd0), .over(held[61:0]), .under(whole21[30:0]), .value(quotient), .none(quotient_none));
    end else begin : no_divides
      assign quotient = 66'd0;
      assign quotient_none = 1'b0;
    end
    if (ROOTS != 0) begin : roots
      fg_root unit (.clk(clk), .start(started && unit21 == 2'd1), .x(whole21[63:0]), .value(root));
    end else begin : no_roots
      assign root = 66'd0;
    end
    if (LOGARITHMS != 0) begin : logarithms
      fg_logarithm unit (.clk(clk), .start(started && unit21 == 2'd2), .m(whole21[31:0]), .value(logarithm));
    end else begin : no_logarithms
      assign logarithm = 66'd0;
    end
    if (ANGLES != 0) begin : angles
      fg_angle unit (.clk(clk), .start(started && unit21 == 2'd3), .along(held), .up(whole21), .value(angle));
    end else begin : no_angles
      assign angle = 66'd0;
    end
  endgenerate
endmodule
