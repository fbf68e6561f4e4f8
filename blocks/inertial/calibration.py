"""Calibration at rest: what a standing inertial unit reads, beyond gravity, is its bias.

A filter without bias states (a particle filter, for one) can still be honest about constant biases if the
body stands still before it moves, as a quadrotor does before it takes off.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import block
from flowgraph.blocks.signals import Imu

__all__ = ["silence_frozen_gyro", "subtract_rest_bias"]

_NEVER = np.int64(-(2**62))


@block
def subtract_rest_bias(
    state,  # type: ignore[no-untyped-def]
    imu: Imu,
    *,
    seconds: float,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    gravity: float = 9.81,
    t: int,
    xp: Any,
) -> tuple[Any, Imu]:
    """Subtract from each reading what the readings at rest had too much, on average and so far.

        bias_gyro = mean(gyro)      bias_force = mean(specific_force) - gravity * up

    The means are over the first `seconds`, running while they last: only readings that have come are used.
    A reading with a NaN does not count. Fires with each reading.

    Args:
        imu: rad/s and m/s^2, body.
        seconds: how long after its first reading the body stands still.
        up: world +z in body coordinates while it does, a unit vector. A wrong tilt becomes a wrong bias; when
            `up` is taken from the specific force itself, only the bias along it is removed.
        gravity: m/s^2.

    State: time of the first reading (int64 ns), number of readings at rest, and the bias (gyro, force).
    """
    kind = imu.gyro.dtype
    first = xp.where(state["first"] == _NEVER, t, state["first"])
    reading = xp.concat([imu.gyro, imu.specific_force])
    resting = (t - first <= round(seconds * 1e9)) & ~xp.any(xp.isnan(reading))
    count = state["count"] + resting
    expected = np.concatenate([np.zeros(3), np.asarray(up) * gravity])
    excess = reading - xp.asarray(expected, dtype=kind) - state["bias"]
    bias = state["bias"] + xp.where(resting, excess * (1.0 / xp.maximum(count, 1.0)), 0.0)
    corrected = reading - bias
    return (
        {"first": first, "count": count, "bias": bias},
        Imu(gyro=corrected[:3], specific_force=corrected[3:]),
    )


@subtract_rest_bias.init
def _(imu: Any, **_: Any) -> dict[str, Any]:
    return {"first": _NEVER, "count": np.float64(0.0), "bias": np.zeros(6)}


@block
def silence_frozen_gyro(
    state,  # type: ignore[no-untyped-def]
    imu: Imu,
    *,
    seconds: float,
    tolerance: float = 0.04,
    least: float = 0.1,
    dt: float,
    xp: Any,
) -> tuple[Any, Imu]:
    """Take a gyroscope that has frozen for one that reads nothing: its rate becomes zero.

    Some units stop measuring when they are knocked, and for a second or two give one level on each axis. A
    reading is frozen when for `seconds` none has been further than `tolerance` from the first of them on any
    axis, and on every axis it is at least `least`: a body that is held in the hand or flies hardly turns so
    steadily about an axis oblique to all three of its own. On a turntable it does, so this is for units that
    are known to freeze.

    Fires with each reading. The specific force passes through.

    Args:
        imu: rad/s and m/s^2, body; without its bias at rest.
        seconds: how long; longer than any steady turn.
        tolerance, least: rad/s.

    State: the first of the readings that are alike (rad/s), and for how long they have been (s).
    """
    near = xp.all(xp.abs(imu.gyro - state["level"]) <= tolerance)
    alike = xp.where(near, state["alike"] + dt, 0.0)
    level = xp.where(near, state["level"], imu.gyro)
    frozen = (alike >= seconds) & xp.all(xp.abs(level) >= least)
    rate = xp.where(frozen, 0.0 * imu.gyro, imu.gyro)
    return {"level": level, "alike": alike}, Imu(gyro=rate, specific_force=imu.specific_force)


@silence_frozen_gyro.init
def _(imu: Any, **_: Any) -> dict[str, Any]:
    return {"level": np.zeros(3), "alike": np.float64(0.0)}
