// Plays numbers on the driver, whose words go to the machine behind its stream. A line of the file has the time, the
// pattern of present inputs, and the numbers of these in order. What is printed is the time, the name of an
// output, and its numbers; how many words did not fit, and the cycles that it took, go to the standard error.
#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include "MODULE.h"
#include "TOP.h"
#include "verilated.h"

static TOP *top;
static unsigned long long cycles;

static void tick() {
  top->clk = 1;
  top->eval();
  top->clk = 0;
  top->eval();
  ++cycles;
}

static void send(void *, uint64_t word) {
  top->s_tdata = word;
  top->s_tvalid = 1;
  top->eval();
  while (!top->s_tready) tick();
  tick();
  top->s_tvalid = 0;
}

static uint64_t receive(void *) {
  top->m_tready = 1;
  top->eval();
  while (!top->m_tvalid) tick();
  const uint64_t word = top->m_tdata;
  tick();
  top->m_tready = 0;
  return word;
}

static const char *next(FILE *script) {
  static char text[64];
  if (fscanf(script, "%63s", text) != 1) {
    fprintf(stderr, "a line ends too early\n");
    exit(2);
  }
  return text;
}

static inline double real(FILE *script) { return strtod(next(script), nullptr); }
static inline long long whole(FILE *script) { return strtoll(next(script), nullptr, 10); }
static inline void show(double x) { printf(" %a", x); }
template <class Whole> static inline void show(Whole x) { printf(" %lld", (long long)x); }

static void play(MODULE_state *device, FILE *script, int64_t time, uint64_t present) {
  // the tick
  if (there >> 62) fprintf(stderr, "at %" PRId64 " nothing was done: %" PRIx64 "\n", time, there);
}

int main(int argc, char **argv) {
  Verilated::commandArgs(argc, argv);
  FILE *script = argc > 1 && argv[1][0] != '+' ? fopen(argv[1], "r") : stdin;
  if (!script) return perror(argv[1]), 2;
  top = new TOP;
  top->s_tvalid = top->m_tready = 0;
  top->clk = 0;
  top->reset = 1;
  for (int k = 0; k < 4; ++k) tick();
  top->reset = 0;
  MODULE_state device = {nullptr, send, receive, 0, 0};
  MODULE_reset(&device, 0);
  int64_t time;
  uint64_t present;
  while (fscanf(script, "%" SCNd64 " %" SCNu64, &time, &present) == 2) play(&device, script, time, present);
  fprintf(stderr, "saturations %" PRIu64 "\ncycles %llu\n", MODULE_saturations(&device), cycles);
  delete top;
}
