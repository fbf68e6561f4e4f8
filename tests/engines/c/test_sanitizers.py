"""The address and undefined-behaviour sanitizers over the C of every graph of the library.

Each replays a short flight, and then the same recording damaged: cut, with bytes flipped, fields doubled and
numbers grown. What is damaged is refused with its line, or is still a recording; nothing is read or computed
out of bounds.
"""

from __future__ import annotations

import random
import shutil

import pytest

from flowgraph import lower
from flowgraph.engines.c import write_c, write_events
from tests.engines.c.support import SANITIZED, built, ran, replays
from tests.graphs.library import LIBRARY, library_case

_DAMAGED = 25


def damaged(text: bytes, rng: random.Random) -> bytes:
    """A recording with one thing wrong in its first lines."""
    lines = text.splitlines(keepends=True)[:60]
    at = rng.randrange(len(lines))
    line = lines[at]
    place = rng.randrange(len(line))
    fields = line.split(b",")
    which = rng.randrange(len(fields))
    kind = rng.randrange(8)
    if kind == 0:
        line = line[:place]
    elif kind == 1:
        line = line[:place] + bytes([rng.randrange(256)]) + line[place + 1 :]
    elif kind == 2:
        line = line * 2
    elif kind == 3:
        fields[which] = rng.choice(
            [b"", b"nan", b"-inf", b"1e999", b"9" * 400, b"0x1p3", b" 1", b"\0", b"1e"]
        )
        line = b",".join(fields)
    elif kind == 4:
        line = b",".join([*fields, *fields])
    elif kind == 5:
        del fields[which]
        line = b",".join(fields)
    elif kind == 6:
        fields[which] = rng.choice([b"1e300", b"-1e300", b"5e-324", b"-0", b"9223372036854775807", b"1e38"])
        line = b",".join(fields)
    else:
        lines = lines[:at] + lines[at + 1 :] + [line]
        line = b""
    lines[at % len(lines)] = line or lines[at % len(lines)]
    return b"".join(lines)


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc -std=c99 -pedantic", "clang -std=c99 -pedantic", "g++ -x c++"])
def test_every_graph_is_clean_in_other_compilers(compiler, tmp_path):
    words = compiler.split()
    if shutil.which(words[0]) is None:
        pytest.skip(f"{words[0]} is not installed")
    for name in LIBRARY:
        write_c(lower(library_case(name).graph), tmp_path / name)
        strict = ["-fsyntax-only", "-Wall", "-Wextra", "-Werror", "main.c", f"{name}.c"]
        done = ran(*words, *strict, cwd=tmp_path / name)
        assert done.returncode == 0, (name, done.stderr[:1000])


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_no_graph_computes_or_reads_out_of_bounds(name, tmp_path):
    case = library_case(name)
    pipeline = lower(case.graph)
    write_c(pipeline, tmp_path)
    write_events(pipeline, case.inputs, tmp_path / "events.csv")
    program = built(tmp_path, "-O0", *SANITIZED)
    whole = (tmp_path / "events.csv").read_bytes()
    done = replays(program, whole)
    assert done.returncode == 0, done.stderr[:500]
    assert done.stdout.count("\n") > 1
    rng = random.Random(name)
    refused = 0
    for _ in range(_DAMAGED):
        text = damaged(whole, rng)
        done = replays(program, text)
        assert "runtime error" not in done.stderr, (text[:300], done.stderr[:800])
        assert "Sanitizer" not in done.stderr, (text[:300], done.stderr[:800])
        assert done.returncode in (0, 1, 3, 4), (done.returncode, done.stderr[:300])
        refused += done.returncode == 1
        if done.returncode == 1:
            assert ", line " in done.stderr
    assert refused > _DAMAGED // 4
