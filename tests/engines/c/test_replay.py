"""The replay of written C: what it refuses, with the line, and how it ends."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest

from flowgraph import (
    FifoOverflowError,
    Scalar,
    Stream,
    arrays,
    boolean,
    graph,
    integer,
    lower,
    match,
    real,
    simulate,
    window,
)
from flowgraph.engines.c import generate, write_c, write_events
from tests.engines.c.support import built, ran, replays, written
from tests.support import MS, pairs, scalars

Three = Annotated[Any, real(3)]
Whole = Annotated[Any, integer()]
Long = Annotated[Any, integer(dtype="int64")]
Natural = Annotated[Any, integer(dtype="uint32")]
Flag = Annotated[Any, boolean()]


@graph
def paired(a: Stream[Scalar], b: Stream[Scalar]):
    return {"sum": match(a, b, tolerance="2ms", size=2, name="m").map(lambda p: p[0] + p[1]), "a": a}


@graph
def doubled(x: Stream[Three]):
    return {"y": x.map(lambda v: 2.0 * v)}


@graph
def kinds(n: Stream[Whole], long: Stream[Long], m: Stream[Natural], flag: Stream[Flag]):
    return {"n_out": n, "long_out": long, "m_out": m, "flag_out": flag}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    return written(paired.build(), tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="module")
def triple(tmp_path_factory):
    return written(doubled.build(), tmp_path_factory.mktemp("triple"))


@pytest.fixture(scope="module")
def kind(tmp_path_factory):
    return written(kinds.build(), tmp_path_factory.mktemp("kind"))


BROKEN = {
    "0,a,abc\n": (1, "no number: abc"),
    "0,a,1\n0,b,\n": (2, "an empty field"),
    "0,a,1,2,3\n": (1, "too many numbers: 2,3"),
    "0,a,1,\n": (1, "too many numbers"),
    "0,a\n": (1, "too few numbers"),
    "xyz,a,1\n": (1, "no whole number of ns: xyz"),
    "1.5e9,a,1\n": (1, "no whole number of ns: 1.5e9"),
    "1.0,a,1\n": (1, "no whole number of ns"),
    "+1,a,1\n": (1, "no whole number of ns"),
    " 1,a,1\n": (1, "no whole number of ns"),
    "0x10,a,1\n": (1, "no whole number of ns"),
    "-,a,1\n": (1, "no whole number of ns"),
    "99999999999999999999,a,1\n": (1, "does not fit into 64 bits"),
    "-9223372036854775808,a,1\n": (1, "does not fit into 64 bits"),
    "0,a,1\n0,a,2\n": (2, "a second event of one input at one time: a"),
    "0,a,1\n0,b,1\n0,a,2\n": (3, "a second event of one input at one time: a"),
    "5,a,1\n4,b,1\n": (2, "backwards"),
    "0,A,1\n": (1, "no input is called A"),
    "0, a,1\n": (1, "no input is called  a"),
    "time,name,value\n0,a,1\n": (1, "no whole number of ns: time"),
    "0;a;1\n": (1, "no whole number of ns"),
    "0,a,nan\n": (1, "not finite"),
    "0,a,-inf\n": (1, "not finite"),
    "0,a,1e999\n": (1, "too large"),
    "0,a,0x1p3\n": (1, "no number"),
    "0,a,1e\n": (1, "no number"),
    "0,a,.\n": (1, "no number"),
    "0,a, 1\n": (1, "no number"),
    "0,a,1 \n": (1, "no number"),
    '0,a,"1"\n': (1, "no number"),
    "0,a,1.2.3\n": (1, "no number"),
    "0,a,1\0,\n": (1, "a zero byte"),
    "0,a," + "1" * 5000 + "\n": (1, "too long for an event"),
    "0,\x1b[31m,1\n": (1, "no input is called ?[31m"),
    "# a comment\n\n0,a,1\n1,b,x\n": (4, "no number: x"),
}


@pytest.mark.parametrize("text", BROKEN)
def test_what_is_no_event_is_refused_with_its_line(pair, text):
    line, said = BROKEN[text]
    done = replays(pair, text)
    assert done.returncode == 1
    assert f"e.csv, line {line}: " in done.stderr
    assert said in done.stderr


FINE = {
    "0,a,1\n": ["0,a,1"],
    "-5,a,+.5e0\n": ["-5,a,0.5"],
    "007,a,1E+2\r\n": ["7,a,100"],
    "\ufeff0,a,5.\n": ["0,a,5"],
    "# " + "long " * 999 + "\n\n3,a,1e-400\n": ["3,a,0"],
    "9223372036854775807,a,-0\n": ["9223372036854775807,a,-0"],
    "0,a,nan\n".replace("0", "# not_finite=keep\n0", 1): ["0,a,nan"],
}


@pytest.mark.parametrize("text", FINE)
def test_what_is_an_event_is_played(pair, text):
    done = replays(pair, text)
    assert [x.replace("-nan", "nan") for x in done.stdout.split()] == FINE[text]
    assert done.returncode == (4 if "nan" in text else 0)


def test_a_last_line_without_an_end_is_said(pair):
    done = replays(pair, "0,a,1\n1,a,2")
    assert (done.returncode, done.stdout.split()) == (0, ["0,a,1", "1,a,2"])
    assert "line 2: no end of line; is the file whole?" in done.stderr


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0,n,2147483648\n", "too large"),
        ("0,n,1.0\n", "no whole number: 1.0"),
        ("0,n,--1\n", "no whole number"),
        ("0,long,9223372036854775808\n", "too large"),
        ("0,m,-1\n", "without a sign"),
        ("0,m,4294967296\n", "too large"),
        ("0,flag,2\n", "too large"),
        ("0,flag,true\n", "without a sign"),
    ],
)
def test_whole_numbers_and_flags_keep_to_their_kind(kind, text, said):
    done = replays(kind, text)
    assert done.returncode == 1
    assert said in done.stderr


def test_the_largest_whole_numbers_are_read(kind):
    text = "0,n,-2147483648\n0,long,-9223372036854775808\n0,m,4294967295\n0,flag,1\n"
    done = replays(kind, text)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [
        "0,n_out,-2147483648",
        "0,long_out,-9223372036854775808",
        "0,m_out,4294967295",
        "0,flag_out,1",
    ]


def test_as_many_numbers_as_a_vector_has(triple):
    assert replays(triple, "0,x,1,2,3\n").stdout == "0,y,2,4,6\n"
    assert "too few" in replays(triple, "0,x,1,2\n").stderr
    assert "too many" in replays(triple, "0,x,1,2,3,4\n").stderr


def test_it_is_called_with_a_file_and_a_seed(pair, tmp_path):
    file = pair.parent / "e.csv"
    file.write_text("0,a,1\n")
    assert ran(pair).returncode == 2
    for seed in ("", "x", "-1", "1 ", "99999999999999999999"):
        assert ran(pair, file, seed).returncode == 2
    assert ran(pair, file, "1", "2").returncode == 2
    assert ran(pair, file, "18446744073709551615").returncode == 0
    assert ran(pair, tmp_path / "missing.csv").returncode == 1
    assert ran(pair, tmp_path).returncode == 1, "a folder is no file"
    done = ran("sh", "-c", f"{pair} {file} > /dev/full")
    assert done.returncode == 1
    assert "cannot be written" in done.stderr


# -- how it ends ------------------------------------------------------------------------------------


@graph
def three_queues(a: Stream[Scalar], b: Stream[Scalar], c: Stream[Scalar]):
    return {
        "late": match(a, b, tolerance="1ms", size=6, name="late").map(lambda p: p[0]),
        "early": match(a, c, tolerance="1ms", size=2, name="early").map(lambda p: p[0]),
        "a": a,
    }


@graph
def second_queue(a: Stream[Scalar], b: Stream[Scalar]):
    return {"m": match(a, b, tolerance="1ms", size=3, name="m").map(lambda p: p[0] - p[1]), "b_out": b}


@graph
def windowed(a: Stream[Scalar], b: Stream[Scalar]):
    w = window(a, at=b, size=4, name="recent")
    return {"w": w.map(lambda w, *, xp: xp.sum(w.values)), "a_out": a}


@pytest.mark.parametrize(
    ("declared", "silent"), [(three_queues, ("b", "c")), (second_queue, ("a",)), (windowed, ("b",))]
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_first_overflow_in_time_ends_it(tmp_path, declared, silent, dtype):
    """With the outputs that Python gives before it, and the join that Python names."""
    built_graph = declared.build()
    busy = [n for n in built_graph.sources if n not in silent]
    data = {n: scalars(np.arange(12) * MS) for n in busy}
    data |= {n: scalars([20 * MS]) for n in silent}
    with pytest.raises(FifoOverflowError) as error:
        simulate(built_graph, data)
    time = int(str(error.value.got).split(" = ")[1].split()[0])
    before = {n: type(s)(s.time[s.time < time], s.value[s.time < time], name=n) for n, s in data.items()}
    wanted = simulate(built_graph, before)
    pipeline = lower(built_graph)
    write_c(pipeline, tmp_path, dtype)
    write_events(pipeline, data, tmp_path / "events.csv")
    done = ran(built(tmp_path), tmp_path / "events.csv")
    assert done.returncode == 3
    assert f"at t = {time} ns, {error.value.path}: {error.value.message}" in done.stderr
    rows = [line.split(",") for line in done.stdout.split()]
    for name, series in wanted.series.items():
        mine = [(int(t), float(x)) for t, n, x in rows if n == name]
        assert mine == pairs(series)
    assert rows, "the outputs before it are printed"


@graph
def root(x: Stream[Scalar]):
    return {"root": x.map(lambda v, *, xp: xp.sqrt(v)), "x_out": x}


@graph
def inverse(x: Stream[Scalar]):
    return {"v": x.map(lambda v: 1.0 / v)}


@graph
def some(x: Stream[Three]):
    return {"log": x.map(lambda v, *, xp: xp.log(v))}


@pytest.mark.parametrize(
    ("declared", "good", "bad"),
    [(root, "4", "-1"), (inverse, "2", "0"), (some, "1,2,3", "1,2,-3")],
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_an_output_that_is_not_finite_is_in_the_exit_status(tmp_path, declared, good, bad, dtype):
    write_c(lower(declared.build()), tmp_path, dtype)
    program = built(tmp_path)
    assert replays(program, f"0,x,{good}\n1,x,{good}\n").returncode == 0
    done = replays(program, f"0,x,{good}\n1,x,{bad}\n2,x,{good}\n3,x,{bad}\n")
    assert done.returncode == 4
    assert "first at t = 1 ns; in 2 ticks" in done.stderr
    assert {line.split(",")[0] for line in done.stdout.split()} == {"0", "1", "2", "3"}, "all is played"


def test_what_react_returns_says_both(tmp_path):
    """In a program of a user's own."""
    write_c(lower(paired.build()), tmp_path)
    (tmp_path / "main.c").write_text(
        """#include "paired.h"
#include <math.h>
#include <stdio.h>
static paired_state s;
static paired_a a;
static paired_sum sum;
static paired_a_2 out;
static int bit(uint64_t made, uint64_t which) { return (made & which) != 0; }
static void print(uint64_t made) {
    printf("%d%d%d ", bit(made, PAIRED_A_2), bit(made, PAIRED_NOT_FINITE), bit(made, PAIRED_OVERFLOW));
}
int main(void) {
    paired_reset(&s, 0);
    a.value = 1;
    print(paired_react(&s, 0, PAIRED_A, &a, NULL, &sum, &out));
    a.value = NAN;
    print(paired_react(&s, 1, PAIRED_A, &a, NULL, &sum, &out));
    a.value = 1;
    print(paired_react(&s, 2, PAIRED_A, &a, NULL, &sum, &out));
    print(paired_react(&s, 3, PAIRED_A, &a, NULL, &sum, &out));
    paired_reset(&s, 0);
    print(paired_react(&s, 4, PAIRED_A, &a, NULL, &sum, &out));
    return 0;
}
""".replace("#include <stdio.h>", "#include <stddef.h>\n#include <stdio.h>")
    )
    done = ran(built(tmp_path))
    assert done.stdout.split() == ["100", "110", "101", "101", "100"]


def test_the_engine_in_this_process_has_no_checks_of_its_own():
    """They are the player's; a tick there costs what it did."""
    pipeline = lower(paired.build())
    assert "fg_finite" in generate(pipeline).source
    assert "fg_finite" not in generate(pipeline, alone=False).source


def test_kept_nan_comes_back(tmp_path):
    """`write_events` says in the file that NaN is data; a recording without one says nothing."""
    pipeline = lower(root.build())
    write_c(pipeline, tmp_path)
    program = built(tmp_path)
    file = tmp_path / "events.csv"
    write_events(pipeline, {"x": arrays([0, 1], [4.0, np.nan], not_finite="keep")}, file)
    assert file.read_text().startswith("# not_finite=keep\n")
    done = ran(program, file)
    assert done.returncode == 4
    assert done.stdout.split()[0] == "0,root,2"
    write_events(pipeline, {"x": scalars([0, 1], [4.0, 9.0])}, file)
    assert file.read_text() == "0,x,4.0\n1,x,9.0\n"
