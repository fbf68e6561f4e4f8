// The port of a machine as two streams of words with `valid` and `ready`, as AXI4-Stream has them.
//
// A command is 64 bits: what is to be done (63:62), a place (61:36), and a word (35:0).
//   0  put the word into the place
//   1  go: play a tick with the pattern of present inputs that is in the word
//   2  get: send what lies in the place, its sign extended to 64 bits
//   3  count: send how many words did not fit so far
// Commands are taken one by one, each when the machine is ready again: so a `get` behind a `go` is answered after
// the tick.
module fg_stream #(
    parameter KEY = 1,  // bits of a pattern of present inputs
    parameter PLACE = 12,  // bits of an address of the memory
    parameter [3:0] WAIT = 4'd0  // cycles from a command to the word that it asks for, or more: as NAME_stream.v says
) (
    input wire clk,
    input wire reset,
    input wire [63:0] s_tdata,
    input wire s_tvalid,
    output wire s_tready,
    output reg [63:0] m_tdata,
    output reg m_tvalid,
    input wire m_tready,
    input wire ready,
    output reg start,
    output reg [KEY-1:0] key,
    output reg put,
    output reg [PLACE-1:0] at,
    output reg [35:0] put_word,
    input wire [35:0] word,
    input wire [31:0] cut
);
  reg [3:0] waiting;
  wire unused = &{1'b0, s_tdata[61:36]};
  assign s_tready = ready && !start && !put && waiting == 4'd0 && !m_tvalid && !reset;
  always @(posedge clk) begin
    start <= 1'b0;
    put <= 1'b0;
    if (reset) begin
      waiting <= 4'd0;
      m_tvalid <= 1'b0;
    end else begin
      if (m_tvalid && m_tready) m_tvalid <= 1'b0;
      if (waiting != 4'd0) begin
        waiting <= waiting - 4'd1;
        if (waiting == 4'd1) begin
          m_tdata <= {{28{word[35]}}, word};
          m_tvalid <= 1'b1;
        end
      end
      if (s_tvalid && s_tready) begin
        at <= s_tdata[36+:PLACE];
        put_word <= s_tdata[35:0];
        key <= s_tdata[KEY-1:0];
        case (s_tdata[63:62])
          2'd0: put <= 1'b1;
          2'd1: start <= 1'b1;
          2'd2: waiting <= WAIT;
          default: begin
            m_tdata <= {32'd0, cut};
            m_tvalid <= 1'b1;
          end
        endcase
      end
    end
  end
endmodule
