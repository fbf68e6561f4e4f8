"""The program that replays a csv file through a filter in fixed point, and prints what comes out.

It reads and prints the same lines as the replay of a floating-point filter. Numbers become words as the
interpreter makes them, and words are printed with as many digits as bring every number back; between the two
nothing is floating point. Exit status 1: the events cannot be read, or have a pattern without formats.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from flowgraph.data.files import put
from flowgraph.engines.c.harness import makefile
from flowgraph.engines.c.replay import KEEPS, csv_names
from flowgraph.engines.c.syntax import comment, string
from flowgraph.engines.fixed.files import texts_of
from flowgraph.engines.fixed.places import KNOWN, KNOWN_SMALL, SMALL, Place
from flowgraph.engines.fixed.standalone import Standalone
from flowgraph.errors import writes
from flowgraph.pipeline.formats import FREE
from flowgraph.pipeline.pipeline import Leaf, Pipeline


def write_fixed(pipeline: Pipeline, folder: Path) -> Mapping[str, Path]:
    """Write a pipeline with formats into a folder, made if missing; returns the files by their names.

    Raises:
        DeclarationError: where it has no formats; OutputError: where the files cannot be written.
    """
    source, texts = texts_of(pipeline)
    texts |= {"main.c": main_of_fixed(source), "Makefile": makefile(f"{pipeline.name}_fixed")}
    found = {}
    for file, text in texts.items():
        found[file] = folder / file
        with writes(found[file]):
            folder.mkdir(parents=True, exist_ok=True)
            put(found[file], text)
    return found


class _Tables:
    """The leaves of ports as tables of C: place, count, kind, and the fraction of each element."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._fractions: dict[tuple[int, ...], str] = {}

    def fraction(self, array: np.ndarray | None, count: int, shape: Sequence[int]) -> str:
        if array is None:
            return "NULL"
        row = tuple(np.broadcast_to(np.where(array == FREE, 0, array), shape).ravel().tolist()[:count] or [0])
        if row not in self._fractions:
            self._fractions[row] = f"f{len(self._fractions)}"
            numbers = ", ".join(map(str, row))
            self.lines.append(f"static const int16_t {self._fractions[row]}[] = {{{numbers}}};")
        return self._fractions[row]

    def port(self, name: str, leaves: Sequence[tuple[Leaf, Place, int, np.ndarray | None]]) -> int:
        rows = []
        for leaf, place, bits, fraction in leaves:
            count = math.prod(leaf.shape)
            at = f"{place[1]}, {int(place[0] == SMALL)}"
            rows.append(f"{{{at}, {count}, {bits}, {self.fraction(fraction, count, leaf.shape)}}}")
        self.lines.append(f"static const leaf {name}[] = {{{', '.join(rows) or '{0, 0, 0, 0, NULL}'}}};")
        return len(rows)


def main_of_fixed(source: Standalone) -> str:
    """The text of the program."""
    pipeline = source.pipeline
    assert pipeline.formats is not None
    tables, given = _Tables(), []
    for k, (port, name) in enumerate(zip(pipeline.inputs, csv_names(pipeline.inputs), strict=True)):
        leaves = [
            (leaf, source.held(leaf.value), pipeline.formats.width_of(leaf.value),
             pipeline.formats.fractions.get(leaf.value, np.array(0)) if leaf.dtype == "real" else None)
            for leaf in port.leaves
        ]  # fmt: skip
        count = tables.port(f"in{k}", leaves)
        given.append(f"{{{string(name)}, -1, 0, {count}, in{k}}}")
    cases = []
    names = csv_names(pipeline.outputs)
    for key, bound in zip(source.keys, source.bound, strict=True):
        rows = []
        for p, (flag, values) in enumerate(bound.program.outputs):
            if flag is None:
                continue
            made = [
                (leaf, source.end(key, n), 0, bound.fractions[n] if leaf.dtype == "real" else None)
                for leaf, n in zip(pipeline.outputs[p].leaves, values, strict=True)
            ]
            count = tables.port(f"out{key}_{p}", made)
            array, place = source.end(key, flag)
            at = (
                f"-1, {int(array == SMALL)}"
                if array in (KNOWN, KNOWN_SMALL)
                else f"{place}, {int(array == SMALL)}"
            )
            rows.append(f"{{{string(names[p])}, {at}, {count}, out{key}_{p}}}")
        tables.lines.append(
            f"static const port ports{key}[] = {{{', '.join(rows) or '{NULL, 0, 0, 0, NULL}'}}};"
        )
        cases.append(f"    case {key}: print(ports{key}, {len(rows)}); break;")
    longest = max((len(s.encode()) for s in csv_names(pipeline.inputs)), default=0)
    numbers = max((sum(math.prod(x.shape) for x in p.leaves) for p in pipeline.inputs), default=0)
    text = _TEXT.replace("TITLE", comment(pipeline.name)).replace("HEADER", f"{pipeline.name}_fixed.h")
    for mark, value in (
        ("TABLES", "\n".join(tables.lines)), ("GIVEN", ",\n    ".join(given)), ("CASES", "\n".join(cases)),
        ("LINE", str(64 + longest + 65 * max(numbers, 1))), 
        ("KEEPS", string(KEEPS)),
    ):  # fmt: skip
        text = text.replace(f"@{mark}@", value)
    return text


_TEXT = r"""/* Replays events through TITLE in fixed point: replay EVENTS.csv [SEED] > OUTPUTS.csv */
#include "HEADER"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* no fractions: whole numbers; present -1: always */
typedef struct { int place, small, count, bits; const int16_t *fraction; } leaf;
typedef struct { const char *name; int present, small, count; const leaf *leaves; } port;
static const int64_t none = -((int64_t)1 << 62); /* a reading that is not there */

@TABLES@
static const port given[] = {
    @GIVEN@};
enum { INPUTS = (int)(sizeof given / sizeof given[0]) };

static int32_t v[FX_SMALL];
static int64_t w[FX_WIDE], count_of[3];
static char line[@LINE@];
static long row;
static int key, keeps;

static void refuse(const char *what, const char *text)
{
    fflush(stdout);
    fprintf(stderr, "line %ld: %s %.40s\n", row, what, text);
    exit(1);
}

static char *field(char **rest)
{
    char *start = *rest, *end;
    if (start == NULL) refuse("too few numbers", "");
    end = strchr(start, ',');
    *rest = end != NULL ? end + 1 : NULL;
    if (end != NULL) *end = 0;
    if (*start == 0) refuse("an empty field", "");
    return start;
}

static int64_t whole(const char *text)
{
    char *end;
    errno = 0;
    const long long n = strtoll(text, &end, 10);
    if (*end != 0 || errno != 0) refuse("this is no whole number:", text);
    return n;
}

/* a number as a word: the nearest, half upwards, or the largest */
static int64_t word(const char *text, int fraction, int bits)
{
    const int64_t most = ((int64_t)1 << (bits - 1)) - 1;
    char *end;
    double x = strtod(text, &end);
    if (*end != 0) refuse("this is no number:", text);
    if (x - x != 0 && !keeps) refuse("not finite:", text);
    if (x != x) return none;
    x = floor(ldexp(x, fraction) + 0.5);
    return x > (double)most ? most : x < -(double)most ? -most : (int64_t)x;
}

static void read(const port *p, char **rest)
{
    for (int l = 0; l < p->count; ++l) {
        const leaf *x = &p->leaves[l];
        for (int k = 0; k < x->count; ++k) {
            const char *text = field(rest);
            const int64_t n = x->fraction != NULL ? word(text, x->fraction[k], x->bits) : whole(text);
            if (x->small) v[x->place + k] = (int32_t)n;
            else w[x->place + k] = n;
        }
    }
}

static int64_t at(int place, int small) { return small ? v[place] : w[place]; }

static void print(const port *ports, int count)
{
    for (int p = 0; p < count; ++p) {
        if (ports[p].present >= 0 && at(ports[p].present, ports[p].small) == 0) continue;
        printf("%lld,%s", (long long)w[FX_TIME], ports[p].name);
        for (int l = 0; l < ports[p].count; ++l) {
            const leaf *x = &ports[p].leaves[l];
            for (int k = 0; k < x->count; ++k) {
                const int64_t n = at(x->place + k, x->small);
                if (x->fraction == NULL) printf(",%lld", (long long)n);
                else printf(",%.17g", n == none ? NAN : ldexp((double)n, -x->fraction[k]));
            }
        }
        printf("\n");
    }
}

static void tick(void)
{
    if (key == 0) return;
    if (fx_compute(v, w, count_of, key) != 0) refuse("inputs meet that have no formats together", "");
    switch (key) {
@CASES@
    }
    if (fx_end(v, w, count_of, key) != 0) refuse("inputs meet that have no formats together", "");
    key = 0;
}

int main(int count, char **words)
{
    FILE *file = count == 2 || count == 3 ? fopen(words[1], "r") : NULL;
    const unsigned long long seed = count == 3 ? strtoull(words[2], NULL, 10) : 0;
    int begun = 0;
    if (file == NULL) {
        fprintf(stderr, "usage: replay EVENTS.csv [SEED], of a file that can be read\n");
        return 2;
    }
    fx_begin(v, w);
    w[FX_RANDOM_SEED] = (int64_t)(seed & 0xFFFFFFFFu);
    w[FX_RANDOM_SEED + 1] = (int64_t)(seed >> 32);
    while (fgets(line, sizeof line, file) != NULL) {
        int k = 0;
        char *rest = line;
        ++row;
        if (strchr(line, '\n') == NULL && !feof(file)) refuse("too long for an event", "");
        line[strcspn(line, "\r\n")] = 0;
        if (strcmp(line, @KEEPS@) == 0) keeps = 1;
        if (line[0] == '#' || line[0] == 0) continue;
        const int64_t time = whole(field(&rest));
        if (begun && time < w[FX_TIME]) refuse("time goes backwards", "");
        if (begun && time != w[FX_TIME]) tick();
        w[FX_TIME] = time;
        begun = 1;
        const char *name = field(&rest);
        while (k < INPUTS && strcmp(given[k].name, name) != 0) ++k;
        if (k == INPUTS) refuse("no input is called", name);
        if (key >> k & 1) refuse("a second event of one input at one time:", name);
        read(&given[k], &rest);
        if (rest != NULL) refuse("too many numbers:", rest);
        key |= 1 << k;
    }
    tick();
    fclose(file);
    return fflush(stdout) != 0 || ferror(stdout) != 0;
}
"""
