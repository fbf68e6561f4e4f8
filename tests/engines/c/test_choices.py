"""What is rarely taken is computed only then, in single runs and in lanes, and takes nothing else with it."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest

from flowgraph import Array, Series, Signal, Stream, block, graph, lower, real, simulate
from flowgraph import simulate_many as many
from flowgraph.blocks.kalman.triangles import covariance_root
from flowgraph.engines.c import generate
from flowgraph.engines.c.lanes.source import WIDTH
from flowgraph.pipeline.optimise import COMPILED, optimise
from flowgraph.pipeline.optimise.aside import CHOOSE, LEAST_WORK, put_aside
from flowgraph.pipeline.program import specialise

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")

SIZE = 7


class Matrix(Signal):
    value: Array = real(SIZE, SIZE)


class Limited(Signal):
    value: Array = real(SIZE, SIZE)
    limit: Array = real()


class Solved(Signal):
    value: Array = real(3, 4)


class Pair(Signal):
    a: Array = real(3, 3)
    b: Array = real(3, 4)


@block
def rooted(given: Matrix, *, xp: Any) -> Matrix:
    return Matrix(value=covariance_root(given.value, xp=xp))


@graph
def roots(given: Stream[Matrix]):
    """The root of a covariance, and that of twice it."""
    return {"one": rooted(given), "two": rooted(given.map(lambda m: Matrix(value=2.0 * m.value)))}


@block
def doubted(given: Limited, *, xp: Any) -> Matrix:
    """The fourth power where the trace is above a limit, which is so rarely: the other side of a choice."""
    P = given.value
    often = xp.sum(P * xp.eye(SIZE)) > given.limit
    return Matrix(value=xp.where(often, (P @ P) @ (P @ P), P))


@graph
def powers(given: Stream[Limited]):
    return {"power": doubted(given)}


@block
def solve_it(given: Pair, *, xp: Any) -> Solved:
    return Solved(value=xp.linalg.solve(given.a, given.b))


@graph
def solving(given: Stream[Pair]):
    return {"x": solve_it(given)}


def covariances(seed: int, n: int = 12) -> np.ndarray:
    """Every third has a rank of two, and one is zero."""
    draw = np.random.default_rng(seed)
    found = draw.normal(size=(n, SIZE, SIZE + 2))
    found[seed % 3 :: 3, :, 2:] = 0.0
    found[-1] = 0.0
    return found @ np.swapaxes(found, -1, -2)


def series(values: np.ndarray) -> Series:
    return Series(np.arange(len(values)) * 1_000_000, Matrix(value=values))


def program_of(built: Any) -> Any:
    return specialise(lower(built), (1 << len(lower(built).inputs)) - 1)


@pytest.mark.parametrize("engine", ["reference", "c"])
def test_a_root_is_one_whether_the_choice_is_taken_or_not(engine):
    P = covariances(0)
    found = simulate(roots.build(), {"given": series(P)}, engine=engine)
    one, two = found["one"].value, found["two"].value
    np.testing.assert_allclose(one @ one.mT, P, atol=1e-7)  # of what is singular, half the digits
    np.testing.assert_allclose(two @ two.mT, 2.0 * P, atol=1e-7)
    np.testing.assert_allclose(one[1], np.linalg.cholesky(P[1]), rtol=1e-12, atol=1e-12)


def test_in_lanes_each_takes_its_own():
    runs = [{"given": series(covariances(k))} for k in range(WIDTH + 1)]
    built = roots.build()
    batch = many(built, runs, range(len(runs)), engine="c")
    other = many(built, runs[::-1], range(len(runs)), engine="c")
    for k, given in enumerate(runs):
        alone = simulate(built, given, engine="c")
        for name in ("one", "two"):
            np.testing.assert_allclose(batch[name].value[k], alone[name].value, rtol=1e-9, atol=1e-9)
            np.testing.assert_array_equal(batch[name].value[k], other[name].value[len(runs) - 1 - k])


def test_choices_that_do_the_same_are_one_function():
    pipeline = lower(roots.build())
    text = generate(pipeline, tidy=lambda p: optimise(p, COMPILED)).source
    assert text.count("static FG_APART void fg_choice_") == 1
    assert text.count("fg_choice_") == 3  # and two calls


def test_either_side_may_be_the_rare_one():
    P, limits = covariances(1), np.resize([0.0, 1e9], 12)
    built = powers.build()
    program, choices = put_aside(program_of(built))
    assert [i.attrs["truth"] for i in program.instructions if i.op == CHOOSE] == [True]
    assert choices[0].program.work >= LEAST_WORK
    given = Series(np.arange(12) * 1_000_000, Limited(value=P, limit=limits))
    found = simulate(built, {"given": given}, engine="c")["power"].value
    expected = np.where((np.trace(P, axis1=1, axis2=2) > limits)[:, None, None], P @ P @ P @ P, P)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)


def test_what_serves_something_else_stays():
    @block
    def both(given: Limited, *, xp: Any) -> Matrix:
        P = given.value
        fourth = (P @ P) @ (P @ P)
        return Matrix(value=xp.where(given.limit > 0.0, fourth, P) + 1e-3 * fourth)

    @block
    def little(given: Limited, *, xp: Any) -> Matrix:
        return Matrix(value=xp.where(given.limit > 0.0, 2.0 * given.value, given.value))

    @graph
    def two(given: Stream[Limited]):
        return {"a": both(given), "b": little(given)}

    @block
    def alike(given: Limited, *, xp: Any) -> Matrix:
        fourth = (given.value @ given.value) @ (given.value @ given.value)
        return Matrix(value=xp.where(given.limit > 0.0, fourth, fourth))

    @graph
    def same(given: Stream[Limited]):
        return {"a": alike(given)}

    for built in (two.build(), same.build()):
        program = program_of(built)
        assert put_aside(program) == (program, [])
    held = program_of(powers.build())
    last = next(i.args[1] for i in held.instructions if i.op == "where" and i.spec.shape == (SIZE, SIZE))
    assert put_aside(held, (last,))[1] == []


A = np.array(
    [
        [[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 3.0]],  # symmetric positive
        [[0.0, 1.0, 0.0], [1.0, 0.0, 2.0], [0.0, 2.0, 1.0]],  # rows must be exchanged
        [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, -1.0]],  # symmetric, not positive
        [[1e-14, 1.0, 0.0], [-1.0, 1.0, 1.0], [0.0, 1.0, 1.0]],  # positive pivots, not symmetric
        [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [3.0, 6.0, 9.0]],  # singular
    ]
)


def test_only_a_symmetric_positive_matrix_is_solved_without_exchange_of_rows():
    b = np.random.default_rng(0).normal(size=(WIDTH, len(A), 3, 4))
    orders = [np.roll(np.arange(len(A)), k) for k in range(WIDTH)]
    built = solving.build()
    time = np.arange(len(A)) * 1_000_000
    runs = [{"given": Series(time, Pair(a=A[o], b=b[k]))} for k, o in enumerate(orders)]
    batch = many(built, runs, range(WIDTH), engine="c", diverged="count")
    for k, (given, order) in enumerate(zip(runs, orders, strict=True)):
        alone = simulate(built, given, engine="c", diverged="count")["x"].value
        for t, which in enumerate(order):
            if which == 4:
                assert np.isnan(alone[t]).all()
                assert np.isnan(batch["x"].value[k, t]).all()
                continue
            expected = np.linalg.solve(A[which], b[k, t])
            np.testing.assert_allclose(alone[t], expected, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(batch["x"].value[k, t], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("rows", "inner", "columns"), [(15, 30, 15), (30, 6, 15), (5, 40, 3), (17, 13, 25), (9, 12_345, 4)]
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_products_by_blocks_of_rows(rows, inner, columns, dtype):
    """The last also by parts of the sum, since what is laid out for vectors lies on the stack."""

    class Factors(Signal):
        a: Array = real(rows, inner)
        b: Array = real(inner, columns)

    class Product(Signal):
        value: Array = real(rows, columns)

    @block
    def product(given: Factors) -> Product:
        return Product(value=given.a @ given.b)

    @graph
    def g(given: Stream[Factors]):
        return {"product": product(given)}

    draw = np.random.default_rng(rows)
    a, b = draw.normal(size=(2, rows, inner)), draw.normal(size=(2, inner, columns))
    given = Series(np.arange(2) * 1_000_000, Factors(a=a, b=b))
    found = simulate(g.build(), {"given": given}, engine="c", dtype=dtype)["product"].value
    bound = (1e-12 if dtype == "float64" else 1e-4) * max(1.0, inner / 100)
    np.testing.assert_allclose(found, a @ b, atol=bound)
