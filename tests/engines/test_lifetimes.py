"""What a tick computes is let go once nobody reads it: where, where not, and what a tick then takes."""

from __future__ import annotations

import tracemalloc

import numpy as np

from flowgraph import Scalar, Stream, block, graph, simulate
from flowgraph.engines.python.lifetimes import let_go, unread

LINES = """
w1_1 = x0_0 * x0_0
w1_2 = w1_1 + w1_1
if w1_9:
    w1_3 = w1_2 * w1_2
    w1_4 = w1_3 + w1_1
    w1_5 = w1_4
else:
    w1_5 = w1_2
if p1_0:
    w2_1 = w1_5 * w1_5
    w2_2 = w2_1 - w1_1
w3_1 = w1_5 @ w1_5
if p1_0:
    w3_2 = w2_2 + w3_1
    c0(w3_2)
r4_0, = w3_1,
""".strip().splitlines()


def test_a_variable_goes_with_its_last_reader_where_it_surely_is():
    arrays = {"w1_1", "w1_2", "w1_3", "w1_4", "w1_5", "w2_1", "w2_2", "w3_1", "w3_2"}
    made = let_go(["    " * 4 + line for line in LINES], arrays)
    assert "\n".join(line[16:] for line in made).splitlines() == [
        "w1_1 = x0_0 * x0_0",
        "w1_2 = w1_1 + w1_1",
        "if w1_9:",
        "    w1_3 = w1_2 * w1_2",
        "    w1_4 = w1_3 + w1_1; del w1_3",
        "    w1_5 = w1_4; del w1_4",
        "else:",
        "    w1_5 = w1_2",
        "if p1_0:",
        "    w2_1 = w1_5 * w1_5",
        "    w2_2 = w2_1 - w1_1; del w2_1",
        "w3_1 = w1_5 @ w1_5; del w1_1, w1_2, w1_5",
        "if p1_0:",
        "    w3_2 = w2_2 + w3_1",
        "    c0(w3_2); del w3_2",
        "r4_0, = w3_1,; del w3_1",
    ]  # w2_2 may not be there where it would go
    assert let_go(LINES, ()) == LINES
    assert let_go([], arrays) == []


def test_a_line_that_only_unread_lines_read_is_not_read():
    lines = [*LINES[:-3], "    w3_4 = a3(t)", "    w3_5, w3_6 = halves(w3_4)", LINES[-1]]
    dead = {lines[k].strip() for k in unread(lines)}
    assert dead == {"w2_1 = w1_5 * w1_5", "w2_2 = w2_1 - w1_1"}
    assert unread([]) == []


def test_a_tick_holds_no_more_arrays_than_are_read_later():
    size, turns = 20_000, 40

    @block
    def long_way(x: Scalar, *, xp) -> Scalar:
        moved = xp.ones((size,)) * x
        for k in range(turns):
            moved = xp.sin(moved) + float(k)
        return xp.sum(moved)

    @graph
    def g(x: Stream[Scalar]):
        return {"out": long_way(x)}

    made, inputs = g.build(), {"x": (np.arange(3), np.arange(3.0))}
    expected = simulate(made, inputs, engine="reference")["out"].value
    tracemalloc.start()
    try:
        found = simulate(made, inputs)["out"].value
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(found, expected)
    assert peak < 8 * 8 * size  # eight arrays; all would be eighty
