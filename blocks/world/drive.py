"""A drive on a smooth road through random places: at rest at first, away, over hills, one stop on the way.

The road is a curve of a parameter s, a quintic spline through places some 80 m apart; the car is at s(t), the
integral of a pace that never falls below 0. Both are polynomials in pieces, so that all that is told of the
motion is exact. The body's x axis points along the road, without roll.

The spline through all places is one linear system of equations: it is solved on the host, by `road_of`, and a
graph is handed its coefficients, each piece when it begins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph import Series, block
from flowgraph.blocks.geometry.rotations import multiply
from flowgraph.blocks.signals import BodyMotion, RoadPiece
from flowgraph.recorder.random import Site, seed_words

__all__ = ["NO_ROAD", "REST_OF_DRIVE", "drive_motion", "road_of"]

REST_OF_DRIVE = 3.0
"""s, at the start."""

_AWAY = 4.0  # s, until the pace is what it is to be
_APART = 80.0  # m
_PACE = 10  # coefficients of one piece of s(t): the pace is a cubic, times a quintic as it begins
_ROAD = 6  # of one piece of the road, on each axis
_REACHED = 3  # pieces of the road in one of s(t): 9 s at most, at 0.2 a second


@dataclass(frozen=True)
class Timetable:
    """When paces are drawn for a drive of so many seconds, and how many places its road has.

    Args:
        knots: (k,) s, where a pace is drawn.
        breaks: (p + 1,) s, where the pieces of s(t) begin, and where the last one ends.
        places: after the origin.
    """

    knots: np.ndarray
    breaks: np.ndarray
    places: int

    @classmethod
    def of(cls, duration: float) -> Self:
        knots = np.linspace(0.0, max(duration, 1.0), max(int(duration / 6.0), 2) + 1)
        begins = np.minimum([REST_OF_DRIVE, REST_OF_DRIVE + _AWAY], knots[-1])
        breaks = np.unique(np.rint(np.concatenate([knots, begins]) * 1e9)) / 1e9  # a tick each
        return cls(knots, breaks, max(6, int(duration * 15.0 / _APART) + 6))


_EAST = np.zeros((_REACHED, _ROAD, 3))
_EAST[:, 1, 0] = _APART

NO_ROAD = RoadPiece(begin=0.0, length=1.0, along=np.zeros(_PACE), first=0.0, road=_EAST)
"""At rest at the origin, towards the east."""


@block
def drive_motion(piece: RoadPiece, *, t: Any, xp: Any) -> BodyMotion:
    """Where the car is at this tick, and how it moves; time counts from 0. Give it the piece of now, held:
    `drive_motion(latest(road, init=NO_ROAD), at=imu)`, and a clock."""
    share = (xp.astype(t, piece.along.dtype) * 1e-9 - piece.begin) / piece.length
    s, *by_share = _derivatives([piece.along[k] for k in range(_PACE)], share)
    v, a = (value / piece.length**k for k, value in enumerate(by_share, start=1))
    which = xp.clip(xp.floor(s - piece.first), 0.0, _REACHED - 1.0)
    row = xp.take(piece.road, xp.astype(which, xp.int64), axis=0)
    place, way, bend = _derivatives([row[k] for k in range(_ROAD)], s - piece.first - which)
    attitude, rate = _along(way, bend * v, xp)
    return BodyMotion(
        position=place,
        velocity=way * v,
        acceleration=bend * v * v + way * a,
        attitude=attitude,
        rate=rate,
    )


def _derivatives(coefficients: list[Any], x: Any) -> list[Any]:
    """A polynomial and its first two derivatives, lowest powers first."""
    found = []
    for _ in range(3):
        value = coefficients[-1]
        for c in coefficients[-2::-1]:
            value = value * x + c
        found.append(value)
        coefficients = [float(k) * coefficients[k] for k in range(1, len(coefficients))]
    return found


def _along(way: Any, change: Any, xp: Any) -> tuple[Any, Any]:
    """The attitude whose x axis is along `way`, without roll, and its body rate where the way changes so, per
    second. The sign of the quaternion jumps where the yaw passes pi."""
    x, y, z = (way[..., k] for k in range(3))
    dx, dy, dz = (change[..., k] for k in range(3))
    level = xp.sqrt(x * x + y * y)
    yaw, pitch = xp.atan2(y, x), xp.atan2(z, level)
    zero = xp.zeros_like(yaw)
    about_z = xp.stack([xp.cos(yaw / 2), zero, zero, xp.sin(yaw / 2)], axis=-1)
    about_y = xp.stack([xp.cos(pitch / 2), zero, -xp.sin(pitch / 2), zero], axis=-1)
    turn = (x * dy - y * dx) / (level * level)
    climb = (level * dz - z * (x * dx + y * dy) / level) / (level * level + z * z)
    rate = xp.stack([turn * xp.sin(pitch), -climb, turn * xp.cos(pitch)], axis=-1)
    return multiply(about_z, about_y, xp=xp), rate


_STEPS = Site("drive/road", "normal", (2,))
_PACES = Site("drive/pace", "normal", (1,))


def road_of(duration: float, number: int) -> Series:
    """The `RoadPiece` of a road of a number, each when it begins. The places are the same for drives of any
    duration, the first of a longer one those of a shorter."""
    table, words = Timetable.of(duration), seed_words(number)
    turns, climbs = _STEPS.at(np.arange(table.places), words)
    ways = np.cumsum(0.7 * turns)
    steps = _APART * np.stack([np.cos(ways), np.sin(ways), 0.03 * climbs], axis=-1)
    places = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    curve = scipy.interpolate.make_interp_spline(np.arange(len(places)), places, k=_ROAD - 1)
    begins = np.arange(table.places)
    road = np.stack([curve(begins, k) / math.factorial(k) for k in range(_ROAD)], axis=1)

    along = _along_it(table, 0.12 + 0.04 * _PACES.at(np.arange(len(table.knots)), words)[0])
    first = np.clip(np.floor(along[:, 0]).astype(np.int64), 0, table.places - _REACHED)
    pieces = RoadPiece(
        begin=table.breaks[:-1],
        length=np.diff(table.breaks),
        along=along,
        first=first.astype(float),
        road=road[first[:, None] + np.arange(_REACHED)],
    )
    return Series(np.rint(table.breaks[:-1] * 1e9).astype(np.int64), pieces, name="road")


def _along_it(table: Timetable, paces: np.ndarray) -> np.ndarray:
    """The coefficients (p, 10) of s(t), of the paces (k,) that are wished for."""
    pace = np.clip(paces, 0.05, 0.2)
    if len(pace) > 8:
        pace[len(pace) // 2] = 0.0
    # between two paces no slower than the slower one, so that the car never goes back
    wanted = scipy.interpolate.PchipInterpolator(table.knots, pace)
    begins, lengths = table.breaks[:-1], np.diff(table.breaks)
    found, s = np.zeros((len(begins), _PACE)), 0.0
    cubics = np.stack([wanted(begins, n) * lengths**n / math.factorial(n) for n in range(4)], axis=-1)
    for k, (begin, length) in enumerate(zip(begins, lengths, strict=True)):
        product = np.convolve(cubics[k], _begun(begin, length))
        found[k, 0], found[k, 1:] = s, length * product / np.arange(1.0, _PACE)
        s = found[k].sum()
    return found


def _begun(begin: float, length: float) -> np.ndarray:
    """The share of the pace that the car has, 0 at rest, up to 1: coefficients (6,) in a piece's share."""
    since = (begin - REST_OF_DRIVE) / _AWAY
    if since < 0.0 or since >= 1.0:
        return np.array([float(since >= 1.0), 0.0, 0.0, 0.0, 0.0, 0.0])
    smooth = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
    moved = smooth(np.polynomial.Polynomial([since, length / _AWAY]))
    return np.asarray(np.pad(moved.coef, (0, 6 - len(moved.coef))))
