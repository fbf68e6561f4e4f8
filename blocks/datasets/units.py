"""Units as tables write them, and what they are in SI.

A unit is said by a setting, or by the file itself: behind a name, as in `wx [deg/s]`, or in a row below the
names. The many spellings of one unit have one name here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

__all__ = [
    "ANGLE",
    "FIELD",
    "FORCE",
    "KINDS",
    "LENGTH",
    "PRESSURE",
    "RATE",
    "SPEED",
    "TIME",
    "split_unit",
    "unit_of",
]

_DEGREE = np.pi / 180.0
LENGTH = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048}
RATE = {"rad/s": 1.0, "deg/s": _DEGREE}
FORCE = {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3}
FIELD = {"T": 1.0, "mT": 1e-3, "uT": 1e-6, "nT": 1e-9, "G": 1e-4, "mG": 1e-7}
ANGLE = {"rad": 1.0, "deg": _DEGREE, "1e-7 deg": 1e-7 * _DEGREE}
SPEED = {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1.0 / 3.6}
PRESSURE = {"Pa": 1.0, "hPa": 100.0, "kPa": 1e3, "mbar": 100.0, "bar": 1e5}
TIME = {
    "s": 10**9,
    "ms": 10**6,
    "us": 10**3,
    "ns": 1,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
    "day": 86400 * 10**9,
}
"""Of a unit of time, in ns; the first of each kind is what is taken where nothing is said."""

KINDS = (LENGTH, RATE, FORCE, FIELD, ANGLE, SPEED, PRESSURE)
_NONE = "none"
_SPELLINGS: Mapping[str, str] = {
    **{u: u for kind in (*KINDS, TIME) for u in kind},
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("nsec", "nanosecond", "nanoseconds"), "ns"),
    **dict.fromkeys(("minute", "minutes"), "min"),
    **dict.fromkeys(("hour", "hours", "hr"), "h"),
    **dict.fromkeys(("d", "days"), "day"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("feet", "foot"), "ft"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("degE7", "1e-7deg", "deg*1e7", "deg*1e-7"), "1e-7 deg"),
    **dict.fromkeys(("rad/sec", "rads-1", "rad*s-1", "radians/s", "rps", "radians/second"), "rad/s"),
    **dict.fromkeys(("deg/sec", "dps", "degs-1", "deg*s-1", "°/s", "°s-1", "degrees/s", "°/sec"), "deg/s"),
    **dict.fromkeys(("m/s2", "m/s/s", "ms-2", "m*s-2", "m/sec2", "m/(s2)", "mps2", "m/ss"), "m/s^2"),
    **dict.fromkeys(("ms-1", "m*s-1", "m/sec", "mps"), "m/s"),
    **dict.fromkeys(("kmh", "kph", "km/hour"), "km/h"),
    **dict.fromkeys(("g0", "gn"), "g"),
    **dict.fromkeys(("tesla",), "T"),
    **dict.fromkeys(("gauss", "Gauss"), "G"),
    **dict.fromkeys(("mgauss", "mGauss"), "mG"),
    **dict.fromkeys(("pascal", "pascals"), "Pa"),
    **dict.fromkeys(("millibar", "millibars"), "mbar"),
    **dict.fromkeys(("-", "1", "[]", "none", "unitless", "quaternion"), _NONE),
}


def split_unit(name: str) -> tuple[str, str]:
    """A name and the unit in brackets after it: `("wx", "deg/s")` of `wx [deg/s]`; "" where none is."""
    found = re.fullmatch(r"(.*?\S)\s*(?:\[([^\]]*)\]|\(([^)]*)\))", name)
    return (found[1], found[2] or found[3] or "") if found else (name, "")


def unit_of(text: str) -> str:
    """The one name of a unit, however it is spelled; "none" of a number without one; "" if unknown."""
    plain = re.sub(r"^\s*[\[({]\s*(.*?)\s*[\])}]\s*$", r"\1", text).replace("µ", "u").replace("μ", "u")
    plain = plain.replace("²", "2").replace("⁻¹", "-1").replace("⁻²", "-2").replace("⁻", "-")
    if plain == "" and text.strip():
        return _NONE
    for way in (plain, re.sub(r"[\s^.·⋅{}]+", "", plain)):
        for spelled in (way, way.lower() if len(way) > 2 else way):
            if spelled in _SPELLINGS:
                return _SPELLINGS[spelled]
    return ""
