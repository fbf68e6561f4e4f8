"""Number formats: how each real value of a pipeline is kept as a whole number.

A value x is kept as the whole number nearest to x 2^f. All words have one width, sign included, but for
those that are said to be wider: registers and what is added up in them, since what is held gathers the
rounding of many ticks and an adder costs less than a multiplier; and values whose rounding moves most what a
filter is judged by. A product takes no more than the upper 32 bits of one. The fraction f is chosen for each
element from the largest size that the element takes, since the entries of one covariance differ by many
powers of ten.
Elements along an axis of particles share one. Values that are only moved (an element, a row, a transpose)
keep the formats that they had.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowgraph.errors import DeclarationError

NARROWEST, WIDEST = 8, 32
"""Bits of a word: two of the widest, multiplied, fit 64."""

WIDEST_HELD = 48
"""Bits of a word that is wider: it is added and compared as it is, and multiplied by its upper `WIDEST`."""

FREE = 1 << 20
"""The fraction of a constant zero, which has every format."""

_NOISE = 48
"""An element below the largest beside it by so many powers of two is zero but for rounding."""

_BELOW = 8
"""An element that was never larger than the last bit of the largest beside it, by so many bits, is
rounding."""


@dataclass(frozen=True)
class Formats:
    """The number formats of a pipeline.

    Args:
        width: bits of a word, with its sign.
        fractions: by value number, the fraction of each element: integers that broadcast to the value's
            shape.
        margin: by how much the sizes were widened that the fractions were chosen from.
        absent: the inputs and registers that may be NaN: readings that are not there.
        structure: a digest of the plain pipeline that they are for; empty where nobody asks.
        wider: bits of the inputs, registers and values that are kept in wider words.
        proven: the values whose size is proven; that of the others was seen on flights.

    Raises:
        DeclarationError: for a width that no word has.
    """

    width: int
    fractions: Mapping[int, np.ndarray]
    margin: float = 1.0
    absent: frozenset[int] = frozenset()
    structure: str = ""
    wider: Mapping[int, int] = field(default_factory=dict)
    proven: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        for name, widths, least, most in (
            ("width", (self.width,), NARROWEST, WIDEST),
            ("wider", sorted(set(self.wider.values())), self.width, WIDEST_HELD),
        ):
            for width in (w for w in widths if not least <= w <= most):
                raise DeclarationError(
                    "no word has this width",
                    path=name,
                    expected=f"{least} to {most} bits",
                    got=str(width),
                    fix=f"choose {most} or fewer: products of two words of {WIDEST} bits are kept in 64",
                )

    def width_of(self, value: int) -> int:
        """Bits of the words of a value that is no move of another."""
        return self.wider.get(value, self.width)

    @property
    def widest(self) -> int:
        """Bits of the widest words."""
        return max(self.wider.values(), default=self.width)

    def by_width(self) -> dict[int, list[int]]:
        """The values that have wider words, by bits."""
        found: dict[int, list[int]] = {}
        for value, bits in sorted(self.wider.items(), key=lambda one: (one[1], one[0])):
            found.setdefault(bits, []).append(value)
        return found

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        wider = [{"width": bits, "values": values} for bits, values in self.by_width().items()]
        return {
            "width": self.width,
            "rounding": "nearest, half up",
            "overflow": "saturate",
            "margin": self.margin,
            "absent": sorted(self.absent),
            "structure": self.structure,
            **({"proven": sorted(self.proven)} if self.proven else {}),
            **({"held": wider} if wider else {}),
            "fractions": [
                {"value": n, "fraction": np.asarray(f).tolist()} for n, f in sorted(self.fractions.items())
            ],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Formats:
        """From `to_json`'s form.

        Raises:
            KeyError, TypeError, ValueError: where it is another.
        """
        for name in ("rounding", "overflow"):
            if data[name] != cls(NARROWEST, {}).to_json()[name]:
                raise ValueError(f"{name} {data[name]!r}")
        fractions = {}
        for one in data["fractions"]:
            found = np.asarray(one["fraction"])
            if found.dtype.kind != "i":
                raise ValueError(f"the fraction of value {one['value']} is no array of integers")
            fractions[int(one["value"])] = found.astype(np.int64)
        wider = data.get("held", [])
        wider = [wider] if isinstance(wider, Mapping) else wider  # as it was while there was one width
        return cls(
            int(data["width"]),
            fractions,
            float(data["margin"]),
            frozenset(map(int, data["absent"])),
            str(data["structure"]),
            {int(n): int(some["width"]) for some in wider for n in some["values"]},
            frozenset(map(int, data.get("proven", ()))),
        )


def fraction_for(largest: np.ndarray, width: int) -> np.ndarray:
    """The finest fraction in which numbers of this size fit a word; zeros get that of their neighbours.

    Args:
        largest: sizes, any shape, 0 where an element was never anything else.
        width: bits of a word.
    """
    sizes = np.asarray(largest, dtype=np.float64)
    most = float(sizes.max(initial=0.0))
    most = most if most > 0.0 else 1.0
    sizes = np.where(
        sizes > math.ldexp(most, -_NOISE), np.maximum(sizes, math.ldexp(most, -width - _BELOW)), most
    )
    whole = np.frexp(sizes)[1].astype(np.int64)  # x < 2^whole
    full = np.ldexp(1.0, whole.astype(int)) - sizes < np.ldexp(0.5, whole - width + 1)
    return np.asarray(width - 1 - (whole + full))


def fraction_of_constant(array: np.ndarray, width: int) -> np.ndarray:
    """The fraction of each element of a constant; zeros are free."""
    size = np.abs(array)
    return np.where(size == 0.0, FREE, fraction_for(size, width))


def whole_numbers(x: Any, fraction: np.ndarray, width: int) -> np.ndarray:
    """Reals as words: rounded to the nearest, half upwards, and saturated; NaN becomes `NOT_A_NUMBER`."""
    real = np.asarray(x, dtype=np.float64)
    most = float(2 ** (width - 1) - 1)
    scaled = np.ldexp(real, np.where(fraction == FREE, 0, fraction).astype(int))
    raw = np.clip(np.floor(np.nan_to_num(scaled, nan=0.0, posinf=most, neginf=-most) + 0.5), -most, most)
    return np.where(np.isnan(real), NOT_A_NUMBER, raw.astype(np.int64))


NOT_A_NUMBER = -(1 << 62)
"""The word of an input that is NaN; an operation other than `isnan` and a selection takes it as the least."""


def real_numbers(raw: Any, fraction: np.ndarray) -> np.ndarray:
    """Words as reals, exactly."""
    words = np.asarray(raw, dtype=np.int64)
    real = np.ldexp(words.astype(np.float64), -np.where(fraction == FREE, 0, fraction).astype(int))
    return np.where(words == NOT_A_NUMBER, math.nan, real)
