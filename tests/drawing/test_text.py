"""The drawing in plain text, compared as a whole; and its words, one by one."""

from __future__ import annotations

import textwrap

import numpy as np
import pytest

from flowgraph import (
    DeclarationError,
    Stream,
    aperiodic,
    every,
    graph,
    latest,
    match,
    merge,
    periodic,
    sink,
    zip_latest,
)
from flowgraph.drawing.text import draw_text, duration_words, initial_words, shorten, type_words
from flowgraph.language.graph import RegisterNode
from flowgraph.types import ArrayType, Scalar, type_of
from tests.drawn import Fix, Imu, core


@graph
def tracker(imu: Stream[Imu], fix: Stream[Fix]):
    """Follows a position."""
    belief, innovation = core(every(5, imu), fix)
    sink(innovation, print, name="display")
    return {"belief": belief}


WHOLE = """\
tracker: Follows a position.
│
├─ sources
│  ▷ imu  Imu  200 Hz
│  ▷ fix  Fix  ≤ 10 Hz
│
├─ blocks, in firing order
│   1 every   keeps a state
│       x            ◁─ imu               Imu         fresh
│       out          ─▷ core/control      Imu         every(5, imu)
│  ╭─ core
│  │   2 predict   at every(5, imu) | fix
│  │       belief    ◁╌ belief            Belief      held from the tick before
│  │       control   ◁─ control           Imu         held
│  │       out       ─▷ aid               Belief      at every(5, imu) | fix
│  │   3 aid
│  │       prior     ◁─ predict           Belief      fresh
│  │       measured  ◁─ fix               Fix         fresh or absent
│  │       belief    ─▷ belief, ● belief  Belief      at every(5, imu) | fix
│  │       out       ─▷ display           real[3], m  at fix
│  ╰─
│   4 display   on the host
│       value        ◁─ core/aid.out      real[3], m  fresh
│
├─ registers
│  ▪ every.state   state   int32   init 0      ◁╌ every
│  ▪ core/belief   delay   Belief  init zeros  ◁╌ core/aid.belief
│  ▪ core/control  latest  Imu     init given  ◁─ every
│
└─ outputs
   ● belief  ◁─ core/aid.belief  Belief  at every(5, imu) | fix
"""


def test_a_nested_graph_as_a_whole():
    drawn = draw_text(tracker.build(imu=periodic("5ms"), fix=aperiodic(max_rate=10)))
    assert drawn == WHOLE
    assert max(map(len, drawn.splitlines())) <= 100


def test_a_small_graph_as_a_whole():
    @graph
    def toy(a: Stream[Scalar], b: Stream[Scalar]):
        return a.map(lambda x: 2 * x + 1) + latest(b, init=0.5)

    assert toy.build(a=periodic("5ms"), b=periodic("25ms", jitter="1ms")).text() == textwrap.dedent(
        """\
        toy
        │
        ├─ sources
        │  ▷ a  real  200 Hz
        │  ▷ b  real  40 Hz, jitter 1 ms
        │
        ├─ blocks, in firing order
        │   1 map
        │       x    ◁─ a         real  fresh
        │       out  ─▷ add       real  at a
        │   2 add
        │       a    ◁─ map       real  fresh
        │       b    ◁─ latest    real  held
        │       out  ─▷ ● output  real  at a
        │
        ├─ registers
        │  ▪ latest  latest  real  init 0.5  ◁─ b
        │
        └─ outputs
           ● output  ◁─ add  real  at a
        """
    )


def test_fold_makes_one_line_of_a_nested_graph():
    built = tracker.build(imu=periodic("5ms"), fix=aperiodic(max_rate=10))
    blocks = built.text(fold=0).split("├─ registers")[0]
    assert "core: 2 blocks, folded" in blocks
    assert "predict" not in blocks
    assert built.text(fold=1) == built.text()
    with pytest.raises(DeclarationError, match="fold is a depth of nesting"):
        built.text(fold=-1)


@pytest.mark.parametrize("width", [30, 40, 72])
def test_on_a_narrow_page_lines_go_on_and_no_name_is_cut(width):
    built = tracker.build(imu=periodic("5ms"), fix=aperiodic(max_rate=10))
    drawn = built.text(width=width)
    assert max(map(len, drawn.splitlines())) <= width
    assert drawn.replace("│", " ").split() == built.text().replace("│", " ").split()


def test_a_long_name_is_whole():
    @graph
    def long(x: Stream[Scalar]):
        name = "a_name_of_more_than_a_hundred_characters_" * 3
        return {"first_output_that_is_long": x.map(lambda v: v, name=name), "x": x}

    text = long.build(x=periodic("5ms")).text()
    assert text.count("a_name_of_more_than_a_hundred_characters_" * 3) == 2
    assert text.replace("map(…)", "").count("…") == 0


def test_joins_say_their_bounds_and_what_is_present_when():
    @graph
    def joins(a: Stream[Scalar], b: Stream[Scalar]):
        paired = match(a, b, tolerance="2500us", size=6)
        return {
            "paired": paired, "kept": a.filter(lambda x: x > 3), "either": merge(a, b, tie="left"),
            "last": zip_latest(a, b, init=(0.0, 0.0)),
        }  # fmt: skip

    lines = draw_text(joins.build()).splitlines()
    assert "│   1 match   queues ≤ 6, within 2.5 ms   keeps a state" in lines
    assert any(line.startswith("   ● kept") and line.endswith("some of a") for line in lines)
    assert any(line.startswith("   ● either") and line.endswith("at a | b") for line in lines)
    assert "│   4 zip_latest   at a | b" in lines


def test_each_part_of_a_nested_graph_is_bracketed_once_where_it_is_left():
    @graph
    def inner(x: Stream[Scalar]):
        return x.map(lambda v: v + 1, name="up")

    @graph
    def outer(x: Stream[Scalar]):
        return inner(inner(x), name="second").map(lambda v: 2 * v, name="last")

    lines = draw_text(outer.build()).splitlines()
    shape = [line[3:].strip() for line in lines if "╭" in line or "╰" in line or " = map" in line]
    assert shape == [
        "╭─ inner",
        "│   1 up = map(…)",
        "╰─",
        "╭─ second",
        "│   2 up = map(…)",
        "╰─",
        "3 last = map(…)",
    ]


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.0, "0"), (1.5, "1.5"), (True, "True"), (np.int32(7), "7"), (np.zeros((2, 3)), "zeros"),
        (np.eye(4), "identity"), (np.ones(3), "given"), (Imu(np.zeros(3)), "zeros"),
        (Imu(np.ones(3)), "given"),
    ],
)  # fmt: skip
def test_initial_values_in_words(value, words):
    assert initial_words(RegisterNode("r", "delay", type_of(value), value)) == words


@pytest.mark.parametrize(
    ("nanoseconds", "words"),
    [(0, "0 ns"), (20, "20 ns"), (20_000, "20 us"), (5_000_000, "5 ms"), (1_500_000_000, "1.5 s")],
)
def test_durations_in_words(nanoseconds, words):
    assert duration_words(nanoseconds) == words


def test_types_in_words():
    assert type_words(ArrayType((3,), "real", "m/s", "world")) == "real[3], m/s, world"
    assert type_words(type_of((Imu(np.zeros(3)), 1.0))) == "(Imu, real)"
    assert type_words(type_of({"x": 1.0, "y": 2.0})) == "{x, y}"


def test_long_words_end_in_an_ellipsis():
    assert shorten("short", 10) == "short"
    assert shorten("at imu | position", 9) == "at imu…"
