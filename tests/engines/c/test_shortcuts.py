"""What C computes by another way than it is written: sines of an angle and its half, tables, extremes."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest

from flowgraph import Stream, arrays, block, graph, lower, real, simulate
from flowgraph.engines.c import generate
from flowgraph.engines.c.tables import join_tables
from flowgraph.pipeline.program import specialise

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


def in_c(work: Any, kind: Any, values: np.ndarray) -> dict[str, np.ndarray]:
    """The leaves at the one tick, and the same of the reference interpreter, by name."""

    @graph
    def g(x: Stream[kind]):  # type: ignore[valid-type]
        return work(x)

    data = {"x": arrays(np.arange(1), values[None], not_finite="keep")}
    wanted = simulate(g.build(), data, engine="reference", diverged="count").output.leaves
    found = simulate(g.build(), data, engine="c", diverged="count").output.leaves
    return {name: (found[name][0], wanted[name][0]) for name in wanted}  # type: ignore[misc]


@pytest.mark.parametrize("many", [5, 80])  # straight code, and a loop
def test_the_sinc_of_an_angle_comes_from_that_of_its_half(many):
    edges = [0.0, -1e-320, 1e-31, np.pi, 2.0 * np.pi, np.nan]
    values = np.concatenate([edges, np.random.default_rng(0).normal(size=74) * 9.0])
    values = values[1:6] if many == 5 else values

    @block
    def work(x: real(many), *, xp):  # type: ignore[valid-type]
        half = xp.unnormalized_sinc(0.5 * x)
        return half, xp.unnormalized_sinc(x), xp.unnormalized_sinc(x * 2.0)

    @graph
    def g(x: Stream[real(many)]):  # type: ignore[valid-type]
        return work(x)

    assert "cos(" in generate(lower(g.build())).source
    for found, wanted in in_c(work, real(many), values).values():
        np.testing.assert_allclose(found, wanted, rtol=4e-16, atol=4e-17)


@pytest.mark.parametrize("many", [4, 64])
def test_extremes_with_a_known_number_keep_what_is_none(many):
    """NaN wins from either side."""
    values = np.resize([np.nan, -0.0, 2.0, -3.0], many)

    @block
    def work(x: real(many), *, xp):  # type: ignore[valid-type]
        known = xp.asarray([1.0, 0.0, 0.0, 0.0] * (many // 4))
        one = xp.asarray(1.0)
        return (
            xp.maximum(x, one),
            xp.maximum(one, x),
            xp.minimum(x, one),
            xp.minimum(one, x),
            (
                xp.maximum(x, known),
                xp.minimum(known, x),
            ),
        )

    for found, wanted in in_c(work, real(many), values).values():
        np.testing.assert_array_equal(found, wanted)


FIRST, SECOND = (np.arange(5, dtype=np.int32) - 2) * 2**29, np.arange(5, dtype=np.int32)[::-1] - 3


def looked_up(many: int, other: int = 5):
    @block
    def work(x: real(many), *, xp):  # type: ignore[valid-type]
        at = xp.astype(x, xp.int32)
        again = xp.asarray(np.arange(other, dtype=np.int32) * 7)
        parts = (xp.take(np.asarray(t), at, axis=0) for t in (FIRST, SECOND, again, FIRST))
        return tuple(xp.astype(p, xp.float64) for p in parts)

    @graph
    def g(x: Stream[real(many)]):  # type: ignore[valid-type]
        return work(x)

    return work, g.build()


def takes(program: Any) -> list[str]:
    return [str(program.constants[i.args[0]].dtype) for i in program.instructions if i.op == "take"]


def test_tables_of_one_place_are_one_in_loops():
    """Equal numbers, negative ones and places outside too; a third table stays by itself."""
    values = np.linspace(-2.0, 7.0, 40)
    work, built = looked_up(40)
    plain = specialise(lower(built), 1)
    joined = join_tables(plain)
    assert takes(plain).count("int32") > takes(joined).count("int32")
    assert "int64" in takes(joined)
    for found, wanted in in_c(work, real(40), values).values():
        np.testing.assert_array_equal(found, wanted)


def test_tables_stay_where_joining_them_gains_nothing():
    """Few places, or tables of two lengths."""
    few = specialise(lower(looked_up(8)[1]), 1)
    assert join_tables(few) is few
    program = join_tables(specialise(lower(looked_up(40, other=6)[1]), 1))
    assert sorted(set(takes(program))) == ["int32", "int64"]
