"""A folder with a filter in C: header, source, a program that replays recorded events, and a Makefile.

A recording is a csv file, one event a line: time in ns, name of the input, and its numbers in the order of
the header, matrices row by row. Events of one time follow one another and make one tick. The program prints
what comes out in the same form, with as many digits as bring every number back.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import put_new, whole
from flowgraph.data.finite import finite
from flowgraph.data.inputs import Inputs
from flowgraph.engines.c.replay import KEEPS, csv_names, main_text
from flowgraph.engines.c.source import generate
from flowgraph.engines.pipeline_inputs import events_of
from flowgraph.pipeline.optimise import COMPILED, check_passes, optimise
from flowgraph.pipeline.pipeline import Pipeline, Port


def write_c(
    pipeline: Pipeline,
    folder: str | Path,
    dtype: str = "float64",
    *,
    passes: Collection[str] | None = None,
) -> dict[str, Path]:
    """Write the C of a pipeline into a folder, made if missing; returns the files by name.

    Args:
        pipeline: what to write down.
        folder: for `NAME.h`, `NAME.c`, `main.c` and `Makefile`.
        dtype: "float64" or "float32", what `real` is.
        passes: of the optimiser; those that suit C if left out.

    Raises:
        UnknownNameError: for a pass that is not there.
        LoweringError: for what C has no rule for.
        OutputError: where the folder holds another filter's files, or cannot be written.
    """
    chosen = check_passes(COMPILED if passes is None else passes)
    made = generate(pipeline, dtype, tidy=lambda program: optimise(program, chosen))
    m = made.names.module
    texts = {
        f"{m}.h": made.header,
        f"{m}.c": made.source,
        "main.c": main_text(pipeline, made),
        "Makefile": makefile(m),
    }
    return put_new(folder, texts, what="filter")


FLAGS = (
    "-O3 -fno-tree-slp-vectorize -fno-math-errno -fno-trapping-math -ffp-contract=fast -fopenmp-simd "
    "-DFLOWGRAPH_SIMD -Wall -Wextra"
)
"""What gcc and clang understand alike, for any processor; none changes what NaN or infinity mean."""


def makefile(module: str) -> str:
    """Builds `replay` and the filter's object; `CC`, `CFLAGS` and `ARCH` can be given."""
    return f"""# make ARCH=-march=native; make CC=clang; make CC=arm-linux-gnueabihf-gcc ARCH=-mcpu=cortex-a9
CC ?= cc
CFLAGS ?= {FLAGS}
ARCH ?=
.SUFFIXES:

replay: main.o {module}.o
\t$(CC) $(CFLAGS) $(ARCH) $(LDFLAGS) -o $@ main.o {module}.o -lm

main.o {module}.o: %.o: %.c {module}.h
\t$(CC) $(CPPFLAGS) $(CFLAGS) $(ARCH) -c -o $@ $<

clean:
\trm -f replay main.o {module}.o

.PHONY: clean
"""


def write_events(pipeline: Pipeline, inputs: Inputs | Mapping[str, Any], file: str | Path) -> int:
    """Write recorded events as the replay program reads them; returns the number of ticks.

    Args:
        pipeline: whose inputs they are.
        inputs: as for `Pipeline.run`.
        file: to write.

    Raises:
        DataError, UnknownNameError: as for a run.
        OutputError: where the file cannot be written.
    """
    events = events_of(pipeline, inputs)
    columns = [_texts(port, s) for port, s in zip(pipeline.inputs, events.series, strict=True)]
    rows = [iter(c) for c in columns]
    names = csv_names(pipeline.inputs)
    with whole(file) as out:
        if not all(finite(a) for x in events.series for a in x.leaves.values()):
            out.write(f"{KEEPS}\n".encode())
        for time, key in zip(events.time.tolist(), events.key.tolist(), strict=True):
            for k, name in enumerate(names):
                if key >> k & 1:
                    out.write(f"{time},{name}{next(rows[k])}\n".encode())
    return len(events.time)


def _texts(port: Port, series: Any) -> list[str]:
    """For each event its numbers, each after a comma."""
    leaves = [np.asarray(a).reshape(len(series.time), -1) for a in series.leaves.values()]
    parts = [
        ["".join(f",{x!r}" if a.dtype.kind == "f" else f",{int(x)}" for x in row) for row in a.tolist()]
        for a in leaves
    ]
    return ["".join(p) for p in zip(*parts, strict=True)] if parts else [""] * len(series.time)
