"""Alignment: where a filter starts, and how sure it may honestly be.

One reading of an accelerometer fixes two of three angles, as far as the body does not accelerate; the third,
the heading, comes from a reference. While the body rests there is more: the mean of many readings, the
north from a magnetometer, and the gyroscope's bias, which is all that it then reads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Flight, Series, block
from flowgraph.blocks.geometry.rotations import (
    from_rotation_vector,
    level,
    multiply,
    normalize,
    rotate,
    to_matrix,
)
from flowgraph.blocks.signals import (
    Alignment,
    Attitude,
    Belief,
    Imu,
    MagneticField,
    NavigationState,
    SpecificForce,
)
from flowgraph.errors import DataError

__all__ = [
    "Start",
    "StartSpread",
    "align_static",
    "belief_at_start",
    "need_usable",
    "level_attitude",
    "orientation_start",
    "rest_seconds",
    "start_belief",
    "static_alignment",
    "usable",
]


_LEAST_FORCE = 1.0  # m/s^2: a unit that reads less is in free fall, or has not started


def usable(readings: npt.NDArray[np.float64], least: float = _LEAST_FORCE) -> npt.NDArray[np.bool_]:
    """Which of the readings (n, 3) of an accelerometer show where up is: finite, and not of nearly no length.

    Args:
        least: the shortest that does; 0 for a magnetic field, of which only zero shows nothing.
    """
    with np.errstate(invalid="ignore"):
        size = np.linalg.norm(readings, axis=-1)
        return np.asarray(np.isfinite(size) & (size > least))


def need_usable(readings: npt.NDArray[np.float64], path: str) -> npt.NDArray[np.bool_]:
    """Which of the readings (n, 3) of an accelerometer are `usable`.

    Raises:
        DataError: where none is.
    """
    shown = usable(readings)
    if not shown.any():
        raise DataError(
            "no reading of the accelerometer shows where up is",
            path=path,
            expected=f"a finite specific force longer than {_LEAST_FORCE:g} m/s^2",
            got=f"none in {len(readings)} readings",
            fix="check the columns of the accelerometer and their unit",
        )
    return shown


@block
def align_static(  # type: ignore[no-untyped-def]
    state,
    imu: Imu,
    field: MagneticField | None,
    *,
    north: float = np.pi / 2.0,
    rate: float = 0.035,
    force: float = 0.5,
    slowest: float = 0.1,
    nearest: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    dt: float,
    xp: Any,
) -> tuple[Any, Alignment]:
    """Align a body from the first reading on for as long as it rests.

        up = mean(specific_force)      north = mean(field), horizontal part      gyro_bias = mean(gyro)

    The means are over the readings so far, and end for good at the first reading that is not one of rest.

    Args:
        imu: rad/s and m/s^2, body.
        field: T, body; optional. Without one ever, the attitude is the one nearest to `nearest`.
        north: rad, from the world's x axis to the field's horizontal part; pi/2 where y is north.
        rate, force: rad/s and m/s^2, the most by which a reading at rest is off the mean so far.
        slowest: rad/s, the largest mean rate that may still be a bias.

    State: number of readings and their means, the sum of the field, seconds, and whether it still rests.
    """
    count = state["count"]
    first = xp.astype(count == 0.0, imu.gyro.dtype)
    off_rate = (imu.gyro - state["gyro"]) * (1.0 - first)
    off_force = (imu.specific_force - state["force"]) * (1.0 - first)
    calm = (
        (xp.linalg.vecdot(off_rate, off_rate) <= rate**2)
        & (xp.linalg.vecdot(off_force, off_force) <= force**2)
        & (xp.linalg.vecdot(state["gyro"], state["gyro"]) <= slowest**2)
    )
    resting = state["resting"] * xp.astype(calm, imu.gyro.dtype)
    count = count + resting
    share = resting / xp.maximum(count, 1.0)
    gyro = state["gyro"] + (imu.gyro - state["gyro"]) * share
    mean = state["force"] + (imu.specific_force - state["force"]) * share
    pointer = state["field"] if field is None else state["field"] + field.field * resting
    seconds = state["seconds"] + dt * resting
    attitude = aligned(mean, pointer, north=north, nearest=nearest, xp=xp)
    after = {
        "count": count,
        "gyro": gyro,
        "force": mean,
        "field": pointer,
        "seconds": seconds,
        "resting": resting,
    }
    return after, Alignment(attitude=attitude, gyro_bias=gyro, resting=resting, seconds=seconds)


@align_static.init
def _unaligned(*_: Any, **__: Any) -> dict[str, Any]:
    none = {name: np.float64(0.0) for name in ("count", "seconds")}
    return {**none, **{name: np.zeros(3) for name in ("gyro", "force", "field")}, "resting": np.float64(1.0)}


def aligned(force: Array, field: Array, *, north: float, nearest: Any, xp: Any) -> Array:
    """The attitude (..., 4) that takes `force` up and the horizontal part of `field` north; where there is no
    field (zero), the one nearest to `nearest`."""
    upright = level(xp.asarray(nearest, dtype=force.dtype) + 0.0 * force[..., :1], force, xp=xp)
    m = rotate(upright, field, xp=xp)
    flat = m[..., 0] ** 2 + m[..., 1] ** 2
    turn = xp.where(flat > 0.0, north - xp.atan2(m[..., 1], m[..., 0]), 0.0 * flat)
    about_z = from_rotation_vector(turn[..., None] * xp.asarray((0.0, 0.0, 1.0), dtype=force.dtype), xp=xp)
    return normalize(multiply(about_z, upright, xp=xp), xp=xp)


def static_alignment(
    imu: Series,
    field: Series | None = None,
    *,
    seconds: float = 2.0,
    least: float = 0.25,
    north: float = np.pi / 2.0,
    nearest: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Alignment:
    """The alignment from the start of a recording, over at most `seconds` of rest: `align_static` at its
    last tick of rest.

    Where the body rests for less than `least` seconds, the first reading alone gives the attitude, the bias
    is zero, and `resting` is 0. Readings that show no direction (`usable`) are passed over.

    Args:
        imu: a series of `Imu`. field: of `MagneticField`.
        north, nearest: as in `align_static`.
    """
    imu = imu[need_usable(imu["specific_force"], imu.name)]
    field = None if field is None else field[usable(field["field"], 0.0)]
    end = imu.time[0] + round(seconds * 1e9)
    part = imu[imu.time <= end]
    near = None if field is None else field[field.time <= end]
    settings: dict[str, Any] = {
        "north": north,
        "rate": 0.035,
        "force": 0.5,
        "slowest": 0.1,
        "nearest": nearest,
    }
    state: Any = _unaligned()
    found: Alignment | None = None
    before = part.time[0]
    stamps = {} if near is None else {int(t): k for k, t in enumerate(near.time)}
    for t, reading in zip(part.time, part, strict=True):
        k = stamps.get(int(t))
        z = None if near is None or k is None else near[k]
        state, now = align_static.step(state, reading, z, dt=(t - before) * 1e-9, xp=np, **settings)
        before = t
        if not now.resting:
            break
        found = now
    if found is not None and found.seconds >= least:
        return found
    pointer = np.zeros(3) if near is None or not len(near) else near["field"][0]
    q = aligned(part["specific_force"][0], pointer, north=north, nearest=nearest, xp=np)
    zero = np.float64(0.0)
    return Alignment(attitude=q, gyro_bias=np.zeros(3), resting=zero, seconds=zero)


def rest_seconds(imu: Series, *, rate: float = 0.03, force: float = 0.3, most: float = 10.0) -> float:
    """For how many seconds from its first reading on a body rests, told by means and not by single readings
    as in `align_static`: for units whose readings scatter by more than the rates to be told.

    The means of the readings over tenths of a second stay within `rate` (rad/s) and `force` (m/s^2) of the
    first such mean. The last two tenths before it moves are left out.
    """
    number = (imu.time - imu.time[0]) // 100_000_000
    first: np.ndarray | None = None
    bound = np.repeat([rate, force], 3)
    for tenth in range(math.floor(min(most, float(number[-1]) / 10.0) * 10.0)):
        at = number == tenth
        if not at.any():
            return max(tenth - 2, 0) / 10.0
        mean = np.concatenate([imu["gyro"][at].mean(axis=0), imu["specific_force"][at].mean(axis=0)])
        first = mean if first is None else first
        if (np.abs(mean - first) > bound).any() or np.abs(mean[:3]).max() > 0.2:
            return max(tenth - 2, 0) / 10.0
    return min(most, float(number[-1]) / 10.0)


class Start(NamedTuple):
    """Where an orientation filter starts: attitude (4), seconds of rest, and where up is (3, body)."""

    attitude: np.ndarray
    still: float
    up: tuple[float, float, float]


def orientation_start(
    flight: Flight, imu: Series, still: float | None = None, *, nearest: npt.ArrayLike | None = None
) -> Start:
    """Level by the mean specific force at rest, or by the first reading, with the heading of the truth's
    first attitude; without a truth that of the world.

    Readings that show no direction (`usable`) are passed over.

    Args:
        still: seconds of rest at the start; those that the flight tells, or that its readings show, if left
            out.
        nearest: the attitude (4) whose heading it is, in place of the truth's.

    Raises:
        DataError: where no reading shows where up is.
    """
    found = flight.info.get("still") if still is None else still
    still = rest_seconds(imu) if found is None else float(found)
    if nearest is None:
        nearest = np.array([1.0, 0.0, 0.0, 0.0])
        if flight.truth is not None and "attitude" in flight.truth.leaves:
            q = flight.truth["attitude"]
            q = q[np.isfinite(q).all(axis=-1)]
            nearest = q[0] if len(q) else nearest
    push = imu["specific_force"]
    shown = need_usable(push, flight.name)
    first = int(np.argmax(shown))
    mean = push[shown & (imu.time - imu.time[first] <= round(still * 1e9))].mean(axis=0)
    x, y, z = (mean / np.linalg.norm(mean)).tolist()
    q = aligned(mean, np.zeros(3), north=0.0, nearest=nearest, xp=np)
    return Start(np.asarray(q), still, (x, y, z))


@block
def level_attitude(
    force: SpecificForce, *, nearest: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0), xp: Any
) -> Attitude:
    """The attitude that takes the measured specific force to world +z and is nearest to a reference.

    With u = R(nearest) force, it is the smallest rotation from u to +z, after `nearest`. Right when the body
    does not accelerate; a horizontal acceleration a tilts it by about a / 9.81 rad.

    Args:
        force: m/s^2, body; not zero.
        nearest: the reference, a unit quaternion, body to world.
    """
    return Attitude(attitude=level(xp.asarray(nearest, dtype=force.force.dtype), force.force, xp=xp))


@dataclass(frozen=True)
class StartSpread:
    """Standard deviations of a start, each the same on its axes.

    Args:
        position: m.
        velocity: m/s.
        tilt: rad, about each horizontal axis.
        heading: rad, about the vertical.
        gyro_bias: rad/s.
        accelerometer_bias: m/s^2.
    """

    position: float = 0.7
    velocity: float = 0.7
    tilt: float = 0.1
    heading: float = 0.05
    gyro_bias: float = 0.1
    accelerometer_bias: float = 0.1


def start_belief(
    position: npt.ArrayLike,
    attitude: npt.ArrayLike,
    *,
    specific_force: npt.ArrayLike | None = None,
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    spread: StartSpread = StartSpread(),
) -> Belief:
    """A belief to start from, with zero biases.

    Args:
        position: (3,) m, world.
        attitude: (4,) unit quaternion, body to world.
        specific_force: (3,) m/s^2, body: when given, the attitude is levelled with it, as `level_attitude`
            does.
        velocity: (3,) m/s, world.
        spread: how sure the start is. Tilt and heading are about world axes, and turned into the body here.
    """
    q = np.asarray(attitude, dtype=float)
    if specific_force is not None:
        q = np.asarray(level(q, np.asarray(specific_force, dtype=float), xp=np))
    return _belief(np.array(position, dtype=float), np.array(velocity, dtype=float), q, spread, np)


@block
def belief_at_start(
    truth: NavigationState, imu: Imu, *, levelled: bool = True, spread: StartSpread = StartSpread(), xp: Any
) -> Belief:
    """`start_belief` at the truth's position and attitude, levelled by the specific force, and at rest."""
    q = level(truth.attitude, imu.specific_force, xp=xp) if levelled else truth.attitude
    return _belief(truth.position, 0.0 * truth.position, q, spread, xp)


def _belief(position: Array, velocity: Array, q: Array, spread: StartSpread, xp: Any) -> Belief:
    before = np.repeat([spread.position, spread.velocity], 3) ** 2
    after = np.repeat([spread.gyro_bias, spread.accelerometer_bias], 3) ** 2
    R = to_matrix(q, xp=xp)
    about = xp.asarray(np.diag(np.square([spread.tilt, spread.tilt, spread.heading])), dtype=q.dtype)
    rows = [
        xp.asarray(np.diag(before) @ np.eye(6, 15), dtype=q.dtype),
        xp.concat([xp.zeros((3, 6)), xp.matrix_transpose(R) @ about @ R, xp.zeros((3, 6))], axis=1),
        xp.asarray(np.diag(after) @ np.eye(6, 15, k=9), dtype=q.dtype),
    ]
    P = xp.concat(rows, axis=0)
    none = xp.zeros((3,), dtype=q.dtype)
    return Belief(
        position=position,
        velocity=velocity,
        attitude=q,
        gyro_bias=none,
        accelerometer_bias=none,
        covariance=0.5 * (P + xp.matrix_transpose(P)),
    )
