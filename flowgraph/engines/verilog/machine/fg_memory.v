// A memory of blocks with one reader and a writer for each of its banks. A word lies in the bank of its place's
// lowest bits, so that a cycle writes a word to each bank. Of a deep memory each block has its own registers
// before and behind it, and then one block is chosen. The first register behind a block is the block's own.
//
// The word lies there 2 cycles after its place, 5 cycles where the memory is DEEP.
// A word that is written can be read by a place that comes a cycle later than it. Nobody may need what lies there
// in the same cycle: a block of a chip does not say whether it would give the old word or the new. In Verilator it
// gives a wrong one, so that a program that needs it is seen.
module fg_memory #(
    parameter WIDTH = 36,
    parameter PLACE = 12,  // bits of an address
    parameter WORDS = 2048,
    parameter BANKS = 1,  // 1 or 2
    parameter DEEP = 0,  // needed for more than a block, or more than a bank
    parameter READS = 0,  // whether it is never written
    parameter FILE = "memory"  // begin of the files' names, one for each block: FILE_000.hex and so on
) (
    input wire clk,
    // verilator lint_off UNUSEDSIGNAL
    input wire [PLACE-1:0] place,
    input wire [BANKS-1:0] write,
    input wire [BANKS*PLACE-1:0] to,
    input wire [BANKS*WIDTH-1:0] written,
    // verilator lint_on UNUSEDSIGNAL
    output wire [WIDTH-1:0] word
);
  localparam LOW = BANKS - 1;  // bits of the bank
  localparam EACH = (WORDS + BANKS - 1) / BANKS;  // words of a bank
  localparam DEPTH = 2048;  // words of a block
  localparam LEVELS = (EACH + DEPTH - 1) / DEPTH;
  localparam COUNT = LEVELS * BANKS;
  localparam BITS = LEVELS > 1 ? 11 : PLACE - LOW;  // of a place in a block
  localparam PICK = COUNT > 1 ? $clog2(COUNT) : 1;

  // Which block a place lies in.
  function [PICK-1:0] block_of(input [PLACE-1:0] x);
    integer n;
    for (n = 0; n < PICK; n = n + 1) block_of[n] = n < LOW ? x[n] : n - LOW + BITS + LOW < PLACE ? x[n-LOW+BITS+LOW] : 1'b0;
  endfunction

  wire [COUNT*WIDTH-1:0] found;
  genvar k;
  generate
    for (k = 0; k < COUNT; k = k + 1) begin : blocks
      localparam LEFT = EACH - k / BANKS * DEPTH;
      // So many that no block of a chip is put behind another: then nothing is chosen before the block's own register.
      localparam SIZE = LEFT <= 512 ? LEFT : LEFT <= 1024 ? 1024 : DEPTH;
      localparam IN = SIZE > 1 ? $clog2(SIZE) : 1;  // bits of a place in it
      localparam [7:0] HUNDREDS = 8'd48 + k / 100, TENS = 8'd48 + k / 10 % 10, ONES = 8'd48 + k % 10;
      (* ram_style = "block", no_rw_check *) reg [WIDTH-1:0] words[0:SIZE-1];
      initial $readmemh({FILE, "_", HUNDREDS, TENS, ONES, ".hex"}, words);
      reg [WIDTH-1:0] read, own;
      wire [IN-1:0] at;
      // Of a deep memory a block takes only places of its own, and gives zeros where another is asked: registers that
      // were alike in all blocks would be made one, and its wires cross the whole memory.
      if (DEEP != 0) begin : deep
        reg [IN-1:0] near;
        reg asked1, asked2, asked3;
        reg [WIDTH-1:0] out;
        wire mine = block_of(place) == k[PICK-1:0];
        always @(posedge clk) begin
          if (mine) near <= place[LOW+:IN];
          asked1 <= mine;
          asked2 <= asked1;
          asked3 <= asked2;
          out <= asked3 ? own : {WIDTH{1'b0}};
        end
        assign at = near;
        assign found[k*WIDTH+:WIDTH] = out;
      end else begin : shallow
        assign at = place[LOW+:IN];
        assign found[k*WIDTH+:WIDTH] = own;
      end
      // verilator lint_off UNUSEDSIGNAL
      wire here;
      wire [IN-1:0] into;
      wire [WIDTH-1:0] given;
      // verilator lint_on UNUSEDSIGNAL
      always @(posedge clk) begin
        read <= words[at];
`ifdef VERILATOR
        if (here && into == at) read <= ~words[at];
`endif
        own <= read;
      end
      if (READS == 0) begin : written_to
        always @(posedge clk) if (here) words[into] <= given;
      end
      if (READS != 0) begin : never_written
        assign here = 1'b0;
        assign into = {IN{1'b0}};
        assign given = {WIDTH{1'b0}};
      end else if (DEEP != 0) begin : deep_write
        reg mine;
        reg [IN-1:0] near;
        reg [WIDTH-1:0] came;
        wire [PICK-1:0] chosen = block_of(to[k%BANKS*PLACE+:PLACE]);
        always @(posedge clk) begin
          mine <= write[k%BANKS] && chosen == k[PICK-1:0];
          if (chosen == k[PICK-1:0]) begin
            near <= to[k%BANKS*PLACE+LOW+:IN];
            came <= written[k%BANKS*WIDTH+:WIDTH];
          end
        end
        assign here = mine;
        assign into = near;
        assign given = came;
      end else begin : shallow_write
        assign here = write[0];
        assign into = to[IN-1:0];
        assign given = written;
      end
    end
    if (DEEP != 0) begin : choice
      reg [WIDTH-1:0] any, picked;
      integer n;
      always @* begin
        any = {WIDTH{1'b0}};
        for (n = 0; n < COUNT; n = n + 1) any = any | found[n*WIDTH+:WIDTH];
      end
      always @(posedge clk) picked <= any;
      assign word = picked;
    end else begin : alone
      assign word = found;
    end
  endgenerate
endmodule
