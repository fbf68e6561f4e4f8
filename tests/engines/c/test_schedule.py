"""Loops over many particles keep no more than a later one needs, and search in a loop of their own."""

import re

import numpy as np
import pytest

from flowgraph import Array, Scalar, Series, Signal, Stream, aperiodic, block, graph, lower, real, simulate
from flowgraph.engines.c.source import generate

N = 600
GIVEN = {"x": Series(np.arange(4) * 10, [0.3, -1.0, 2.0, 40.0])}


class Row(Signal):
    """A number of each particle."""

    value: Array = real(N)


def moved(*, last: bool):
    """A cloud that moves; its output is the place of one particle, and with `last` of the last one too."""

    @block
    def move(state, x: Scalar, *, xp) -> tuple[Scalar, Scalar]:
        there = xp.sin(state + x)
        return there, there[7] + (there[-1] if last else 0.0)

    @move.init
    def _(x):
        return np.linspace(0.0, 3.0, N)

    @graph
    def cloud(x: Stream[Scalar]):
        return move(x)

    return cloud.build(x=aperiodic())


@pytest.mark.parametrize("last", [False, True])
def test_one_number_is_read_where_the_loop_keeps_it(last):
    built = moved(last=last)
    source = generate(lower(built))
    assert "fg_work_real" not in source.header
    right = simulate(built, GIVEN, engine="python").output.leaves["value"]
    np.testing.assert_allclose(simulate(built, GIVEN, engine="c").output.leaves["value"], right, rtol=1e-12)


def found(side: str, kind: str):
    """Where numbers that move with x belong among sorted ones, in order of their own and not, and more."""

    @block
    def look(x: Scalar, *, xp) -> tuple[Row, Scalar]:
        table = xp.cumulative_sum(xp.asarray(np.arange(N) % 5 * 1.0), axis=0)
        if kind == "nan":
            table = xp.where(xp.asarray(np.arange(N)) < N - 50, table, np.nan)
        asked = xp.asarray(np.linspace(-3.0, 1300.0, N)) + x
        if kind == "mixed":
            asked = xp.asarray(np.where(np.arange(N) % 11, np.arange(N) * 37 % 1201, np.nan)) + xp.floor(x)
        place = xp.searchsorted(table, asked, side=side)
        weight = xp.where(xp.isnan(asked), 0.5, xp.sin(asked))
        return Row(xp.astype(place, xp.float64)), xp.sum(weight * xp.astype(place, xp.float64))

    @graph
    def looked(x: Stream[Scalar]):
        row, total = look(x)
        return {"row": row, "total": total}

    return looked.build(x=aperiodic())


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("kind", ["sorted", "mixed", "nan"])
def test_a_search_goes_on_from_the_last_one(side, kind):
    built = found(side, kind)
    right, here = (simulate(built, GIVEN, engine=e) for e in ("python", "c"))
    assert np.array_equal(here["row"].leaves["value"], right["row"].leaves["value"])
    np.testing.assert_allclose(here["total"].leaves["value"], right["total"].leaves["value"], rtol=1e-11)


def test_a_search_has_a_loop_of_its_own():
    text = generate(lower(found("right", "sorted"))).source
    loops = re.findall(r"(FG_SIMD[^\n]*\n)?    for \(int32_t i0 = 0[^\n]*\n(.*?)\n    \}\n", text, re.DOTALL)
    (search,) = [(simd, body) for simd, body in loops if "fg_search_near_" in body]
    assert not search[0]
    assert "fg_sin" not in search[1]
    assert any("fg_sin" in body and "reduction(+" in simd for simd, body in loops)


@pytest.mark.parametrize("kept", ["state", "table"])
def test_what_is_stored_after_a_search_is_not_read_there_before(kept):
    """The numbers that are looked up are also a register's, or those among which the most is sought."""

    @block
    def look(state, x: Scalar, *, xp) -> tuple[Row, Scalar]:
        asked = xp.abs(xp.sin(state + x))
        place = xp.astype(xp.searchsorted(xp.asarray(np.linspace(0.0, 1.0, N)), asked), xp.float64)
        if kept == "state":
            return asked, xp.sum(xp.cos(place) * asked)
        return xp.sin(place + x), place[xp.argmax(asked)] + xp.sum(asked)

    @look.init
    def _(x):
        return np.linspace(0.0, 3.0, N)

    @graph
    def looked(x: Stream[Scalar]):
        return look(x)

    built = looked.build(x=aperiodic())
    right = simulate(built, GIVEN, engine="python").output.leaves["value"]
    np.testing.assert_allclose(simulate(built, GIVEN, engine="c").output.leaves["value"], right, rtol=1e-9)
