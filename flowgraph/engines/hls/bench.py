"""The test bench of C++ for high-level synthesis, and what it is told.

A line of a script is one of

- `registers WORD...`: their words from now on; `seed LOW HIGH`;
- `tick TIME PRESENT WORD...`: a tick, with the words of the present inputs in order;
- `get`: print for each output whether it is there, its words if so, and the words of the registers;
- `is WORD...`: compare with these.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.hls.source import HlsSource


def script(
    source: HlsSource, tape: Tape, cells: list[Any], seed: np.ndarray, *, check: bool
) -> tuple[list[str], Integers]:
    """The lines of a recording, and the interpreter, which has played it if it is to be compared.

    Args:
        source: the C++.
        tape: ticks, and the events of each input.
        cells: register cells before the first.
        seed: (2,) uint32.
        check: whether the interpreter's words are to be compared, after each tick, or printed.
    """
    pipeline = source.pipeline
    player = Integers(pipeline, cells, seed)
    lines = [f"registers {_row(player.cells)}", f"seed {_row([seed])}"]
    rows = [zip(*s.leaves.values(), strict=True) for s in tape.series]
    for time, key in zip(tape.time.tolist(), tape.key.tolist(), strict=True):
        values = [next(row) for k, row in enumerate(rows) if key >> k & 1]
        ports = [port for k, port in enumerate(pipeline.inputs) if key >> k & 1]
        words = [
            player.words(leaf.value, x, leaf.shape) if leaf.dtype == "real" else x
            for port, leaves in zip(ports, values, strict=True)
            for leaf, x in zip(port.leaves, leaves, strict=True)
        ]
        lines.append(f"tick {time} {key} {_row(words)}")
        if not check:
            lines.append("get")
            continue
        bound, env = player.values(time, key, values)
        given: list[Any] = []
        for flag, leaves in bound.program.outputs:
            there = flag is not None and bool(env.get(flag, True))
            given.append(there)
            given += [env[n] for n in leaves] if there else []
        player.tick(time, key, values)
        lines.append(f"is {_row([*given, *player.cells])}")
    return lines, player


def _row(arrays: list[Any]) -> str:
    return " ".join(str(int(x)) for a in arrays for x in np.ravel(np.asarray(a)).astype(np.int64).tolist())


def bench_text(source: HlsSource) -> str:
    """The C++ of the bench."""
    name = source.names.module
    held = [a for row in source.inputs for a in row]
    made = [a for port in source.outputs for a in port.leaves]
    lines = [_ABOUT, f'#include "{name}_hls.h"', "#include <cstdio>", "#include <cstring>", ""]
    lines += [f"static {a.kind} {a.name}[{a.size}];" for a in (*held, *made)]
    lines += [f"static bool {port.there};" for port in source.outputs]
    lines.append(f"static int64_t registers[{max(sum(a.size for a in source.registers), 1)}];")
    lines.append(_READS)
    lines.append("static void take(FILE *script, unsigned present) {")
    lines.append("  (void)script; (void)present;")
    for k, row in enumerate(source.inputs):
        lines += [f"  if (present >> {k} & 1) read(script, {a.name}, {a.size});" for a in row]
    lines += ["}", "", "template <class Does> static void each_word(Does does) {"]
    for port in source.outputs:
        lines.append(f'  does("{port.there}", {port.there});')
        lines += [
            f'  if ({port.there}) for (int k = 0; k < {a.size}; ++k) does("{a.name}", (int64_t){a.name}[k]);'
            for a in port.leaves
        ]
    begin = 0
    lines.append(f"  {name}_registers(registers, false);")
    for a in source.registers:
        lines.append(f'  for (int k = 0; k < {a.size}; ++k) does("{a.name}", registers[{begin} + k]);')
        begin += a.size
    call = ", ".join(f"&{n}" if d.startswith("bool *") else n for d, n in source.arguments()[4:])
    lines += ["}", "", _MAIN.replace("NAME", name).replace("WORDS", str(begin)).replace("CALL", call)]
    return "\n".join(lines)


def makefile_text(name: str) -> str:
    """The commands that compile the bench with g++ and the headers of the package hls4ml."""
    return _MAKEFILE.replace("NAME", name)


_ABOUT = """\
// Plays a script on the function. A line is one of
//   registers WORD...             their words from now on
//   seed LOW HIGH                 of the random numbers
//   tick TIME PRESENT WORD...     a tick, with the words of the present inputs
//   get                           prints for each output whether it is there, its words, and the registers
//   is WORD...                    compares these
// At the end the number of values compared and differing, the ticks, and the words that were cut go to the
// standard error; the exit status is 1 where something differs."""

_READS = """
static int64_t word_of(FILE *script) {
  long long word = 0;
  if (fscanf(script, "%lld", &word) != 1) fprintf(stderr, "the script ends within a line\\n");
  return word;
}

template <class Word> static void read(FILE *script, Word *to, int size) {
  for (int k = 0; k < size; ++k) to[k] = word_of(script);
}
"""

_MAIN = """\
int main(int argc, char **argv) {
  FILE *script = argc > 1 ? fopen(argv[1], "r") : stdin;
  if (!script) return perror(argv[1]), 2;
  int64_t seed[2] = {0, 0}, count[3] = {0, 0, 0};
  bool restart = true;
  long long compared = 0, differing = 0, ticks = 0;
  char line[16];
  while (fscanf(script, "%15s", line) == 1) {
    if (!strcmp(line, "registers")) {
      read(script, registers, WORDS);
      NAME_registers(registers, true);
      restart = false;
    } else if (!strcmp(line, "seed")) {
      read(script, seed, 2);
    } else if (!strcmp(line, "tick")) {
      const int64_t time = word_of(script);
      const unsigned present = (unsigned)word_of(script);
      take(script, present);
      NAME_hls(restart, time, present, seed, CALL);
      restart = false;
      ++ticks;
    } else if (!strcmp(line, "get")) {
      each_word([](const char *, int64_t found) { printf("%lld ", (long long)found); });
      printf("\\n");
    } else if (!strcmp(line, "is")) {
      each_word([&](const char *what, int64_t found) {
        const int64_t wanted = word_of(script);
        ++compared;
        if (found != wanted && !differing++)
          fprintf(stderr, "tick %lld, %s: %lld, not %lld\\n", ticks, what, (long long)found,
                  (long long)wanted);
      });
    } else {
      fprintf(stderr, "no line of a script: %s\\n", line);
      return 2;
    }
  }
  fprintf(stderr, "values_compared %lld\\nvalues_differing %lld\\nticks %lld\\n", compared, differing, ticks);
  fprintf(stderr, "cut %lld\\nby_zero %lld\\nlost %lld\\n", (long long)count[0], (long long)count[1],
          (long long)count[2]);
  return differing != 0;
}
"""

_MAKEFILE = """\
# `make` builds the bench with g++; `./replay SCRIPT` plays a script on it. The headers ap_int.h and what it
# takes come with the Python package hls4ml, or with a vendor's tools: make AP_TYPES=FOLDER.
PYTHON ?= python3
FOUND = import importlib.util as u; print(u.find_spec("hls4ml").submodule_search_locations[0])
AP_TYPES ?= $(shell $(PYTHON) -c '$(FOUND)')/templates/vivado/ap_types
CXXFLAGS ?= -std=c++14 -O1 -Wall -Wno-unknown-pragmas -Wno-uninitialized -Wno-maybe-uninitialized

replay: NAME_hls.cpp NAME_hls.h bench.cpp
\t$(CXX) $(CXXFLAGS) -isystem $(AP_TYPES) -o $@ NAME_hls.cpp bench.cpp
"""
