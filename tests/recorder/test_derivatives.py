"""Derivatives: every operation's rule against central differences, in NumPy and recorded, with and without
leading axes; what loses a derivative is refused by line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    Array,
    DeclarationError,
    LoweringError,
    Signal,
    Stream,
    block,
    collect,
    graph,
    jacobian,
    real,
)
from flowgraph.blocks.geometry.rotations import from_rotation_vector, normalize, to_rotation_vector
from flowgraph.recorder.dual_rules import RULES
from flowgraph.recorder.namespaces import NUMPY, solve_positive
from flowgraph.recorder.ops import OPS, Spec, bound_attrs
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.trace import Trace

A = np.random.default_rng(3).uniform(-1.0, 1.0, (6, 6))
T = np.random.default_rng(4).uniform(-1.0, 1.0, (6, 9))


def grid(x: Any, xp: Any) -> Any:
    """A matrix (..., 3, 3) of numbers that differ, from x (..., 6)."""
    return xp.reshape(x @ xp.asarray(T), (*x.shape[:-1], 3, 3))


def positive(x: Any, xp: Any) -> Any:
    """A positive definite matrix (..., 3, 3)."""
    M = grid(x, xp)
    return M @ M.mT + 2.0 * xp.eye(3)


def each(name: str, inside: Callable[[Any, Any], Any] = lambda x, xp: x) -> Callable[[Any, Any], Any]:
    return lambda x, xp: getattr(xp, name)(inside(x, xp))


def by(function: Callable[[str, Any, Any], Any], name: str) -> Callable[[Any, Any], Any]:
    return lambda x, xp: function(name, x, xp)


def half(name: str) -> list[Callable[[Any, Any], Any]]:
    """Two arguments: the halves of x, a constant on either side, and axes to broadcast."""
    f = lambda xp, a, b: getattr(xp, name)(a, b)
    return [
        lambda x, xp: f(xp, x[..., :3], x[..., 3:]),
        lambda x, xp: f(xp, x[..., :3] + x[..., 1:4], x[..., 3:] - 3.0 * x[..., 2:5]),
        lambda x, xp: f(xp, x, A[0]),
        lambda x, xp: f(xp, A[0], x),
        lambda x, xp: f(xp, x[..., :3, None], x[..., None, 3:]),
        lambda x, xp: f(xp, x, 0.7),
    ]


def wide(x: Any, xp: Any) -> Any:
    return x[..., None, :] * A[:2]


def beyond(x: Any, xp: Any) -> Any:
    return 1.5 + xp.abs(x)


ROUNDED = ("floor", "ceil", "round", "trunc")
SMOOTH = (
    "abs negative positive square exp expm1 sin cos unnormalized_sinc atan sinh cosh tanh tan materialise"
)
# name -> functions of x (..., 6), each row of its own
CASES: dict[str, list[Callable[[Any, Any], Any]]] = {
    **{name: half(name) for name in ("add", "subtract", "multiply", "divide", "maximum", "minimum")},
    **{name: half(name) for name in ("atan2", "hypot", "copysign")},
    "remainder": [
        lambda x, xp: xp.remainder(x, 0.7),
        lambda x, xp: x % beyond(x, xp)[..., ::-1],
        lambda x, xp: 5.3 % beyond(x, xp),
    ],
    "floor_divide": [lambda x, xp: x * (x // 0.7)],
    "pow": [
        lambda x, xp: x**2,
        lambda x, xp: x**3,
        lambda x, xp: x**-2,
        lambda x, xp: x**0 * x,
        lambda x, xp: x**1,
        lambda x, xp: beyond(x, xp) ** 0.5,
        lambda x, xp: beyond(x, xp) ** x,
        lambda x, xp: 2.0**x,
        lambda x, xp: xp.pow(beyond(x, xp), A[0]),
    ],
    **{
        name: [each(name), each(name, wide)]
        for name in SMOOTH.split()
    },
    **{name: [each(name, beyond)] for name in ("sqrt", "log", "log1p", "log2")},
    **{name: [each(name, lambda x, xp: 0.3 * x)] for name in ("asin", "acos")},
    **{
        name: [by(lambda n, x, xp: x * getattr(xp, n)(3.0 * x), name)] for name in ROUNDED
    },
    "sign": [lambda x, xp: x * xp.sign(x)],
    **{
        name: [by(lambda n, x, xp: xp.where(getattr(xp, n)(x, x[..., ::-1]), x, 2.0 * x), name)]
        for name in ("equal", "not_equal", "less", "less_equal", "greater", "greater_equal")
    },
    **{
        name: [by(lambda n, x, xp: xp.where(getattr(xp, n)(x > 0.0, x < 0.5), x, x * x), name)]
        for name in ("logical_and", "logical_or", "logical_xor")
    },
    "logical_not": [lambda x, xp: xp.where(xp.logical_not(x > 0.0), x, x * x)],
    **{
        name: [by(lambda n, x, xp: xp.where(getattr(xp, n)(x), x, x * x), name)]
        for name in ("isfinite", "isnan")
    },
    "where": [
        lambda x, xp: xp.where(x > 0.0, x, x[..., ::-1] ** 2),
        lambda x, xp: xp.where(x > 0.0, x, 1.0),
        lambda x, xp: xp.where(x > 0.0, 1.0, x),
        lambda x, xp: xp.where(A[:2] > 0.0, x[..., None, :], wide(x, xp)),
    ],
    "sum": [
        lambda x, xp: xp.sum(x, axis=-1),
        lambda x, xp: xp.sum(wide(x, xp), axis=(-2, -1)),
        lambda x, xp: xp.sum(wide(x, xp), axis=-2, keepdims=True) + x[..., None, :],
        lambda x, xp: xp.sum(xp.broadcast_to(x[..., None, :], (*x.shape[:-1], 4, 6)), axis=-2),
    ],
    "mean": [lambda x, xp: xp.mean(x, axis=-1), lambda x, xp: xp.mean(wide(x, xp), axis=-2)],
    "prod": [
        lambda x, xp: xp.prod(x, axis=-1),
        lambda x, xp: xp.prod(wide(x, xp), axis=-2, keepdims=True),
        lambda x, xp: xp.prod(wide(x, xp), axis=(-2, -1)),
    ],
    **{
        name: [
            by(lambda n, x, xp: getattr(xp, n)(x, axis=-1), name),
            by(lambda n, x, xp: getattr(xp, n)(grid(x, xp), axis=-2, keepdims=True), name),
            by(lambda n, x, xp: getattr(xp, n)(grid(x, xp), axis=(-2, -1)), name),
        ]
        for name in ("max", "min")
    },
    **{name: [by(lambda n, x, xp: x + 1.0 * getattr(xp, n)(x > 0.0), name)] for name in ("any", "all")},
    **{name: [by(lambda n, x, xp: x + 1.0 * getattr(xp, n)(x), name)] for name in ("argmax", "argmin")},
    "argsort": [lambda x, xp: x * xp.argsort(x, axis=-1)],
    "searchsorted": [lambda x, xp: x * xp.searchsorted(np.array([-1.0, 0.0, 0.5, 1.0]), x)],
    "sort": [lambda x, xp: xp.sort(x, axis=-1), lambda x, xp: xp.sort(grid(x, xp), axis=-2)],
    "flip": [lambda x, xp: xp.flip(x, axis=-1), lambda x, xp: xp.flip(grid(x, xp), axis=-2)],
    "roll": [lambda x, xp: xp.roll(x, 2, axis=-1)],
    "cumulative_sum": [
        lambda x, xp: xp.cumulative_sum(x, axis=-1),
        lambda x, xp: xp.cumulative_sum(wide(x, xp), axis=-2),
    ],
    "concat": [
        lambda x, xp: xp.concat([x[..., 4:], x**2, 0.0 * x[..., :1] + 1.0], axis=-1),
        lambda x, xp: xp.concat([x, xp.ones_like(x), xp.zeros_like(x)], axis=-1),
    ],
    "stack": [
        lambda x, xp: xp.stack([x, x * x], axis=-1),
        lambda x, xp: xp.stack([x[..., 0], x[..., 1] * x[..., 2], xp.zeros_like(x[..., 0])], axis=-1),
    ],
    "matmul": [
        lambda x, xp: x @ xp.asarray(A),
        lambda x, xp: (A @ x[..., None])[..., 0],
        lambda x, xp: grid(x, xp) @ grid(x * x, xp),
        lambda x, xp: grid(x, xp) @ A[:3, :2],
        lambda x, xp: grid(x, xp)[..., None, :, :] @ A[:6].reshape(3, 3, 4),
    ],
    "matrix_transpose": [
        lambda x, xp: grid(x, xp).mT,
        lambda x, xp: (x[..., None, :] + xp.zeros((3, 1))).mT,
        lambda x, xp: xp.broadcast_to(x[..., None, :], (*x.shape[:-1], 3, 6)).mT,
    ],
    **{name: [by(lambda n, x, xp: getattr(xp, n)(grid(x, xp), k=1), name)] for name in ("tril", "triu")},
    "cholesky": [lambda x, xp: xp.linalg.cholesky(positive(x, xp))],
    "solve": [
        lambda x, xp: xp.linalg.solve(positive(x, xp), grid(x * x, xp)),
        lambda x, xp: solve_positive(positive(x, xp), grid(x * x, xp), xp),
        lambda x, xp: xp.linalg.solve(positive(x, xp), x[..., :3, None])[..., 0],
        lambda x, xp: xp.linalg.solve(A[:3, :3] + 2.0 * np.eye(3), grid(x, xp)),
        lambda x, xp: xp.linalg.solve(positive(x, xp), A[:3, :2] + 0.0 * grid(x, xp)[..., :2]),
    ],
    "cross": [
        lambda x, xp: xp.linalg.cross(x[..., :3], x[..., 3:]),
        lambda x, xp: xp.linalg.cross(x[..., None, :3], A[:, :3]),
    ],
    "vecdot": [
        lambda x, xp: xp.linalg.vecdot(x, x),
        lambda x, xp: xp.linalg.vecdot(x[..., :3], x[..., 3:] ** 2),
        lambda x, xp: xp.linalg.vecdot(x[..., None, :], A),
    ],
    "permute_dims": [
        lambda x, xp: xp.permute_dims(
            grid(x, xp), (*range(x.ndim - 1), x.ndim, x.ndim - 1)
        ),
    ],
    "reshape": [
        lambda x, xp: xp.reshape(x, (*x.shape[:-1], 2, 3)),
        lambda x, xp: xp.reshape(x[..., :, None] * x[..., None, :], (*x.shape[:-1], 36)),
        lambda x, xp: xp.squeeze(xp.expand_dims(x, axis=-1), axis=-1),
    ],
    "broadcast_to": [lambda x, xp: xp.broadcast_to(x[..., None, :], (*x.shape[:-1], 4, 6))],
    "getitem": [
        lambda x, xp: x[..., 0],
        lambda x, xp: x[..., -2:],
        lambda x, xp: x[..., ::-2, None],
        lambda x, xp: xp.broadcast_to(x[..., None, :], (*x.shape[:-1], 4, 6))[..., 1:3, 2:],
        lambda x, xp: xp.broadcast_to(x[..., None, :], (*x.shape[:-1], 4, 6))[..., 3, :2],
    ],
    "take": [
        lambda x, xp: xp.take(x, np.array([2, 0, 2]), axis=-1),
        lambda x, xp: xp.take(grid(x, xp), np.array([[0, 1], [2, 2]]), axis=-2),
    ],
    "astype": [lambda x, xp: xp.astype(x, x.dtype) * xp.astype(3.0 * x, xp.int64)],
    "clip": [lambda x, xp: xp.clip(x, min=-0.5, max=0.5), lambda x, xp: xp.clip(x, max=xp.sin(x))],
    "operators": [
        lambda x, xp: 1.0 - x + 2.0 * x / (3.0 + x * x) - (-x) + abs(+x),
        lambda x, xp: np.float64(2.0) * x + np.ones(6) / (2.0 + x**2) - (A @ x[..., None])[..., 0],
        lambda x, xp: sum(p * p for p in xp.permute_dims(x, (x.ndim - 1, *range(x.ndim - 1)))),
    ],
    "a constant": [lambda x, xp: xp.zeros_like(x) + 2.0],
}  # fmt: skip
ONE_ROW = {
    "outer": [lambda x, xp: xp.linalg.outer(x, x * x), lambda x, xp: xp.linalg.outer(A[0], x)],
    "matmul": [
        lambda x, xp: x @ x**2,
        lambda x, xp: A @ x,
        lambda x, xp: x @ A.reshape(3, 6, 2),
        lambda x, xp: A.reshape(2, 3, 6) @ x,
    ],
    "solve": [
        lambda x, xp: xp.linalg.solve(positive(x, xp), x[3:]),
        lambda x, xp: solve_positive(positive(x, xp), x[3:], xp),
        lambda x, xp: xp.linalg.solve(A[:3, :3] + 2.0 * np.eye(3), x[3:]),
        lambda x, xp: xp.linalg.solve(positive(x, xp) * np.ones((2, 1, 1)), x[3:] ** 2),
    ],
    "take": [lambda x, xp: x[np.array([1, 1, 4])]],
    "sum": [lambda x, xp: xp.sum(grid(x, xp))],
    "prod": [lambda x, xp: xp.prod(x[0])],
    "flip": [lambda x, xp: xp.flip(grid(x, xp))],
    "roll": [lambda x, xp: xp.roll(grid(x, xp), 1), lambda x, xp: xp.roll(x, -1)],
    "cumulative_sum": [lambda x, xp: xp.cumulative_sum(x)],
    "max": [lambda x, xp: xp.max(grid(x, xp))],
    "permute_dims": [lambda x, xp: xp.permute_dims(grid(x, xp)[None], (2, 0, 1))],
    "T": [lambda x, xp: grid(x, xp).T],
    "unpacking": [lambda x, xp: xp.stack([b * a for a, b in zip(x, x[::-1], strict=True)])],
}
PAIRS = [(name, k) for name, cases in CASES.items() for k in range(len(cases))]
SINGLE = [(name, k) for name, cases in ONE_ROW.items() for k in range(len(cases))]
NO_DERIVATIVE = {name for name in OPS if name.startswith("bitwise_")} | {"float32_bits", "replay"}


def differences(f: Callable[[Any], Any], x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """The derivative (..., n) of f at x (..., n), each row of its own."""
    return np.stack(
        [(f(x + step * e) - f(x - step * e)) / (2.0 * step) for e in np.eye(x.shape[-1])], axis=-1
    )


def record(f: Callable[[Any, Any], Any], shape: tuple[int, ...], **settings: Any) -> Callable[[Any], Any]:
    """`jacobian` of f recorded on symbolic x, as a function that plays it."""
    trace = Trace()
    x = trace.input(Spec(shape, "real"))
    out = [
        trace.constant(v) if isinstance(v, np.ndarray) else v for v in jacobian(f, x, namespace, **settings)
    ]

    def play(value: np.ndarray) -> tuple[Any, Any]:
        env: dict[int, Any] = {**trace.constants, x.number: value}
        for i in trace.instructions:
            found = OPS[i.op].run(NUMPY, *(env[a] for a in i.args), **bound_attrs(i.op, i.attrs, np.float64))
            assert np.shape(found) == i.spec.shape, f"{i.op} {i.attrs}"
            env[i.out] = found
        return tuple(env[o.number] for o in out)

    play.trace = trace  # type: ignore[attr-defined]
    return play


def away_from_kinks(x: np.ndarray) -> np.ndarray:
    """Numbers that differ from each other, from 0 and from where the cases round or choose."""
    return np.round(x * 37.0) / 37.0 + 0.0071 + np.linspace(0.0, 0.004, x.shape[-1])


def check(f: Callable[[Any, Any], Any], x: np.ndarray) -> None:
    value, derivative = jacobian(f, x, np)
    assert derivative.dtype == np.float64
    expected = f(x, NUMPY)
    np.testing.assert_array_equal(value, expected)
    assert derivative.shape == (*np.shape(expected), x.shape[-1])
    single, single_slope = jacobian(f, x.astype(np.float32), np)
    assert single_slope.dtype == np.asarray(single).dtype
    slopes = differences(lambda v: f(v, NUMPY), x)
    np.testing.assert_allclose(derivative, slopes, rtol=1e-6, atol=1e-6 * (1.0 + np.abs(slopes).max()))
    played = record(f, x.shape)(x)
    np.testing.assert_allclose(played[0], value, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(played[1], derivative, rtol=1e-12, atol=1e-12)


def test_every_operation_has_a_rule_and_a_case_or_is_refused():
    assert set(RULES) | NO_DERIVATIVE == set(OPS)
    assert not set(RULES) & NO_DERIVATIVE
    assert set(RULES) <= set(CASES) | set(ONE_ROW)


@pytest.mark.parametrize(("name", "k"), PAIRS)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_derivative_is_that_of_central_differences(name, k, seed):
    x = np.random.default_rng(seed).uniform(-1.2, 1.2, 6)
    check(CASES[name][k], away_from_kinks(x))


@pytest.mark.parametrize(("name", "k"), PAIRS)
@pytest.mark.parametrize("lead", [(3,), (2, 2)])
def test_with_leading_axes_each_row_has_its_own(name, k, lead):
    x = away_from_kinks(np.random.default_rng(11).uniform(-1.2, 1.2, (*lead, 6)))
    if name in ("any", "all", "argmax", "argmin"):
        return  # those cases reduce over all axes
    check(CASES[name][k], x)


@pytest.mark.parametrize(("name", "k"), SINGLE)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_what_takes_no_leading_axes_agrees_too(name, k, seed):
    x = np.random.default_rng(seed).uniform(-1.2, 1.2, 6)
    check(ONE_ROW[name][k], away_from_kinks(x))


def test_only_directions_that_change_something_are_recorded():
    """A motion whose parts see parts of x: the tangent of each has its own directions, and no zeros."""
    seen: dict[str, Any] = {}

    def f(x: Any, xp: Any) -> Any:
        p, v, q = x[..., :2], x[..., 2:4], x[..., 4:]
        seen.update(p=p, turned=xp.sin(q) * 0.1, moved=p + v * 0.1, none=0.0 * xp.sin(q))
        return xp.concat([seen["moved"], v, seen["turned"]], axis=-1)

    x = away_from_kinks(np.linspace(-1.0, 1.0, 6))
    play = record(f, (6,))
    directions = {name: {i for key in a.tangent for i in key} for name, a in seen.items() if name != "none"}
    assert directions == {"p": {0, 1}, "turned": {4, 5}, "moved": {0, 1, 2, 3}}
    assert type(seen["none"]).__name__ == "Symbolic"
    np.testing.assert_allclose(play(x)[1], differences(lambda v: f(v, NUMPY), x), atol=1e-9)


# where a function has a kink, or its slope no bound


def sinc(x: Any, xp: Any) -> Any:
    t = xp.sqrt(xp.linalg.vecdot(x, x))[..., None]
    return xp.sin(t) / xp.maximum(t, 1e-15)


AT_ORIGIN: dict[str, tuple[Callable[[Any, Any], Any], Any]] = {
    "abs": (lambda x, xp: xp.abs(x), np.zeros((3, 3))),
    "a norm": (lambda x, xp: xp.sqrt(xp.linalg.vecdot(x, x))[..., None], np.zeros((1, 3))),
    "a norm by hypot": (
        lambda x, xp: xp.hypot(xp.hypot(x[..., :1], x[..., 1:2]), x[..., 2:]),
        np.zeros((1, 3)),
    ),
    "sin(t) / max(t, eps)": (sinc, np.zeros((1, 3))),
    "a direction": (lambda x, xp: x / xp.sqrt(xp.maximum(xp.sum(x * x), 1e-30)), 1e15 * np.eye(3)),
    "atan2": (lambda x, xp: xp.atan2(x, x[..., ::-1]), np.zeros((3, 3))),
    "a ratio behind where": (
        lambda x, xp: xp.where(x == 0.0, 1.0 - x / 2.0, (1.0 - xp.exp(-x)) / xp.where(x == 0.0, 1.0, x)),
        -0.5 * np.eye(3),
    ),
    "a ratio that is not chosen": (lambda x, xp: xp.where(x == 0.0, x, xp.sin(x) / x), np.eye(3)),
    "a bound that is met": (lambda x, xp: xp.clip(x, min=0.0, max=1.0), np.zeros((3, 3))),
    "acos of what is kept within 1": (lambda x, xp: xp.acos(xp.clip(1.0 + x, max=1.0)), np.zeros((3, 3))),
    "sqrt of what is kept above 0": (lambda x, xp: xp.sqrt(xp.maximum(x, 0.0)), np.zeros((3, 3))),
    "the larger of two": (lambda x, xp: xp.maximum(x, -x), np.eye(3)),
    "a power": (lambda x, xp: x**2 + x**3 + x**0, np.zeros((3, 3))),
    "a root": (lambda x, xp: (x**2) ** 0.5, np.zeros((3, 3))),
    "a product": (lambda x, xp: xp.prod(1.0 + x - 1.0, axis=-1)[..., None], np.zeros((1, 3))),
    "Exp": (lambda x, xp: from_rotation_vector(x, xp=xp), np.eye(4, 3, -1) / 2.0),
    "Log(Exp)": (
        lambda x, xp: to_rotation_vector(normalize(from_rotation_vector(x, xp=xp), xp=xp), xp=xp),
        np.eye(3),
    ),
}


@pytest.mark.parametrize("name", AT_ORIGIN)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_at_a_guarded_point_the_derivative_is_that_of_the_guard(name, dtype):
    f, expected = AT_ORIGIN[name]
    with np.errstate(divide="ignore", invalid="ignore"):
        _, found = jacobian(f, np.zeros(3, dtype), np)
        played = record(f, (3,))(np.zeros(3))[1]
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_allclose(played, expected, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(
    ("f", "at"),
    [
        (lambda x, xp: xp.sqrt(x), 0.0),
        (lambda x, xp: x**0.5, 0.0),
        (lambda x, xp: xp.pow(x, 0.5 + 0.0 * x), 0.0),
        (lambda x, xp: x ** (2.0 + x), 0.0),
        (lambda x, xp: xp.acos(x), 1.0),
        (lambda x, xp: xp.asin(x), -1.0),
    ],
)
def test_a_slope_without_bound_is_a_large_number(f, at, dtype):
    _, slope = jacobian(f, np.full(1, at, dtype), np)
    assert np.isfinite(slope).all()
    assert slope == 0.0 or abs(slope) > 1e10


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_a_guard_that_does_not_hold_changes_nothing(a, b):
    x = np.array([a, b])
    _, found = jacobian(lambda v, xp: xp.clip(v, min=-1.0, max=1.0), x, np)
    np.testing.assert_array_equal(found, np.diag((np.abs(x) < 1.0) * 1.0))


# directions, constants and derivatives of derivatives


def curved(x: Any, xp: Any) -> Any:
    return xp.stack([xp.sin(x[..., 0]) * x[..., 1], x[..., 2] ** 3 + x[..., 0] * x[..., 3]], axis=-1)


@pytest.mark.parametrize("lead", [(), (5,)])
def test_the_derivative_along_directions(lead):
    rng = np.random.default_rng(2)
    x = rng.normal(size=(*lead, 6))
    _, whole = jacobian(curved, x, np)
    same, own = rng.normal(size=(6, 4)), rng.normal(size=(*lead, 6, 2))
    np.testing.assert_allclose(jacobian(curved, x, np, along=same)[1], whole @ same, atol=1e-14)
    np.testing.assert_allclose(jacobian(curved, x, np, along=own)[1], whole @ own, atol=1e-14)
    beside = np.concatenate([np.broadcast_to(same, (*lead, 6, 4)), own], axis=-1)
    np.testing.assert_allclose(jacobian(curved, x, np, along=[same, own])[1], whole @ beside, atol=1e-14)
    value, recorded = record(curved, x.shape, along=[same, own])(x)
    np.testing.assert_allclose(recorded, whole @ beside, atol=1e-14)
    np.testing.assert_array_equal(value, curved(x, NUMPY))


def test_directions_that_overlap_in_part_are_cut():
    """A sum of parts whose tangents have other directions, some of them shared."""
    weights = np.eye(6)
    weights[:, 3] = 0.0

    def f(x: Any, xp: Any) -> Any:
        a, b, c = xp.sin(x[..., :4]), xp.cos(x[..., 2:]), xp.exp(x[..., [0, 2][0] : 3])
        return xp.concat([a * b, c + a[..., :3], x[..., 4:]], axis=-1)

    x = away_from_kinks(np.linspace(-1.0, 1.0, 6))
    check(f, x)
    slopes = differences(lambda v: f(v, NUMPY), x)
    np.testing.assert_allclose(record(f, (6,), along=weights)(x)[1], slopes @ weights, atol=1e-9)


def test_a_second_derivative_is_the_derivative_of_the_first():
    f = lambda x, xp: xp.exp(x[..., 0]) * x[..., 1] ** 2 + xp.sin(x[..., 0] * x[..., 2])
    slope = lambda x, xp: jacobian(f, x, xp)[1]
    x = np.array([[0.3, -0.7, 1.1], [0.1, 0.4, -0.2]])
    first, second = jacobian(slope, x, np)
    np.testing.assert_allclose(first, differences(lambda v: f(v, NUMPY), x), atol=1e-8)
    np.testing.assert_allclose(second, differences(lambda v: slope(v, np), x), atol=1e-8)
    np.testing.assert_allclose(second, second.mT, atol=1e-14)
    np.testing.assert_allclose(record(slope, x.shape)(x)[1], second, atol=1e-14)


def test_what_the_inner_function_closes_over_is_constant_to_it_alone():
    """d/dx (x d/dy (x y)) = d/dx x^2, and not x + x y or 0: the two derivatives are told apart."""

    def outer(x: Any, xp: Any) -> Any:
        inner = lambda y, xp: x * y
        return x * jacobian(inner, xp.ones_like(x), xp)[1][..., 0]

    np.testing.assert_array_equal(jacobian(outer, np.array([3.0]), np)[1], [[6.0]])


def test_a_function_that_does_not_depend_has_a_derivative_of_zero():
    value, slope = jacobian(lambda x, xp: xp.ones((2, 3)), np.zeros((4, 5)), np)
    assert value.shape == (2, 3)
    np.testing.assert_array_equal(slope, np.zeros((2, 3, 5)))


def test_a_symbolic_value_on_the_left_leaves_the_operator_to_the_other_class():
    class Right:
        __array_ufunc__ = None
        __radd__ = __rmatmul__ = __gt__ = lambda self, other: "mine"

    x = Trace().input(Spec((2, 2), "real"))
    assert (x + Right(), x @ Right(), x < Right()) == ("mine", "mine", "mine")
    with pytest.raises(TypeError, match="unsupported operand"):
        x - Right()  # type: ignore[operator]


# what is refused, by line


def loses(name: str) -> Callable[[Any, Any], Any]:
    def f(x: Any, xp: Any) -> Any:
        if name == "float":
            return float(x[0])
        if name == "int":
            return int(x[0])
        if name == "index":
            return [1.0, 2.0][x[0]]
        if name == "branch":
            return x if x[0] else -x
        if name == "NumPy":
            return np.linalg.norm(x)
        if name == "write":
            x[0] = 1.0
        if name == "add in place":
            x += 1.0
        if name == "list":
            return xp.asarray([x[0], x[1]])
        if name == "mask":
            return x[x > 0.0]
        if name == "attribute":
            return x.astype(np.float32)
        if name == "method":
            return x.nothing
        if name == "indices":
            return x[0, 0]
        if name == "scalar":
            return list(x[0])
        if name == "T":
            return x.T
        if name == "bits":
            return xp.float32_bits(x)
        if name == "operation":
            return xp.einsum("i->", x)
        return xp.linalg.eigh(x)

    return f


REFUSED = {
    "float": "loses the derivative",
    "int": "loses the derivative",
    "index": "loses the derivative",
    "branch": "loses the derivative",
    "NumPy": "loses the derivative",
    "write": "in-place write",
    "add in place": "in-place write",
    "list": "from a list",
    "mask": "depends on data",
    "attribute": "no attribute 'astype'",
    "method": "no attribute 'nothing'",
    "indices": "too many indices",
    "scalar": "iteration over a scalar",
    "T": ".T of other than two axes",
    "bits": "float32_bits has no derivative",
    "operation": "xp.einsum is not among",
    "linalg": "xp.linalg.eigh is not among",
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_would_lose_the_derivative_is_refused_by_line(name):
    with pytest.raises(LoweringError, match=REFUSED[name]) as caught:
        jacobian(loses(name), np.array([0.5, 0.25]), np)
    assert str(caught.value.path).startswith(f"{__name__}:")
    assert caught.value.in_every_engine
    assert caught.value.fix


@pytest.mark.parametrize(
    ("x", "along", "match"),
    [
        (np.array([1, 2]), None, "got: +int64 of shape"),
        (np.float64(1.0), None, "got: +float64 of shape"),
        (np.zeros(2), np.zeros((3, 2)), r"expected: +shape \(2, k\)"),
        (np.zeros((4, 2)), np.zeros((3, 2, 2)), r"or those of x, \(4,\)"),
    ],
)
def test_what_cannot_be_differentiated_by_is_refused(x, along, match):
    with pytest.raises(DeclarationError, match=match) as caught:
        jacobian(lambda x, xp: x, x, np, along=along)
    assert str(caught.value.path).startswith(f"{__name__}:")


class Pair(Signal):
    a: Array = real(2)


def test_a_block_that_loses_the_derivative_is_refused_where_it_is_wired():
    @block
    def step(x: Pair, *, xp: Any) -> Array:
        return jacobian(lambda v, xp: np.sin(v), x.a, xp)[1]

    @graph
    def g(x: Stream[Pair]):
        collect(step(x), "out")

    with pytest.raises(LoweringError, match="'Dual' does not support ufuncs"):
        g.build()
