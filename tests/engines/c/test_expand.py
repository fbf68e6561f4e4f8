"""Every instruction in C gives what the reference interpreter gives, unrolled, in one lane and in several."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    Scalar,
    Series,
    Signal,
    Stream,
    block,
    graph,
    integer,
    latest,
    lower,
    real,
    simulate,
)
from flowgraph.engines.c import generate
from flowgraph.engines.c.expand import _RULES
from flowgraph.pipeline.optimise import optimise, without
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import ELEMENTWISE, OPS

SHAPES = [(3, 4), (20,), (3, 20), (20, 3), (9, 9), (2, 18, 19)]


def outputs(x: Any, y: Any, n: Any, xp: Any) -> dict[str, Any]:
    """Everything that takes arrays of any shape: x and y real of one shape, n whole numbers of it."""
    positive = xp.abs(x) + 0.5
    found = {
        f: getattr(xp, f)(x) for f in ("exp", "expm1", "sin", "cos", "tan", "atan", "sinh", "cosh", "tanh")
    }
    found |= {"sinc": xp.unnormalized_sinc(xp.concat([0.0 * x[:1], x[1:]], axis=0))}
    found |= {f: getattr(xp, f)(positive) for f in ("log", "log1p", "log2", "sqrt")}
    found |= {f: getattr(xp, f)(xp.tanh(x)) for f in ("asin", "acos")}
    found |= {
        f: getattr(xp, f)(x) for f in ("floor", "ceil", "round", "trunc", "abs", "sign", "negative", "square")
    }
    for f in (
        "atan2",
        "hypot",
        "copysign",
        "maximum",
        "minimum",
        "remainder",
        "floor_divide",
        "add",
        "divide",
    ):
        found[f] = getattr(xp, f)(x, y)
    found |= {"pow": positive**y, "square_by_pow": x**2.0, "root_by_pow": positive**0.5}
    found |= {
        "less": x < y,
        "equal": n == 3,
        "not": xp.logical_not(x < y),
        "xor": xp.logical_xor(x < y, x < 0.0),
    }
    found |= {"isnan": xp.isnan(x / (x - x)), "isfinite": xp.isfinite(x / (x - x))}
    found |= {"n_add": n + n, "n_divide": n // 3, "n_rest": n % -3, "n_times": n * n * 2**40, "n_pow": n**3}
    found |= {
        "n_and": n & 5,
        "n_or": n | 8,
        "n_xor": n ^ 3,
        "n_invert": ~n,
        "n_left": n << 3,
        "n_right": n >> 1,
    }
    found |= {
        "n_shift": n >> n,
        "whole": xp.astype(x * 10.0, xp.int32),
        "unsigned": xp.astype(n, xp.uint32) * 3,
    }
    found |= {
        "where": xp.where(x < y, x, 2.0),
        "is_zero": xp.astype(n, xp.bool),
        "real": xp.astype(n, xp.float64),
    }
    for f in ("sum", "prod", "max", "min", "mean"):
        found[f] = getattr(xp, f)(x * 0.5)
        found[f"{f}_first"] = getattr(xp, f)(x, axis=0)
        found[f"{f}_last"] = getattr(xp, f)(x, axis=-1, keepdims=True)
    found |= {
        "any": xp.any(x > 1.0),
        "all": xp.all(x > -9.0, axis=0),
        "count": xp.sum(n),
        "no_nan": xp.max(n),
    }
    found |= {
        "argmax": xp.argmax(x),
        "argmin": xp.argmin(x, axis=-1),
        "sort": xp.sort(x),
        "order": xp.argsort(n),
    }
    found |= {"so_far": xp.cumulative_sum(x, axis=0), "flip": xp.flip(x), "roll": xp.roll(x, 2)}
    found |= {"roll_last": xp.roll(n, 1, axis=-1), "flat": xp.reshape(x, (-1,)), "every_second": x[::2]}
    found |= {"last": x[-1] * 2.0, "backwards": x[..., ::-1], "one": x[..., :1], "wide": x[None] + y}
    found |= {"stack": xp.stack([x, y]), "stack_last": xp.stack([x, y], axis=-1), "concat": xp.concat([x, y])}
    found |= {"concat_last": xp.concat([x, y], axis=-1), "taken": xp.take(x, n % 3, axis=0)[..., 0]}
    found |= {"moved": xp.permute_dims(x, tuple(range(x.ndim))[::-1]), "kept": xp.linalg.vecdot(x, y)}
    steps = np.linspace(-2.0, 2.0, 40)
    found |= {"search": xp.searchsorted(xp.asarray(steps), x)}
    found |= {"scaled": x * np.arange(x.shape[-1]), "table": xp.take(np.arange(7.0) ** 2, n, axis=0)}
    if x.ndim > 1:
        found |= {
            "transposed": x.mT,
            "gram": x @ y.mT,
            "product": x.mT @ y,
            "by_vector": x @ x[..., 0, :, None],
        }
        found |= {
            "lower": xp.tril(x),
            "upper": xp.triu(x, k=1),
            "cross": xp.linalg.cross(x[..., :3], y[..., :3]),
        }
        spread = x @ x.mT + 3.0 * np.eye(x.shape[-2])
        found |= {"factor": xp.linalg.cholesky(spread), "solved": xp.linalg.solve(spread, y)}
        found |= {
            "turned": x.mT + 1.0,
            "sparse": (np.eye(x.shape[-2]) * 2.0) @ x,
            "broadcast": x[..., :1] + y,
        }
    else:
        found |= {"outer": xp.linalg.outer(x, y[:5]), "dot": x @ y, "column": x[:, None] * y[None, :6]}
    return found


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_instructions_agree_with_the_reference(shape):
    class Given(Signal):
        x: Array = real(*shape)
        y: Array = real(*shape)
        n: Array = integer(*shape, dtype="int64")

    @block
    def work(given: Given, *, xp):
        return tuple(outputs(given.x, given.y, given.n, xp).values())

    @graph
    def g(given: Stream[Given]):
        return work(given)

    random = np.random.default_rng(3)
    size = (4, *shape)
    data = Given(random.normal(size=size) * 2.0, random.normal(size=size), random.integers(0, 7, size=size))
    names = list(outputs(data.x[0], data.y[0], data.n[0], NUMPY))
    built = g.build()
    wanted = simulate(built, {"given": Series(np.arange(4), data)}, engine="reference")
    got = simulate(built, {"given": Series(np.arange(4), data)}, engine="c")
    assert len(names) > 80
    for name, leaf in zip(names, wanted.output.leaves, strict=True):
        a, b = wanted.output.leaves[leaf], got.output.leaves[leaf]
        assert (a.dtype, a.shape) == (b.dtype, b.shape), name
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9, err_msg=name)


def test_every_instruction_has_a_rule():
    assert set(OPS) == {*ELEMENTWISE, *_RULES, "replay"}


def test_functions_for_lanes_are_exact_at_their_edges():
    """exp, log, sin, cos and atan2 have a form of their own in loops."""
    edges = [
        0.0,
        -0.0,
        1e-320,
        1.0,
        -1.0,
        np.pi,
        1e-300,
        708.5,
        -707.5,
        709.7,
        -800.0,
        1e5,
        -1e6,
        1.5e6,
        0.5,
        800.0,
    ]
    values = np.concatenate([edges, np.random.default_rng(0).normal(size=184) * 30.0])

    @block
    def work(x: real(200), *, xp):  # type: ignore[valid-type]
        y = x[::-1]
        return xp.exp(x), xp.log(x), xp.log(xp.abs(x)), xp.sin(x), xp.cos(x), xp.atan2(y, x)

    @graph
    def g(x: Stream[real(200)]):  # type: ignore[valid-type]
        return work(x)

    built, data = g.build(), {"x": Series(np.arange(1), values[None])}
    wanted = simulate(built, data, engine="reference", diverged="count").output.leaves
    for leaf, got in simulate(built, data, engine="c", diverged="count").output.leaves.items():
        np.testing.assert_allclose(got, wanted[leaf], rtol=1e-15, atol=1e-15, err_msg=leaf)


def test_functions_for_lanes_in_single_precision():
    """They come as near as a float does: to a few parts in ten million of the double's, or of one."""
    edges = [0.0, -0.0, 1.0, -1.0, np.pi, 1e-30, 2e-38, 88.0, -87.0, 88.7, -90.0, 1e4, -9.9e4, 0.5, 100.0]
    random = np.random.default_rng(0)
    values = np.concatenate([edges, random.normal(size=200) * 30.0, 10.0 ** random.uniform(-30, 4, 185)])
    values = values.astype(np.float32).astype(float)

    @block
    def work(x: real(400), *, xp):  # type: ignore[valid-type]
        y = x[::-1]
        return xp.exp(x), xp.log(x), xp.sin(x), xp.cos(x), xp.atan2(y, x), xp.atan2(x, y)

    @graph
    def g(x: Stream[real(400)]):  # type: ignore[valid-type]
        return work(x)

    built, data = g.build(), {"x": Series(np.arange(1), values[None])}
    wanted = simulate(built, data, engine="reference", diverged="count").output.leaves
    for leaf, got in simulate(
        built, data, engine="c", dtype="float32", diverged="count"
    ).output.leaves.items():
        with np.errstate(over="ignore"):
            right = wanted[leaf].astype(np.float32)
        np.testing.assert_allclose(got, right, rtol=3e-7, atol=1.5e-7, err_msg=leaf)


def test_exp_in_single_precision_is_right_down_to_where_it_is_zero():
    """Relative to itself: what it gives is as small as 1e-38."""
    values = np.linspace(-86.97, -80.0, 64).astype(np.float32).astype(float)

    @block
    def small(x: real(64), *, xp):  # type: ignore[valid-type]
        return xp.exp(x), xp.exp(x - 1.0)

    @graph
    def g(x: Stream[real(64)]):  # type: ignore[valid-type]
        return small(x)

    built, data = g.build(), {"x": Series(np.arange(1), values[None])}
    near, below = simulate(built, data, engine="c", dtype="float32").output.leaves.values()
    np.testing.assert_allclose(near[0], np.exp(values), rtol=3e-7)
    assert below[0, 0] == 0.0


def test_two_products_of_one_factor_compile_with_scalars_made_between_them():
    """The second could name a scalar of its factor that was not there at the first."""

    @block
    def work(x: Scalar, *, xp):
        v = x * xp.arange(12, dtype=x.dtype) * 0.1 + 0.3
        F = xp.asarray(np.eye(12)) * xp.cos(v)
        first = F @ xp.sin(xp.reshape(xp.arange(144, dtype=x.dtype), (12, 12)) + x)
        c = xp.cos(v[3])
        return xp.sum(F @ (first * c)) + c

    @graph
    def g(x: Stream[Scalar]):
        return work(x)

    built, data = g.build(), {"x": Series(np.arange(3), np.linspace(0.1, 1.0, 3))}
    wanted = simulate(built, data, engine="reference").output.value
    for passes in (("sparse",), None):
        found = simulate(built, data, engine="c", passes=passes).output.value
        np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_a_sine_that_cannot_be_told_exactly_is_not_a_number():
    @graph
    def g(x: Stream[real(20)]):  # type: ignore[valid-type]
        return turned(x)

    @block
    def turned(x: real(20), *, xp):  # type: ignore[valid-type]
        return xp.sin(x)

    inputs = {"x": Series(np.arange(1), np.full((1, 20), 1e9))}
    for dtype in ("float64", "float32"):  # in a loop, not one by one
        found = simulate(
            g.build(), inputs, engine="c", dtype=dtype, passes=without("unroll"), diverged="count"
        )
        assert np.isnan(found.output.value).all()


def told():
    """A product whose left factor is a navigation filter's: zeros, ones, and numbers made in the step."""

    class Given(Signal):
        dt: Array = real()
        block: Array = real(3, 3)
        P: Array = real(12, 12)

    @block
    def work(given: Given, *, xp):
        fixed = xp.asarray(np.eye(12, 9)) + xp.asarray(np.eye(12, 9, k=3)) * given.dt
        zero = 0.0 * given.block
        pull = xp.concat([zero, given.block * given.dt, zero, given.block], axis=-2)
        F = xp.concat([fixed, pull], axis=-1)
        return F @ given.P, given.P @ F.mT, F @ (given.P + given.P.mT) @ F.mT

    @graph
    def g(given: Stream[Given]):
        return work(given)

    random = np.random.default_rng(1)
    data = Given(random.normal(size=4), random.normal(size=(4, 3, 3)), random.normal(size=(4, 12, 12)))
    return g.build(), {"given": Series(np.arange(4), data)}


@pytest.mark.parametrize("off", [(), ("mirror",), ("sparse",), ("unroll",), ("algebra", "fold")])
def test_products_with_zeros_give_the_same(off):
    built, data = told()
    wanted = simulate(built, data, engine="reference").output.leaves
    for leaf, got in simulate(built, data, engine="c", passes=without(*off)).output.leaves.items():
        np.testing.assert_allclose(got, wanted[leaf], rtol=1e-12, atol=1e-12, err_msg=leaf)


def test_products_with_zeros_multiply_what_is_there():
    def code(passes):
        pipeline = lower(told()[0])
        return generate(pipeline, tidy=lambda program: optimise(program, passes)).source

    passes = without("structure", "symmetry")
    skipping, whole = code(passes), code(without("sparse", "mirror", passes=passes))
    assert "fg_matmul_" in whole
    assert "fg_matmul_" not in skipping
    assert skipping.count(" * v") < 4 * 12 * 5  # four products; at most five numbers in a row, one of them 1


def test_arrays_in_order_take_one_loop():
    @block
    def work(x: real(9, 9), y: real(9, 9), *, xp):  # type: ignore[valid-type]
        return xp.exp(x) * y + 1.0, x + y.mT

    @graph
    def g(x: Stream[real(9, 9)], y: Stream[real(9, 9)]):  # type: ignore[valid-type]
        return work(x, latest(y, init=np.zeros((9, 9))))

    text = generate(lower(g.build())).source
    assert "< 81; i0++" in text  # the first
    assert "< 9; i1++" in text  # the second, which reads y across
