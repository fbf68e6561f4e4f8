"""Derivatives element by element: a slope for each argument of an operation.

At a kink, and where a slope has no bound, a value is chosen that keeps the derivative finite: `dual_rules`
says which.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flowgraph.recorder.tangents import Made, Rule, Tangent, added, aligned, lifted, mapped, plain, shape_of

LEAST = 1e-30
"""In place of 0 where a slope has no bound."""


def _unary(name: str, slope: Callable[[Any, Any, Any], Any]) -> Rule:
    """`slope(xp, x, y)`: dy/dx, given x and y = f(x)."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
        (x,), (t,) = values, tangents
        y = plain(xp, name)(x)
        g = slope(xp, x, y)
        return y, mapped(t, lambda d: d * g)

    return rule


def _weighted(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], slopes: Sequence[Any]) -> Tangent:
    """Sum of slope times tangent over the arguments of an operation element by element.

    A slope is called when its argument has a tangent; None in place of it is 1.
    """
    a, b = values
    rank = max(len(shape_of(a)), len(shape_of(b)))
    out: Tangent = {}
    for t, slope in zip(tangents, slopes, strict=True):
        if t:
            g = 1.0 if slope is None else slope()
            if type(g) in (int, float) and not g:
                continue  # 0.0 * x, as written to give a constant the shape of x
            scaled = {}
            for key, d in t.items():
                wide = d if len(d.shape) > rank else lifted(xp, d, rank)
                scaled[key] = wide if slope is None else wide * g
            out = added(xp, out, scaled) if out else scaled
    return out


def _binary(name: str, slopes: Callable[..., tuple[Any, Any]]) -> Rule:
    """`slopes(xp, a, b, y)`: two functions that give dy/da and dy/db when they are asked for."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
        y = plain(xp, name)(*values)
        return y, _weighted(xp, values, tangents, slopes(xp, *values, y))

    return rule


def _multiply(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    a, b = values
    if a is b and tangents[0] is tangents[1]:
        return xp.multiply(a, b), mapped(tangents[0], lambda d: d * (2.0 * a))
    return xp.multiply(a, b), _weighted(xp, values, tangents, (lambda: b, lambda: a))


def _divide(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    a, b = values
    y = xp.divide(a, b)
    inverse = xp.divide(1.0, b)
    return y, _weighted(xp, values, tangents, (lambda: inverse, lambda: -(y * inverse)))


def _pow(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    x, p = values
    y = xp.pow(x, p)

    def by_base() -> Any:
        if not shape_of(p) and isinstance(p, int | float | np.generic | np.ndarray):
            known = float(p)
            if known in (0.0, 1.0, 2.0):
                return (0.0, 1.0, 2.0 * x)[int(known)]
            inside = xp.maximum(x, LEAST) if 0.0 < known < 1.0 else x
            return known * xp.pow(inside, known - 1.0)
        # p x^(p - 1), which at x = 0 has no bound where p < 1
        return p * xp.pow(xp.where((x == 0.0) & (p < 1.0), LEAST, x), p - 1.0)

    def by_power() -> Any:
        return y * xp.log(xp.where(x > 0.0, x, 1.0))

    return y, _weighted(xp, values, tangents, (by_base, by_power))


def _extreme(name: str, wins: str) -> Rule:
    """`maximum`, `minimum`: the change of the one that wins; at a tie a constant does, else the first."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
        a, b = values
        if not tangents[0]:
            first = getattr(xp, wins + "_equal")(a, b)
        else:
            first = getattr(xp, wins + ("_equal" if tangents[1] else ""))(a, b)
        return plain(xp, name)(a, b), _chosen(xp, first, values, tangents)

    return rule


def _chosen(xp: Any, first: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Tangent:
    """The tangent of `where(first, a, b)`."""
    rank = max(len(shape_of(v)) for v in (first, *values))
    a, b = (mapped(t, lambda d: lifted(xp, d, rank)) for t in tangents)
    return {
        key: xp.where(first, 0.0 if d is None else d, 0.0 if e is None else e)
        for key, (d, e) in aligned(xp, a, b)
    }


def _where(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    condition, a, b = values
    return xp.where(condition, a, b), _chosen(xp, condition, (a, b), tangents[1:])


def _remainder_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    return None, lambda: -xp.floor_divide(a, b)


def _nonzero(xp: Any, x: Any) -> Any:
    return xp.where(x == 0.0, 1.0, x)


def _atan2_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    inverse = 1.0 / _nonzero(xp, a * a + b * b)
    return (lambda: b * inverse), (lambda: -(a * inverse))


def _hypot_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    inverse = 1.0 / _nonzero(xp, y)
    return (lambda: a * inverse), (lambda: b * inverse)


def _copysign_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    return (lambda: xp.sign(a) * xp.copysign(1.0, b)), (lambda: 0.0)


def _inverse_root(xp: Any, square: Any) -> Any:
    """1 / sqrt, very large at 0."""
    return 1.0 / xp.maximum(xp.sqrt(square), LEAST)


_SLOPES: dict[str, Callable[[Any, Any, Any], Any]] = {
    "abs": lambda xp, x, y: xp.sign(x),
    "square": lambda xp, x, y: 2.0 * x,
    "sqrt": lambda xp, x, y: 0.5 / xp.maximum(y, LEAST),
    "exp": lambda xp, x, y: y,
    "expm1": lambda xp, x, y: y + 1.0,
    "log": lambda xp, x, y: 1.0 / x,
    "log1p": lambda xp, x, y: 1.0 / (1.0 + x),
    "log2": lambda xp, x, y: float(1.0 / np.log(2.0)) / x,
    "sin": lambda xp, x, y: xp.cos(x),
    "cos": lambda xp, x, y: -xp.sin(x),
    "unnormalized_sinc": lambda xp, x, y: (xp.cos(x) - y) / _nonzero(xp, x),
    "tan": lambda xp, x, y: 1.0 + y * y,
    "asin": lambda xp, x, y: _inverse_root(xp, 1.0 - x * x),
    "acos": lambda xp, x, y: -_inverse_root(xp, 1.0 - x * x),
    "atan": lambda xp, x, y: 1.0 / (1.0 + x * x),
    "sinh": lambda xp, x, y: xp.cosh(x),
    "cosh": lambda xp, x, y: xp.sinh(x),
    "tanh": lambda xp, x, y: 1.0 - y * y,
}


ELEMENTWISE: dict[str, Rule] = {
    **{name: _unary(name, slope) for name, slope in _SLOPES.items()},
    "add": _binary("add", lambda xp, a, b, y: (None, None)),
    "subtract": _binary("subtract", lambda xp, a, b, y: (None, lambda: -1.0)),
    "multiply": _multiply,
    "divide": _divide,
    "pow": _pow,
    "remainder": _binary("remainder", _remainder_slopes),
    "maximum": _extreme("maximum", "greater"),
    "minimum": _extreme("minimum", "less"),
    "atan2": _binary("atan2", _atan2_slopes),
    "hypot": _binary("hypot", _hypot_slopes),
    "copysign": _binary("copysign", _copysign_slopes),
    "where": _where,
}
"""The rules by name."""
