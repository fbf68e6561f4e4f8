"""Units of values inside a step: where they are known they travel through arithmetic, and must agree.

What a port carries has the unit that its type states. Sums, differences and comparisons need one unit;
products, quotients, powers and roots make another. A constant has no unit and fits any, and what is
computed with one by a product is unknown again: it may well be a conversion. Angles in radians are pure
numbers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from typing import TypeAlias

Unit: TypeAlias = frozenset[tuple[str, Fraction]]
"""Powers of base units; empty for a pure number."""

_DERIVED = {
    "Hz": "s^-1",
    "N": "kg m s^-2",
    "J": "kg m^2 s^-2",
    "W": "kg m^2 s^-3",
    "Pa": "kg m^-1 s^-2",
    "T": "kg s^-2 A^-1",
}
_FACTOR = re.compile(r"([*/ ]*)([^\W\d]+|%|1)(?:(?:\^|\*\*)\(?(-?\d+(?:[./]\d+)?)\)?)?")


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


_SAME = _names(
    """abs negative positive floor ceil round trunc materialise astype sum mean max min getitem reshape
    permute_dims matrix_transpose broadcast_to flip roll sort tril triu cumulative_sum take"""
)
_WITHOUT = _names("atan2 equal not_equal less less_equal greater greater_equal searchsorted")
_AGREE = _WITHOUT | _names("add subtract maximum minimum remainder where hypot")
_JOINED = _names("concat stack")
_PRODUCTS = _names("multiply matmul vecdot cross outer")
_QUOTIENTS = _names("divide floor_divide")


class UnitsDifferError(ValueError):
    """An operation needs one unit and is given two."""


@lru_cache(maxsize=1024)
def parsed(text: str | None) -> Unit | None:
    """The unit that a text states; None where it states none, or none that is understood."""
    if text is None:
        return None
    powers: dict[str, Fraction] = {}
    at = 0
    for factor in _FACTOR.finditer(text.replace("\N{MIDDLE DOT}", "*").replace("\N{SUPERSCRIPT TWO}", "^2")):
        if factor.start() != at or (at and not factor[1]):
            return None
        at = factor.end()
        power = Fraction(factor[3] or 1) * (-1 if "/" in factor[1] else 1)
        for name, inner in _base(factor[2]):
            powers[name] = powers.get(name, Fraction(0)) + inner * power
    return _unit(powers) if at == len(text) and at else None


def _base(name: str) -> Unit:
    if name in ("1", "rad"):
        return frozenset()
    if name in _DERIVED:
        return parsed(_DERIVED[name]) or frozenset()
    return frozenset({(name, Fraction(1))})


def _unit(powers: dict[str, Fraction]) -> Unit:
    return frozenset((name, power) for name, power in powers.items() if power)


def written(unit: Unit) -> str:
    """A unit as a text: `m/s^2`."""
    above = [_power(n, p) for n, p in sorted(unit) if p > 0]
    below = [_power(n, -p) for n, p in sorted(unit) if p < 0]
    return "*".join(above or ["1"]) + "".join(f"/{b}" for b in below)


def spelled(unit: Unit, given: Sequence[str]) -> str | None:
    """A unit as those write it who wrote the units it comes from; None where that cannot be said.

    Radians are pure numbers here and none to those who state them, so nothing is said in their company.
    """
    plain = all("rad" not in text for text in given)
    for text in given:
        if parsed(text) == unit and "rad" not in text:
            return text
    known = [parsed(text) for text in given]
    own_way = any(u is None or (u and written(u) != text) for u, text in zip(known, given, strict=True))
    if not unit or not plain or own_way or any(unit == parsed(base) for base in _DERIVED.values()):
        return None
    return written(unit)


def _power(name: str, power: Fraction) -> str:
    return name if power == 1 else f"{name}^{power}"


def scaled(unit: Unit, power: Fraction) -> Unit:
    """A power of a unit."""
    return _unit({name: p * power for name, p in unit})


def product(a: Unit, b: Unit) -> Unit:
    """The unit of a product."""
    powers = dict(a)
    for name, p in b:
        powers[name] = powers.get(name, Fraction(0)) + p
    return _unit(powers)


def result(op: str, units: Sequence[Unit | None], exponent: float | None = None) -> Unit | None:
    """The unit of an operation's result, from those of its operands; None where it is not known.

    Args:
        op: its name.
        units: of the operands.
        exponent: of `pow`, where it is a constant.

    Raises:
        UnitsDifferError: where the operands must have one unit and have not.
    """
    if op in _SAME:
        return units[0]
    if op in _AGREE:
        known = [u for u in (units[1:] if op == "where" else units) if u is not None]
        if any(u != known[0] for u in known):
            raise UnitsDifferError(" and ".join(dict.fromkeys(written(u) for u in known)))
        return None if op in _WITHOUT or not known else known[0]
    if op in _JOINED:  # a state may well be made of several units
        return units[0] if len(set(units)) == 1 else None
    if op == "pow" and exponent is not None and units[0] is not None:
        return scaled(units[0], Fraction(exponent).limit_denominator(64))
    if op in ("square", "sqrt", "cholesky") and units[0] is not None:
        return scaled(units[0], Fraction(2) if op == "square" else Fraction(1, 2))
    if op in _PRODUCTS | _QUOTIENTS | {"solve"}:
        left, right = units
        if left is None or right is None:
            return None
        if op == "solve":
            return product(right, scaled(left, Fraction(-1)))
        return product(left, right if op in _PRODUCTS else scaled(right, Fraction(-1)))
    return None
