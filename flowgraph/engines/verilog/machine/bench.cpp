// Plays a script on the machine. A line is one of
//   put PLACE WORD     writes a word
//   go KEY             plays a tick with this pattern of present inputs, and waits for its end
//   get PLACE          prints the word that lies there
//   is PLACE WORD      compares it
// At the end the number of values compared and differing, the ticks, the longest in cycles, and the words that
// were cut go to the standard error; the exit status is 1 where something differs.
#include <cstdint>
#include <cstdio>
#include <cstring>
#include "TOP.h"
#include "verilated.h"
#if VM_COVERAGE
#include "verilated_cov.h"
#endif

static TOP *top;

static void tick() {
  top->clk = 0;
  top->eval();
  top->clk = 1;
  top->eval();
}

static int64_t read_word(unsigned place) {
  top->at = place;
  for (int k = 0; k < READ; ++k) tick();
  return (int64_t)((uint64_t)top->word << 28) >> 28;
}

int main(int argc, char **argv) {
  Verilated::commandArgs(argc, argv);
  top = new TOP;
  FILE *script = argc > 1 && argv[1][0] != '+' ? fopen(argv[1], "r") : stdin;
  if (!script) return perror(argv[1]), 2;
  top->reset = 1;
  top->start = top->put = 0;
  for (int k = 0; k < 4; ++k) tick();
  top->reset = 0;
  char word[16];
  unsigned long place;
  long long value;
  unsigned long long compared = 0, differing = 0, ticks = 0, longest = 0;
  while (fscanf(script, "%15s %lu", word, &place) == 2) {
    if (!strcmp(word, "put")) {
      if (fscanf(script, "%lld", &value) != 1) return 2;
      top->put = 1;
      top->at = place;
      top->put_word = (uint64_t)value & ((UINT64_C(1) << 36) - 1);
      tick();
      top->put = 0;
    } else if (!strcmp(word, "go")) {
      unsigned long long cycles = 0;
      top->key = place;
      top->start = 1;
      tick();
      top->start = 0;
      for (cycles = 1; !top->ready; ++cycles) tick();
      ++ticks;
      if (cycles > longest) longest = cycles;
      printf("cycles %llu\n", cycles);
    } else if (!strcmp(word, "get")) {
      printf("%lld\n", (long long)read_word(place));
    } else if (!strcmp(word, "is")) {
      if (fscanf(script, "%lld", &value) != 1) return 2;
      long long found = read_word(place);
      ++compared;
      if (found != value) {
        if (!differing++) fprintf(stderr, "tick %llu, place %lu: %lld, not %lld\n", ticks, place, found, value);
      }
    } else return 2;
  }
  fprintf(stderr, "values_compared %llu\nvalues_differing %llu\nticks %llu\ncycles %llu\ncut %u\n", compared, differing, ticks,
          longest, (unsigned)top->cut);
#if VM_COVERAGE
  Verilated::threadContextp()->coveragep()->write("coverage.dat");  // how often each bit has changed
#endif
  delete top;
  return differing != 0;
}
