// The angle of a point by CORDIC (J. Volder, 1959): 40 turns, each half as large, two cycles a turn.
// along and up have at most 61 bits; the angle has 60 bits behind the point, 84 cycles after `start`.
module fg_angle (
    input wire clk,
    input wire start,
    input wire signed [65:0] along,
    input wire signed [65:0] up,
    output wire [65:0] value
);
  function signed [65:0] angle_of(input [5:0] turn);
    case (turn)
      6'd0: angle_of = 66'hc90fdaa22168c00;
      6'd1: angle_of = 66'h76b19c1586ed3c0;
      6'd2: angle_of = 66'h3eb6ebf25901ba0;
      6'd3: angle_of = 66'h1fd5ba9aac2f6e0;
      6'd4: angle_of = 66'hffaaddb967ef50;
      6'd5: angle_of = 66'h7ff556eea5d894;
      6'd6: angle_of = 66'h3ffeaab776e536;
      6'd7: angle_of = 66'h1fffd555bbba97;
      6'd8: angle_of = 66'hffffaaaaddddc;
      6'd9: angle_of = 66'h7ffff55556eef;
      6'd10: angle_of = 66'h3ffffeaaaab78;
      6'd11: angle_of = 66'h1fffffd55555c;
      6'd12: angle_of = 66'hffffffaaaaab;
      6'd13: angle_of = 66'h7ffffff55555;
      6'd14: angle_of = 66'h3ffffffeaaab;
      6'd15: angle_of = 66'h1fffffffd555;
      6'd16: angle_of = 66'hffffffffaab;
      6'd17: angle_of = 66'h7ffffffff55;
      6'd18: angle_of = 66'h3ffffffffeb;
      6'd19: angle_of = 66'h1fffffffffd;
      6'd20: angle_of = 66'h10000000000;
      6'd21: angle_of = 66'h8000000000;
      6'd22: angle_of = 66'h4000000000;
      6'd23: angle_of = 66'h2000000000;
      6'd24: angle_of = 66'h1000000000;
      6'd25: angle_of = 66'h800000000;
      6'd26: angle_of = 66'h400000000;
      6'd27: angle_of = 66'h200000000;
      6'd28: angle_of = 66'h100000000;
      6'd29: angle_of = 66'h80000000;
      6'd30: angle_of = 66'h40000000;
      6'd31: angle_of = 66'h20000000;
      6'd32: angle_of = 66'h10000000;
      6'd33: angle_of = 66'h8000000;
      6'd34: angle_of = 66'h4000000;
      6'd35: angle_of = 66'h2000000;
      6'd36: angle_of = 66'h1000000;
      6'd37: angle_of = 66'h800000;
      6'd38: angle_of = 66'h400000;
      6'd39: angle_of = 66'h200000;
      default: angle_of = 66'd0;
    endcase
  endfunction
  localparam signed [65:0] HALF_TURN = 66'h3243f6a8885a3000;

  // A turn is two cycles: one finds out what is added, and which way, from registers that change in the other alone.
  reg signed [65:0] x, y, step_x, step_y, turned, step;
  reg [5:0] turn;
  reg finds, adds, last, down;

  always @(posedge clk) begin
    step_x <= y >>> turn;
    step_y <= x >>> turn;
    step <= angle_of(turn);
    down <= !y[65] && y != 66'sd0;
    last <= turn == 6'd39;
    if (start) begin
      x <= along[65] ? -along : along;
      y <= along[65] ? -up : up;
      turned <= !along[65] ? 66'sd0 : up[65] ? -HALF_TURN : HALF_TURN;
      turn <= 6'd0;
      finds <= 1'b1;
      adds <= 1'b0;
    end else begin
      adds <= finds;
      finds <= adds && !last;
      if (adds) begin
        turn <= turn + 6'd1;
        x <= down ? x + step_x : x - step_x;
        y <= down ? y - step_y : y + step_y;
        turned <= down ? turned + step : turned - step;
      end
    end
  end
  assign value = turned;
endmodule
