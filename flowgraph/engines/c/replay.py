"""The program that replays a csv file through a written filter: strict in what it reads, and in how it ends.

What it reads is checked to the last character, since a number that is guessed at is worse than none: stamps
are whole and do not go backwards, a source has one event at a time, a line as many numbers as its input.
A number that is not finite is refused, unless the line `# not_finite=keep` says that NaN is data, as
`write_events` does where it is. The exit status says how it went:

    0  all was played
    1  the events cannot be read, or the outputs not be written; the message names the line
    2  it was called wrongly
    3  a queue was full: the outputs before that tick are printed, and nothing after
    4  all was played, and a number of an output was NaN or infinite
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from flowgraph.engines.c.entry import fault_cells
from flowgraph.engines.c.source import Source
from flowgraph.engines.c.syntax import comment, string
from flowgraph.pipeline.pipeline import Leaf, Pipeline, Port

KEEPS = "# not_finite=keep"
"""The line of a csv file that says that NaN and infinity in it are data."""

_NUMBER = 64  # characters of the longest number that is read
_RANGES = {
    "int32": "INT32_MIN, INT32_MAX",
    "int64": "INT64_MIN, INT64_MAX",
    "uint32": "UINT32_MAX",
    "uint64": "UINT64_MAX",
    "bool": "1",
}


def csv_names(ports: Sequence[Port]) -> list[str]:
    """What ports are called in a csv file, each once: what would break a line or a field is replaced."""
    made: list[str] = []
    for port in ports:
        name = "".join("_" if c in ",\r\n\0" or "\ud800" <= c <= "\udfff" else c for c in port.name)
        k, base = 2, name
        while name in made:
            name, k = f"{base}_{k}", k + 1
        made.append(name)
    return made


def main_text(pipeline: Pipeline, source: Source) -> str:
    """The program that replays a csv file."""
    names, m = source.names, source.names.module
    called = csv_names(pipeline.inputs)
    leaves = [leaf for p in pipeline.inputs for leaf in p.leaves]
    numbers = max([1, *(sum(math.prod(leaf.shape) for leaf in p.leaves) for p in pipeline.inputs)])
    longest = max([0, *(len(n.encode()) for n in called)])
    read = {leaf.dtype for leaf in leaves if math.prod(leaf.shape)}
    helpers = _HELPERS + (_REAL.replace("REAL", source.real) if "real" in read else "")
    if read & {"int32", "int64"}:
        helpers += _WHOLE
    if read & {"uint32", "uint64", "bool"}:
        helpers += _NATURAL
    if pipeline.faults:
        helpers += _OVERFLOWED
    if any(leaf.dtype == "real" for p in pipeline.outputs for leaf in p.leaves):
        helpers += _PRINTED
    lines = [
        f"/* Replays events through {comment(pipeline.name)}: replay EVENTS.csv [SEED] > OUTPUTS.csv",
        " *",
        " * Ends with 0; 1 where the events cannot be read; 2 where it is called wrongly; 3 where a queue",
        " * was full; 4 where an output was not finite. */",
        f'#include "{m}.h"',
        "",
        "#include <errno.h>",
        "#include <stdio.h>",
        "#include <stdlib.h>",
        "#include <string.h>",
        "",
        _REFUSED,
        f"static {m}_state state;",
        *(f"static {m}_{n} in_{n};" for n in names.inputs),
        *(f"static {m}_{n} out_{n};" for n in names.outputs),
        "static int64_t now;",
        "static uint64_t present;",
        "static int64_t broken, firstbroken; /* ticks with an output that is not finite */",
        "static FILE *file;",
        "static const char *filename;",
        "static long row, lastrow;",
        "static bool keeps; /* whether NaN and infinity are data */",
        f"static char line[{64 + longest + (_NUMBER + 1) * numbers}];",
        "",
        helpers,
        *_tick(pipeline, source),
        _MAIN.replace("MODULE", m).replace("KEEPS", string(KEEPS)),
    ]
    opens = "if"
    for k, (port, name, field, members) in enumerate(
        zip(pipeline.inputs, names.inputs, called, names.input_leaves, strict=True)
    ):
        lines += [
            f"        {opens} (strcmp(name, {string(field)}) == 0) {{",
            f'            if (present >> {k} & 1u) refuse("a second event of one input at one time:", name);',
        ]
        for leaf, member in zip(port.leaves, members, strict=True):
            lines += [f"            {t}" for t in _read(leaf, f"in_{name}.{member}")]
        lines.append(f"            present |= UINT64_C(1) << {k};")
        opens = "} else if"
    lines += [
        "        } else {" if pipeline.inputs else "        {",
        '            refuse("no input is called", name);',
        "        }",
        '        if (rest != NULL) refuse("too many numbers:", rest);',
        "    }",
        "    tick();",
        "    fclose(file);",
        "    return ended(0);",
        "}",
    ]
    return "\n".join(lines) + "\n"


def _tick(pipeline: Pipeline, source: Source) -> Iterator[str]:
    names, m = source.names, source.names.module
    given = [f"present >> {k} & 1u ? &in_{n} : NULL" for k, n in enumerate(names.inputs)]
    call = ", ".join(["&state", "now", "present", *given, *(f"&out_{n}" for n in names.outputs)])
    yield from (
        "static void tick(void)",
        "{",
        "    if (present == 0) return;",
        f"    const uint64_t made = {m}_react({call});",
        "    present = 0;",
    )
    if pipeline.faults:
        yield f"    if (made & {m.upper()}_OVERFLOW) {{"
        for fault, cell in zip(pipeline.faults, fault_cells(pipeline, names), strict=True):
            said = string(
                f"{fault.path}: {fault.message}, at most {fault.bound} waiting values of one stream"
            )
            yield f"        if (state.{cell} != INT64_MIN) overflowed({said});"
        yield "    }"
    yield f"    if ((made & {m.upper()}_NOT_FINITE) && broken++ == 0) firstbroken = now;"
    for k, (name, cell, port, leaves) in enumerate(
        zip(names.outputs, csv_names(pipeline.outputs), pipeline.outputs, names.output_leaves, strict=True)
    ):
        yield f"    if (made >> {k} & 1u) {{"
        yield f'        printf("%lld,%s", (long long)now, {string(cell)});'
        for leaf, field in zip(port.leaves, leaves, strict=True):
            yield from (f"        {t}" for t in _print(leaf, f"out_{name}.{field}"))
        yield from ('        printf("\\n");', "    }")
    yield from ("}", "")


def _each(leaf: Leaf, place: str, text: str) -> list[str]:
    """One statement, with @ for the number, or a loop of it."""
    if leaf.shape == ():
        return [text.replace("@", place)]
    return [f"for (int i = 0; i < {math.prod(leaf.shape)}; i++) {text.replace('@', f'{place}[i]')}"]


def _print(leaf: Leaf, place: str) -> list[str]:
    if leaf.dtype == "real":
        return _each(leaf, place, "printed(@);")
    form, kind = ("llu", "unsigned long long") if leaf.dtype[0] == "u" else ("lld", "long long")
    return _each(leaf, place, f'printf(",%{form}", ({kind})@);')


def _read(leaf: Leaf, place: str) -> list[str]:
    if leaf.dtype == "real":
        return _each(leaf, place, "@ = number(&rest);")
    if leaf.dtype in ("int32", "int64"):
        return _each(leaf, place, f"@ = ({leaf.dtype}_t)whole(&rest, {_RANGES[leaf.dtype]});")
    kind = "bool" if leaf.dtype == "bool" else f"{leaf.dtype}_t"
    return _each(leaf, place, f"@ = ({kind})natural(field(&rest), {_RANGES[leaf.dtype]});")


_REFUSED = """#if defined(__FAST_MATH__) || defined(_M_FP_FAST) \\
    || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "NaN and infinity mean something here: compile without -ffast-math, -Ofast and what they stand for"
#endif
"""

_HELPERS = r"""/* the end: what was printed must have arrived */
static int ended(int status)
{
    if (fflush(stdout) != 0 || ferror(stdout)) {
        fprintf(stderr, "the outputs cannot be written\n");
        return 1;
    }
    if (status == 0 && broken != 0) {
        fprintf(stderr, "an output is not finite, first at t = %lld ns; in %lld ticks\n",
                (long long)firstbroken, (long long)broken);
        return 4;
    }
    return status;
}

/* what is wrong with a line, and the text that is */
static void refuse(const char *what, const char *text)
{
    ended(1);
    fprintf(stderr, "%s, line %ld: %s%s", filename, row, what, text[0] != 0 ? " " : "");
    for (int i = 0; text[i] != 0; i++) {
        if (i == 40) {
            fprintf(stderr, "...");
            break;
        }
        fputc(text[i] >= ' ' && text[i] <= '~' ? text[i] : '?', stderr);
    }
    fputc('\n', stderr);
    exit(1);
}

/* the next line without its end; false after the last */
static bool next(void)
{
    size_t n = 0;
    int c;
    row++;
    while ((c = getc(file)) != EOF && c != '\n') {
        if (c == 0) refuse("a zero byte", "");
        if (n + 1 < sizeof line) line[n++] = (char)c;
        else if (line[0] != '#') refuse("too long for an event", "");
    }
    if (ferror(file)) {
        perror(filename);
        exit(1);
    }
    if (c == EOF && n == 0) return false;
    if (c == EOF) fprintf(stderr, "%s, line %ld: no end of line; is the file whole?\n", filename, row);
    if (n > 0 && line[n - 1] == '\r') n--;
    line[n] = 0;
    if (row == 1 && strncmp(line, "\357\273\277", 3) == 0) memmove(line, line + 3, n - 2);
    return true;
}

/* the next field of a line */
static const char *field(char **rest)
{
    char *start = *rest;
    if (start == NULL) refuse("too few numbers", "");
    char *end = strchr(start, ',');
    *rest = end != NULL ? end + 1 : NULL;
    if (end != NULL) *end = 0;
    if (start[0] == 0) refuse("an empty field", "");
    return start;
}

static int64_t stamp(char **rest)
{
    const char *text = field(rest), *digits = text + (text[0] == '-');
    errno = 0;
    if (digits[0] == 0 || digits[strspn(digits, "0123456789")] != 0)
        refuse("this stamp is no whole number of ns:", text);
    const long long n = strtoll(text, NULL, 10);
    if (errno != 0 || n == INT64_MIN) refuse("this stamp does not fit into 64 bits:", text);
    return n;
}
"""

_OVERFLOWED = r"""
static void overflowed(const char *what)
{
    ended(3);
    fprintf(stderr, "%s, line %ld: at t = %lld ns, %s\n", filename, lastrow, (long long)now,
            what);
    exit(3);
}
"""

_NATURAL = r"""
static uint64_t natural(const char *text, uint64_t most)
{
    errno = 0;
    if (text[strspn(text, "0123456789")] != 0) refuse("this is no whole number without a sign:", text);
    const unsigned long long n = strtoull(text, NULL, 10);
    if (errno != 0 || n > most) refuse("this number is too large:", text);
    return n;
}
"""

_WHOLE = r"""
static int64_t whole(char **rest, int64_t least, int64_t most)
{
    const char *text = field(rest), *digits = text + (text[0] == '-' || text[0] == '+');
    errno = 0;
    if (digits[0] == 0 || digits[strspn(digits, "0123456789")] != 0) refuse("this is no whole number:", text);
    const long long n = strtoll(text, NULL, 10);
    if (errno != 0 || n < least || n > most) refuse("this number is too large:", text);
    return n;
}
"""

_REAL = r"""
/* a decimal number: digits, with a point and an exponent where it has them */
static REAL number(char **rest)
{
    const char *text = field(rest), *bare = text + (text[0] == '-' || text[0] == '+'), *p = bare;
    size_t digits = strspn(p, "0123456789");
    p += digits;
    if (*p == '.') {
        const size_t more = strspn(++p, "0123456789");
        digits += more;
        p += more;
    }
    if (digits != 0 && (*p == 'e' || *p == 'E')) {
        p++;
        if (*p == '-' || *p == '+') p++;
        digits = strspn(p, "0123456789");
        p += digits;
    }
    const bool word = strcmp(bare, "nan") == 0 || strcmp(bare, "inf") == 0;
    if (word && !keeps) refuse("not finite, and no line '# not_finite=keep' comes before:", text);
    if (!word && (digits == 0 || *p != 0)) refuse("this is no number:", text);
    const double x = strtod(text, NULL);
    if (!word && (x - x != 0 || (sizeof(REAL) == 4 && (x > 3.4028235e38 || x < -3.4028235e38))))
        refuse("this number is too large:", text);
    return (REAL)x;
}
"""

_PRINTED = r"""
static void printed(double x) { printf(",%.17g", x); }
"""

_MAIN = r"""int main(int count, char **words)
{
    const char *seed = count > 2 ? words[2] : "0";
    errno = 0;
    const uint64_t given = strtoull(seed, NULL, 10);
    if (count < 2 || count > 3 || seed[0] == 0 || seed[strspn(seed, "0123456789")] != 0 || errno != 0) {
        fprintf(stderr, "usage: replay EVENTS.csv [SEED]\n");
        return 2;
    }
    filename = words[1];
    MODULE_reset(&state, given);
    file = fopen(filename, "r");
    if (file == NULL) {
        perror(filename);
        return 1;
    }
    bool begun = false;
    while (next()) {
        if (strcmp(line, KEEPS) == 0) keeps = true;
        if (line[0] == '#' || line[0] == 0) continue;
        char *rest = line;
        const int64_t time = stamp(&rest);
        if (begun && time < now) refuse("time goes backwards", "");
        if (time != now) tick();
        now = time;
        lastrow = row; /* of an event */
        begun = true;
        const char *name = field(&rest);"""
