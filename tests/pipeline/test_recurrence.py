"""What of a program needs the tick before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import Graph, Scalar, Stream, apply, graph, latest, lower, real, scan
from flowgraph.pipeline.program import Program, specialise
from flowgraph.pipeline.recurrence import Parts, parts


def taken_apart(g: Any) -> tuple[Program, Parts]:
    pipeline = lower(g.build())
    program = specialise(pipeline, None)
    return program, parts(program, pipeline)


@graph
def held(a: Stream[Scalar], b: Stream[Scalar]):
    """Nothing but the last value of the other stream, mapped."""
    return {"sum": a.map(lambda x: 2.0 * x) + latest(b.map(lambda x: x + 0.5), init=0.0)}


@graph
def folded(a: Stream[Scalar], b: Stream[Scalar]):
    """A fold between a map before it and one after it, and a value that is held."""
    fold = scan(a.map(lambda x: 3.0 * x - 1.0), lambda y, x: 0.9 * y + x, init=0.0)
    return {"out": fold.map(lambda y: y * y) + latest(b, init=0.0)}


@graph
def held_twice(a: Stream[Scalar], b: Stream[Scalar]):
    """What is held comes of a fold, which is none of an input alone."""
    return {"out": apply(lambda x, y: x - y, a, latest(scan(b, lambda y, x: y + x, init=0.0), init=1.0))}


@graph
def read_before(a: Stream[Scalar], b: Stream[Scalar]):
    """The last value and the one before: a delay is read as it was."""
    return {"out": apply(lambda x, y: x - y, a, a.delay(0.5)), "other": b}


def operations(instructions: Any) -> list[str]:
    return [i.op for i in instructions]


def test_what_an_input_had_last_is_no_recurrence():
    program, found = taken_apart(held)
    assert found.held == (0,)
    assert (found.carried, found.around, found.after, found.into, found.made) == ((),) * 5
    assert found.share == 0.0
    (selection,) = (i for i in found.before if i.op == "where")
    assert selection.args[0] == found.seen[1] == -2, "of the second input, since when it was there"
    assert selection.out == program.writes[0]


def test_a_fold_goes_tick_by_tick_and_what_is_around_it_does_not():
    _, found = taken_apart(folded)
    assert len(found.carried) == len(found.held) == 1
    assert operations(found.around) == ["multiply", "add", "where"]
    assert "subtract" in operations(found.before)
    assert operations(found.after) == ["multiply", "add"]
    assert 0.2 < found.share < 0.5


@pytest.mark.parametrize("g", [held_twice, read_before])
def test_what_is_more_than_the_last_of_an_input_is_carried(g):
    program, found = taken_apart(g)
    assert not found.held
    assert found.carried == tuple(range(len(program.reads)))


@pytest.mark.parametrize("g", [held, folded, held_twice, read_before])
def test_the_parts_can_be_computed_one_after_the_other(g):
    program, found = taken_apart(g)
    order = [*found.before, *found.around, *found.after]
    assert sorted(i.out for i in order) == sorted(i.out for i in program.instructions)
    carried = {program.reads[p] for p in found.carried}
    made = {i.out for i in program.instructions}
    inside = carried | {i.out for i in found.around}
    there: set[int] = set()
    for i in order:
        if i in found.before:
            assert not carried.intersection(i.args)
        elif i in found.around:
            assert set(i.args) <= inside | set(found.into) | program.constants.keys()
        else:
            assert set(i.args) & inside <= set(found.made)
        assert set(i.args) & (made - {program.reads[p] for p in found.held}) <= there
        there.add(i.out)
    assert {program.writes[p] for p in found.carried} <= inside | set(found.into) | program.constants.keys()


def test_a_vector_of_an_input_is_held_leaf_by_leaf():
    @graph
    def g(a: Stream[Scalar], v: Stream[real(3)]):  # type: ignore[valid-type]
        return {"out": apply(lambda x, u: x + u[0] * u[2], a, latest(v, init=np.ones(3)))}

    pipeline = lower(built(g))
    found = parts(specialise(pipeline, None), pipeline)
    assert len(found.held) == len(pipeline.registers[0].cells)
    assert not found.carried


def built(g: Any) -> Graph:
    made: Graph = g.build()
    return made
