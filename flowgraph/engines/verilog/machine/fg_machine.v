// A microcoded machine for the arithmetic of fixed point.
//
// Each microword holds for each lane a term of a sum: two words of the memory, what is made of them (`kind`), a
// shift, a sign. The last term of a sum (`mode` is not 0) shifts the whole, cuts it to a word and writes it. One term
// a cycle and lane; a word can be read by the microword LATENCY after that which writes it (`latency.py`). With ROWS a loop of the
// program goes over the elements of rows, a term is repeated for each of them, and a row is read at a place that was
// computed. Quotients, roots, logarithms and angles are made beside, in units that are started by a sum and asked by
// a term.
//
// While `ready` is 1 the host writes words (`put`) and reads them (`word` is what lies at `at` three cycles
// earlier, six where the memory is DEEP), and starts a run at a place of the program.
module fg_machine #(
    parameter WIDTH = 24,  // bits of a word of a real number
    parameter WIDE = 24,  // and of one that is held in a wider word
    parameter PLACE = 12,  // bits of an address of the memory
    parameter STEP = 12,  // bits of an address of the program
    parameter WORDS = 2048,
    parameter STEPS = 4096,
    parameter FETCH = 0,  // registers from the number of a step to its microword: as NAME.v says
    parameter DRAIN = 0,  // cycles until all is written that the last microword has begun: likewise
    parameter LANES = 1,
    parameter BANKS = 1,  // words that are written in a cycle, at most
    parameter DEEP = 0,  // whether the memory has several blocks
    parameter ROWS = 0,  // whether there are loops and computed places
    parameter INDICES = 2,  // how many of these are kept
    parameter ELEMENT = 1,  // bits of the number of an element
    parameter DIVIDES = 1,  // which units there are
    parameter ROOTS = 1,
    parameter LOGARITHMS = 1,
    parameter ANGLES = 1,
    parameter MEMORY = "memory",  // begin of the names of files
    parameter PROGRAM = "program"
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
  // The microword, from its end: for each lane kind, shift, minus, first, limit, last shift, floor, mode, places d b a,
  // and with rows, whether a, b, d go along, peak; then halt, and with rows, repeat, running, back, round, loop.
  localparam LANE = 31 + 3 * PLACE + (ROWS != 0 ? 4 : 0);
  localparam CODE = LANES * LANE + (ROWS != 0 ? 6 : 1);
  localparam D = 31, B = 31 + PLACE, A = 31 + 2 * PLACE;
  localparam HALT = LANES * LANE;
  localparam LATER = DEEP != 0 ? 3 : 0;  // registers more until a word is read

  // -- the program ------------------------------------------------------------------------------------------
  wire [CODE-1:0] arrived, fetched;
  reg [STEP-1:0] step;
  reg [CODE-1:0] code;
  reg running;
  reg [FETCH-1:0] live;
  reg [5:0] draining;
  wire go, jump;  // without `go` the program stands still
  wire [STEP-1:0] back;
  reg idle;  // neither running nor draining: worked out a cycle ahead
  assign ready = idle;
  fg_memory #(
      .WIDTH(CODE), .PLACE(STEP), .WORDS(STEPS), .DEEP(1), .READS(1), .FILE(PROGRAM)
  ) steps (
      .clk(clk), .place(step), .word(arrived), .write(1'b0), .to({STEP{1'b0}}), .written({CODE{1'b0}})
  );
  // The program's memory never stands still: what arrives while the machine does is kept, to be taken in its order.
  generate
    if (ROWS != 0) begin : keeps
      reg [CODE-1:0] kept[0:7];
      reg [2:0] kept_to, kept_from;
      reg [FETCH-2:0] went;
      initial begin
        kept_to = 3'd0;
        kept_from = 3'd0;
        went = {FETCH - 1{1'b1}};
      end
      always @(posedge clk) begin
        went <= {went[FETCH-3:0], go};
        if (went[FETCH-2]) begin
          kept[kept_to] <= arrived;
          kept_to <= kept_to + 3'd1;
        end
        if (go) kept_from <= kept_from + 3'd1;
      end
      assign fetched = kept_from == kept_to ? arrived : kept[kept_from];
    end else begin : keeps_none
      assign fetched = arrived;
    end
  endgenerate
  wire halts = go && live[FETCH-1] && code[HALT];
  wire takes = live[FETCH-2] && !halts;
  always @(posedge clk) begin
    if (go) begin
      code <= takes ? fetched : {CODE{1'b0}};
      live <= {live[FETCH-2:0], running};
    end
    if (reset) begin
      running <= 1'b0;
      idle <= 1'b1;
      live <= {FETCH{1'b0}};
      draining <= 6'd0;
      step <= {STEP{1'b0}};
    end else if (start && ready) begin
      running <= 1'b1;
      idle <= 1'b0;
      step <= from;
      draining <= DRAIN[5:0];
    end else if (running) begin
      if (go) step <= jump ? back : step + 1'b1;
      if (halts) begin
        running <= 1'b0;
        live <= {FETCH{1'b0}};
      end
    end else begin
      if (draining != 6'd0) draining <= draining - 6'd1;
      idle <= draining[5:1] == 5'd0;
    end
  end

  // -- loops: `first` is the first of the elements that a round makes, `placed` a microword with its places -----
  wire [LANES*LANE-1:0] placed;
  wire write_index;
  // verilator lint_off UNUSEDSIGNAL
  reg [PLACE-1:0] index_to;  // an index has fewer bits
  reg [35:0] index_word;
  // verilator lint_on UNUSEDSIGNAL
  genvar n;
  generate
    if (ROWS != 0) begin : rows
      localparam REPEAT = HALT + 1, RUNNING = HALT + 2, BACK = HALT + 3, ENDS = HALT + 4, LOOP = HALT + 5;
      localparam A_MOVES = 31 + 3 * PLACE, B_MOVES = A_MOVES + 1, D_MOVES = A_MOVES + 2;
      localparam KIND = 0, FIRST = 13, MODE = 27;
      localparam [3:0] GET = 13;
      // `second` is the element after `first`. Whether they are the last is worked out a cycle ahead, and so is `go`.
      reg [ELEMENT-1:0] first, second, last, by;
      reg at_last, second_last, one, two;  // the latter: whether there is but one round, or two
      reg goes;
      reg [STEP-1:0] begins;
      wire [ELEMENT-1:0] third = second + by;
      wire advances = code[REPEAT] || code[ENDS];
      wire last_next = code[LOOP] ? code[A+:ELEMENT] == {ELEMENT{1'b0}} : !advances ? at_last : at_last ? one : second_last;
      wire repeats_next = goes ? takes && fetched[REPEAT] : 1'b1;
      initial goes = 1'b1;
      assign go = goes;
      assign jump = code[BACK] && !at_last;
      assign back = begins;
      always @(posedge clk) begin
        goes <= reset || !repeats_next || last_next;
        at_last <= last_next;
        if (code[LOOP]) begin
          first <= {ELEMENT{1'b0}};
          second <= code[B+:ELEMENT];
          last <= code[A+:ELEMENT];
          by <= code[B+:ELEMENT];
          second_last <= code[A+:ELEMENT] == code[B+:ELEMENT];
          one <= code[A+:ELEMENT] == {ELEMENT{1'b0}};
          two <= code[A+:ELEMENT] == code[B+:ELEMENT];
          begins <= step - FETCH[STEP-1:0] + 1'b1;
        end else if (advances) begin
          first <= at_last ? {ELEMENT{1'b0}} : second;
          second <= at_last ? by : third;
          second_last <= at_last ? two : third == last;
        end
      end

      // Of a term that is repeated, the first begins the sum, and the last, or each, ends it.
      reg [LANES*LANE-1:0] code1, code2, code3, code4;
      reg [ELEMENT-1:0] first1, first2, first3;
      localparam INDEX_BITS = INDICES > 2 ? $clog2(INDICES) : 1;
      always @(posedge clk) begin
        code1 <= code[LOOP] ? {LANES*LANE{1'b0}} : code[LANES*LANE-1:0];
        if (code[REPEAT]) begin
          code1[FIRST] <= code[FIRST] && first == {ELEMENT{1'b0}};
          if (!at_last && !code[RUNNING]) code1[MODE+:4] <= 4'd0;
        end
        first1 <= first;
        code2 <= code1;
        first2 <= first1;
        code3 <= code2;
        first3 <= first2;
      end
      function [INDEX_BITS-1:0] low(input [ELEMENT-1:0] x);
        integer k;
        for (k = 0; k < INDEX_BITS; k = k + 1) low[k] = k < ELEMENT ? x[k] : 1'b0;
      endfunction
      wire [PLACE-1:0] along = {{PLACE-ELEMENT{1'b0}}, first3};
      for (n = 0; n < LANES; n = n + 1) begin : lanes
        localparam O = n * LANE;
        (* ram_style = "block" *) reg [PLACE-1:0] index_[0:INDICES-1];  // each lane has a copy of all indices
        reg [INDEX_BITS-1:0] index_place;
        reg [PLACE-1:0] index_read, index3;
        always @(posedge clk) begin
          index_place <= code[O+B+:INDEX_BITS] + (code[O+B_MOVES] ? low(first) : {INDEX_BITS{1'b0}});
          index_read <= index_[index_place];
`ifdef VERILATOR
          if (write_index && index_to[INDEX_BITS-1:0] == index_place) index_read <= ~index_[index_place];  // as of the memory
`endif
          index3 <= index_read;
          if (write_index) index_[index_to[INDEX_BITS-1:0]] <= index_word[35] ? {PLACE{1'b0}} : index_word[PLACE-1:0];
          code4[O+:LANE] <= code3[O+:LANE];
          if (code3[O+KIND+:4] == GET) code4[O+A+:PLACE] <= code3[O+A+:PLACE] + index3;
          else if (code3[O+A_MOVES]) code4[O+A+:PLACE] <= code3[O+A+:PLACE] + along;
          if (code3[O+B_MOVES]) code4[O+B+:PLACE] <= code3[O+B+:PLACE] + along;
          if (code3[O+D_MOVES]) code4[O+D+:PLACE] <= code3[O+D+:PLACE] + along;
        end
      end
      assign placed = code4;
    end else begin : no_rows
      assign go = 1'b1;
      assign jump = 1'b0;
      assign back = {STEP{1'b0}};
      assign placed = code[LANES*LANE-1:0];
      // verilator lint_off UNUSEDSIGNAL
      wire unused = write_index;
      // verilator lint_on UNUSEDSIGNAL
    end
  endgenerate

  // -- the lanes, each with two copies of the memory, so that it reads two words a cycle ------------------------
  wire [LANES*36-1:0] results;
  wire [LANES*PLACE-1:0] tos;
  wire [LANES-1:0] writes, cuts, indexes;
  reg [LANES-1:0] writing;
  reg [LANES*PLACE-1:0] write_to;
  reg [LANES*36-1:0] written;
  wire [BANKS-1:0] bank_write;
  wire [BANKS*PLACE-1:0] bank_to;
  wire [BANKS*36-1:0] bank_word;
  generate
    for (n = 0; n < LANES; n = n + 1) begin : lane
      wire [LANE-1:0] mine = placed[n*LANE+:LANE];
      reg [PLACE-1:0] a_place, b_place;
      wire [35:0] a, b;
      wire [LANE-1:0] now;
      always @(posedge clk) begin
        a_place <= n == 0 && ready ? at : mine[A+:PLACE];
        b_place <= mine[B+:PLACE];
      end
      fg_memory #(
          .PLACE(PLACE), .WORDS(WORDS), .BANKS(BANKS), .DEEP(DEEP), .FILE(MEMORY)
      ) memory_a (
          .clk(clk), .place(a_place), .word(a), .write(bank_write), .to(bank_to), .written(bank_word)
      );
      fg_memory #(
          .PLACE(PLACE), .WORDS(WORDS), .BANKS(BANKS), .DEEP(DEEP), .FILE(MEMORY)
      ) memory_b (
          .clk(clk), .place(b_place), .word(b), .write(bank_write), .to(bank_to), .written(bank_word)
      );
      if (LATER != 0) begin : later
        reg [LANE-1:0] code1, code2, code3;
        always @(posedge clk) begin
          code1 <= mine;
          code2 <= code1;
          code3 <= code2;
        end
        assign now = code3;
      end else begin : at_once
        assign now = mine;
      end
      fg_lane #(
          .WIDTH(WIDTH), .WIDE(WIDE), .PLACE(PLACE), .CODE(LANE), .ROWS(ROWS), .FIRST_LANE(n == 0 ? 1 : 0),
          .DIVIDES(n == 0 ? DIVIDES : 0), .ROOTS(n == 0 ? ROOTS : 0), .LOGARITHMS(n == 0 ? LOGARITHMS : 0),
          .ANGLES(n == 0 ? ANGLES : 0)
      ) terms (
          .clk(clk), .code(now), .a(a), .b(b), .result(results[n*36+:36]), .to(tos[n*PLACE+:PLACE]),
          .write(writes[n]), .index(indexes[n]), .cut(cuts[n])
      );
      if (n == 0) begin : host
        assign word = a;
      end
      always @(posedge clk) begin
        writing[n] <= n == 0 && ready ? put : writes[n];
        write_to[n*PLACE+:PLACE] <= n == 0 && ready ? at : tos[n*PLACE+:PLACE];
        written[n*36+:36] <= n == 0 && ready ? put_word : results[n*36+:36];
      end
    end
  endgenerate
  // Which lane writes an index: the program sees to it that no two do.
  reg [LANES-1:0] indexing;
  always @(posedge clk) indexing <= indexes;
  assign write_index = |indexing;
  integer i;
  always @* begin
    index_to = LANES == 1 ? write_to[PLACE-1:0] : {PLACE{1'b0}};
    index_word = LANES == 1 ? written[35:0] : 36'd0;
    for (i = 0; i < LANES; i = i + 1)
      if (LANES > 1 && indexing[i]) begin
        index_to = index_to | write_to[i*PLACE+:PLACE];
        index_word = index_word | written[i*36+:36];
      end
  end

  // Which lane writes to a bank: the program sees to it that no two do.
  generate
    if (LANES == 1) begin : one_lane
      assign bank_write = writing;
      assign bank_to = write_to;
      assign bank_word = written;
    end else begin : some_lanes
      for (n = 0; n < BANKS; n = n + 1) begin : banks
        reg [PLACE-1:0] to;
        reg [35:0] given;
        reg does;
        integer k;
        always @* begin
          to = {PLACE{1'b0}};
          given = 36'd0;
          does = 1'b0;
          for (k = 0; k < LANES; k = k + 1)
            if (writing[k] && (BANKS == 1 || write_to[k*PLACE] == n[0])) begin
              to = to | write_to[k*PLACE+:PLACE];
              given = given | written[k*36+:36];
              does = 1'b1;
            end
        end
        assign bank_write[n] = does;
        assign bank_to[n*PLACE+:PLACE] = to;
        assign bank_word[n*36+:36] = given;
      end
    end
  endgenerate

  integer m;
  reg [31:0] more;
  always @* begin
    more = 32'd0;
    for (m = 0; m < LANES; m = m + 1) more = more + {31'd0, cuts[m]};
  end
  always @(posedge clk) cut <= reset ? 32'd0 : cut + more;
endmodule
