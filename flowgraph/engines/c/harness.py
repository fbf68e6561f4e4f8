"""A folder with a filter in C: header, source, a program that replays recorded events, and a Makefile.

A recording is a csv file, one event a line: time in ns, name of the input, and its numbers in the order of
the header, matrices row by row. Events of one time follow one another and make one tick. The program prints
what comes out in the same form, with as many digits as bring every number back.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import put_new, whole
from flowgraph.data.inputs import Inputs
from flowgraph.engines.c.compile import FLAGS
from flowgraph.engines.c.source import Source, generate
from flowgraph.engines.c.syntax import comment, string
from flowgraph.engines.pipeline_inputs import events_of
from flowgraph.pipeline.optimise import COMPILED, check_passes, optimise
from flowgraph.pipeline.pipeline import Leaf, Pipeline, Port
from flowgraph.pipeline.program import specialise


def write_c(
    pipeline: Pipeline,
    folder: str | Path,
    dtype: str = "float64",
    *,
    source: Source | None = None,
    passes: Collection[str] | None = None,
) -> dict[str, Path]:
    """Write the C of a pipeline into a folder, made if missing; returns the files by name.

    Args:
        pipeline: what to write down.
        folder: for `NAME.h`, `NAME.c`, `main.c` and `Makefile`.
        dtype: "float64" or "float32", what `real` is.
        source: the C, if it is there already.
        passes: of the optimiser; those that suit C if left out.

    Raises:
        UnknownNameError: for a pass that is not there.
        LoweringError: for what C has no rule for.
        OutputError: where the folder holds another filter's files, or cannot be written.
    """
    chosen = check_passes(COMPILED if passes is None else passes)
    made = source or generate(pipeline, dtype, program=lambda p, key: optimise(specialise(p, key), chosen))
    m = made.names.module
    texts = {
        f"{m}.h": made.header,
        f"{m}.c": made.source,
        "main.c": main_text(pipeline, made),
        "Makefile": makefile(m),
    }
    return put_new(folder, texts, what="filter")


def makefile(module: str) -> str:
    """Builds `replay` and the filter's object; `CFLAGS` can be given."""
    flags = " ".join(FLAGS)
    return f"""CC = cc
CFLAGS = {flags} -Wall -Wextra -Werror

replay: main.o {module}.o
\t$(CC) $(CFLAGS) -o $@ main.o {module}.o -lm

%.o: %.c {module}.h
\t$(CC) $(CFLAGS) -c -o $@ $<

clean:
\trm -f replay main.o {module}.o

.PHONY: clean
"""


def main_text(pipeline: Pipeline, source: Source) -> str:
    """The program that replays a csv file."""
    names = source.names
    m = names.module
    longest = max([1, *(_count(p.leaves) for p in pipeline.inputs)])
    lines = [
        f"/* Replays events through {comment(pipeline.name)}: replay EVENTS.csv [SEED] > OUTPUTS.csv */",
        f'#include "{m}.h"',
        "",
        "#include <inttypes.h>",
        "#include <stdio.h>",
        "#include <stdlib.h>",
        "#include <string.h>",
        "",
        f"static {m}_state state;",
        *(f"static {m}_{n} in_{n};" for n in names.inputs),
        *(f"static {m}_{n} out_{n};" for n in names.outputs),
        "static int64_t now;",
        "static uint64_t present;",
        "",
        "static void print_number(double x) { printf(\",%.17g\", x); }",
        "",
        "static void tick(void)",
        "{",
        "    if (present == 0) return;",
        f"    const uint64_t made = {m}_react(" + ", ".join(
            ["&state", "now", "present"]
            + [f"present >> {k} & 1u ? &in_{n} : NULL" for k, n in enumerate(names.inputs)]
            + [f"&out_{n}" for n in names.outputs]
        ) + ");",
    ]  # fmt: skip
    if not pipeline.outputs:
        lines.append("    (void)made;")
    for k, (port, name, leaves) in enumerate(
        zip(pipeline.outputs, names.outputs, names.output_leaves, strict=True)
    ):
        lines.append(f"    if (made >> {k} & 1u) {{")
        lines.append(f'        printf("%" PRId64 ",%s", now, {string(_cell(port.name))});')
        for leaf, field in zip(port.leaves, leaves, strict=True):
            lines += [f"        {t}" for t in _print(leaf, f"out_{name}.{field}")]
        lines += ['        printf("\\n");', "    }"]
    lines += ["    present = 0;", "}", ""]
    lines += [
        "/* the next number of a line, or an error */",
        "static char *field(char **rest, long row)",
        "{",
        "    char *start = *rest;",
        "    if (start == NULL) {",
        '        fprintf(stderr, "row %ld: too few numbers\\n", row);',
        "        exit(1);",
        "    }",
        '    char *end = strpbrk(start, ",\\r\\n");',
        "    *rest = end != NULL && *end == ',' ? end + 1 : NULL;",
        "    if (end != NULL) *end = 0;",
        "    return start;",
        "}",
        "",
        f"static char line[{64 + 32 * (longest + 2)}];",
        "",
        "int main(int count, char **words)",
        "{",
        "    if (count < 2) {",
        '        fprintf(stderr, "usage: replay EVENTS.csv [SEED]\\n");',
        "        return 2;",
        "    }",
        '    FILE *file = fopen(words[1], "r");',
        "    if (file == NULL) {",
        "        perror(words[1]);",
        "        return 1;",
        "    }",
        f"    {m}_reset(&state, count > 2 ? strtoull(words[2], NULL, 10) : 0);",
        "    for (long row = 1; fgets(line, sizeof line, file) != NULL; row++) {",
        "        if (line[0] == '#' || line[0] == '\\n') continue;",
        "        char *rest = line;",
        "        const int64_t time = strtoll(field(&rest, row), NULL, 10);",
        "        const char *name = field(&rest, row);",
        "        if (present != 0 && time != now) tick();",
        "        if (time < now && row > 1) {",
        '            fprintf(stderr, "row %ld: time goes backwards\\n", row);',
        "            return 1;",
        "        }",
        "        now = time;",
    ]
    first = True
    for k, (port, name, leaves) in enumerate(
        zip(pipeline.inputs, names.inputs, names.input_leaves, strict=True)
    ):
        opens = "if" if first else "} else if"
        lines.append(f"        {opens} (strcmp(name, {string(_cell(port.name))}) == 0) {{")
        for leaf, member in zip(port.leaves, leaves, strict=True):
            lines += [f"            {t}" for t in _read(leaf, f"in_{name}.{member}", source.real)]
        lines.append(f"            present |= UINT64_C(1) << {k};")
        first = False
    lines += [
        "        } else {" if not first else "        {",
        '            fprintf(stderr, "row %ld: no input is called %s\\n", row, name);',
        "            return 1;",
        "        }",
        "    }",
        "    tick();",
        "    fclose(file);",
        "    return 0;",
        "}",
    ]
    return "\n".join(lines) + "\n"


def _count(leaves: tuple[Leaf, ...]) -> int:
    return sum(math.prod(leaf.shape) for leaf in leaves)


def _print(leaf: Leaf, place: str) -> list[str]:
    def one(x: str) -> str:
        if leaf.dtype == "real":
            return f"print_number({x});"
        form, kind = ("PRIu64", "uint64_t") if leaf.dtype[0] == "u" else ("PRId64", "int64_t")
        return f'printf(",%" {form}, ({kind}){x});'

    if leaf.shape == ():
        return [one(place)]
    return [f"for (int i = 0; i < {math.prod(leaf.shape)}; i++) {one(f'{place}[i]')}"]


def _read(leaf: Leaf, place: str, real: str) -> list[str]:
    def one(x: str) -> str:
        text = "field(&rest, row)"
        if leaf.dtype == "real":
            return f"{x} = ({real})strtod({text}, NULL);"
        if leaf.dtype == "bool":
            return f"{x} = strtol({text}, NULL, 10) != 0;"
        if leaf.dtype[0] == "u":
            return f"{x} = ({leaf.dtype}_t)strtoull({text}, NULL, 10);"
        return f"{x} = ({leaf.dtype}_t)strtoll({text}, NULL, 10);"

    if leaf.shape == ():
        return [one(place)]
    return [f"for (int i = 0; i < {math.prod(leaf.shape)}; i++) {one(f'{place}[i]')}"]


def _cell(name: str) -> str:
    """A name as it stands in a csv file: what would break a line or a field is replaced."""
    return "".join("_" if c in ",\r\n\0" else c for c in name)


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
    with whole(file) as out:
        for time, key in zip(events.time.tolist(), events.key.tolist(), strict=True):
            for k, port in enumerate(pipeline.inputs):
                if key >> k & 1:
                    out.write(f"{time},{_cell(port.name)}{next(rows[k])}\n".encode())
    return len(events.time)


def _texts(port: Port, series: Any) -> list[str]:
    """For each event its numbers, each after a comma."""
    leaves = [np.asarray(a).reshape(len(series.time), -1) for a in series.leaves.values()]
    parts = [
        ["".join(f",{x!r}" if a.dtype.kind == "f" else f",{int(x)}" for x in row) for row in a.tolist()]
        for a in leaves
    ]
    return ["".join(p) for p in zip(*parts, strict=True)] if parts else [""] * len(series.time)
