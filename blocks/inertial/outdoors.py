"""Aiding outdoors: correct an inertial belief with satellites, heights, directions, wheels and standing
still.

Each block takes a prior and an optional measurement, as those of `aiding` do: without one the prior passes
through and there is no innovation; an entry that is NaN was not measured.

Source: P. Groves, "Principles of GNSS, inertial, and multisensor integrated navigation systems", 2nd ed.,
2013, secs. 14.3 (loosely coupled integration), 15.1 (standing still), 6.1 (headings), 16.3 (wheels).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry.rotations import conjugate, rotate, skew
from flowgraph.blocks.inertial.aiding import aided, correct_belief
from flowgraph.blocks.inertial.navigation import places
from flowgraph.blocks.kalman.filters import scaled
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.signals import (
    GnssHeading,
    GnssPosition,
    GnssVelocity,
    Height,
    Imu,
    KalmanInnovation,
    MagneticField,
    WheelSpeed,
)

__all__ = [
    "AT_UNIT",
    "Antenna",
    "Resting",
    "aid_antennas",
    "aid_compass",
    "aid_gnss_position",
    "aid_gnss_velocity",
    "aid_height",
    "aid_wheels",
    "standing",
]


class Antenna(NamedTuple):
    """Where an antenna sits (m, body), and by how much its fixes are late (s), where these are not
    estimated."""

    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    late: float = 0.0


AT_UNIT = Antenna()
"""One that sits at the unit and is never late."""


@block
def aid_gnss_position(
    prior: Any,
    fix: GnssPosition | None,
    scale: Any = None,
    *,
    antenna: Antenna = AT_UNIT,
    estimated: tuple[str, ...] = (),
    gate: float | None = None,
    robust: Robust | None = None,
    invariant: bool = False,
    xp: Any,
) -> tuple[Any, KalmanInnovation | None]:
    """Correct a belief with the measured position of an antenna, which was true `late` seconds before.

    z = p + R lever - v late + noise, noise of the covariance that came with it.

    Args:
        prior: `Belief`, or with anything `estimated` a `NavigationBelief`.
        fix: the position, m, and its covariance, m^2; or absent.
        antenna: what is known of it; `lever` and `time_offset` count as known unless they are estimated.
        estimated: names of `PARAMETERS`.
        gate, robust, scale, invariant: as in `aid_position`.

    Returns:
        The posterior, and the innovation (m, world) where there was a fix.
    """
    if fix is None:
        return prior, None

    def see(x: Any, xp: Any) -> Array:
        arm, late = _antenna(x, antenna, estimated, xp)
        return x.position + rotate(x.attitude, arm, xp=xp) - x.velocity * late

    return aided(prior, fix.position, see, scaled(fix.covariance, scale, xp), gate, invariant, xp, robust)


@block
def aid_gnss_velocity(
    prior: Any,
    fix: GnssVelocity | None,
    imu: Imu,
    scale: Any = None,
    *,
    antenna: Antenna | None = AT_UNIT,
    estimated: tuple[str, ...] = (),
    gate: float | None = None,
    robust: Robust | None = None,
    invariant: bool = False,
    xp: Any,
) -> tuple[Any, KalmanInnovation | None]:
    """Correct a belief with the measured velocity of an antenna.

    z = v + R (w x lever) + noise, w = gyro - gyro_bias; of the time by which a fix is late nothing is taken:
    it would need the acceleration.

    Args:
        imu: the last reading.
        antenna: what is known of it; None where it is the unit itself of which the velocity is known.
        prior, fix, estimated, gate, robust, scale, invariant: as in `aid_gnss_position`.
    """
    if fix is None:
        return prior, None
    if antenna is None:
        H = np.eye(3, prior.covariance.shape[-1], 3)
        apart, H = fix.velocity - prior.velocity, xp.asarray(H, dtype=prior.velocity.dtype)
        return correct_belief(prior, apart, H, scaled(fix.covariance, scale, xp), gate, invariant, xp, robust)

    def see(x: Any, xp: Any) -> Array:
        arm, _ = _antenna(x, antenna, estimated, xp)
        swing = skew(imu.gyro - x.biases[..., :3], xp=xp) @ arm[..., None]
        return x.velocity + rotate(x.attitude, swing[..., 0], xp=xp)

    return aided(prior, fix.velocity, see, scaled(fix.covariance, scale, xp), gate, invariant, xp, robust)


@block
def aid_height(
    prior: Any,
    height: Height | None,
    scale: Any = None,
    *,
    noise: float,
    estimated: tuple[str, ...] = (),
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Any, KalmanInnovation | None]:
    """Correct a belief with a height: z = p_up + height_offset + noise.

    Args:
        noise: standard deviation, m.
        prior, estimated, gate, robust, scale: as in `aid_gnss_position`.
    """
    if height is None:
        return prior, None
    kind = prior.position.dtype
    where = places(estimated)
    level = 0.0 * prior.position[..., 2]
    if "height_offset" in where:
        level = prior.parameters[..., where["height_offset"].start]
    H = np.zeros((1, prior.covariance.shape[-1]))
    H[0, 2] = 1.0
    if "height_offset" in where:
        H[0, 15 + where["height_offset"].start] = 1.0
    apart = (height.height - prior.position[..., 2] - level)[..., None]
    S = scaled(xp.asarray([[noise**2]], dtype=kind), scale, xp)
    return correct_belief(prior, apart, xp.asarray(H, dtype=kind), S, gate, False, xp, robust)


@block
def aid_compass(
    prior: Any,
    magnetometer: MagneticField | None,
    scale: Any = None,
    *,
    north: float,
    noise: float,
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Any, KalmanInnovation | None]:
    """Correct a belief with the direction of the magnetic field over the ground.

    The field's horizontal part points `north` (rad from the world's x axis); that across it is zero:
    0 = e^T R z / |horizontal part of R z| + noise. The dip of the field is not needed, and an error of the
    tilt counts as far as the field dips.

    Args:
        magnetometer: z, of the body's axes and without their bias; or absent.
        noise: standard deviation, rad.
        prior, gate, robust, scale: as in `aid_gnss_position`.
    """
    if magnetometer is None:
        return prior, None
    across = xp.asarray([-math.sin(north), math.cos(north), 0.0], dtype=prior.position.dtype)
    along = xp.asarray([math.cos(north), math.sin(north), 0.0], dtype=prior.position.dtype)
    return _directed(prior, magnetometer.field, across, along, noise**2, scale, gate, xp, robust)


@block
def aid_antennas(
    prior: Any,
    heading: GnssHeading | None,
    scale: Any = None,
    *,
    baseline: tuple[float, float, float] = (1.0, 0.0, 0.0),
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Any, KalmanInnovation | None]:
    """Correct a belief with the direction over the ground from one antenna to another.

    Args:
        heading: the angle and its deviation; or absent.
        baseline: from the one to the other, body.
        prior, gate, robust, scale: as in `aid_gnss_position`.
    """
    if heading is None:
        return prior, None
    kind = prior.position.dtype
    s, c = xp.sin(heading.angle)[..., None], xp.cos(heading.angle)[..., None]
    across, along = xp.concat([-s, c, 0.0 * s], axis=-1), xp.concat([c, s, 0.0 * s], axis=-1)
    b = xp.asarray(baseline, dtype=kind)
    return _directed(prior, b, across, along, heading.deviation**2, scale, gate, xp, robust)


@block
def aid_wheels(
    prior: Any,
    wheels: WheelSpeed | None,
    imu: Imu,
    scale: Any = None,
    *,
    noise: float,
    slip: float,
    axle: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Any, KalmanInnovation | None]:
    """Correct a belief with how a vehicle rolls: its speed by the wheels, and that it moves along its x axis.

    z = (speed, 0, 0) = R^T v + w x axle + noise. A speed that is NaN leaves the two others.

    Args:
        imu: the last reading.
        noise: standard deviation of the speed, m/s. slip: of what is across, m/s.
        axle: the point that moves along x, such as the middle of the rear axle, m, body.
        prior, gate, robust, scale: as in `aid_gnss_position`.
    """
    if wheels is None:
        return prior, None
    kind = prior.position.dtype
    arm = xp.asarray(axle, dtype=kind)
    still = 0.0 * prior.velocity[..., :1]
    seen = xp.concat([wheels.speed[..., None], still, still], axis=-1)

    def see(x: Any, xp: Any) -> Array:
        swing = skew(imu.gyro - x.biases[..., :3], xp=xp) @ arm[..., None]
        return rotate(conjugate(x.attitude, xp=xp), x.velocity, xp=xp) + swing[..., 0]

    S = scaled(xp.asarray(np.diag([noise**2, slip**2, slip**2]), dtype=kind), scale, xp)
    return aided(prior, seen, see, S, gate, False, xp, robust)


class Resting(NamedTuple):
    """How standing still is told by an inertial unit.

    Args:
        rate, force: rad/s and m/s^2, the most by which a reading at rest is off the mean of those before.
        seconds: for so long it must have been so.
        speed: m/s, the most at which a belief lets it be rest.
        noise: m/s, the standard deviation of a velocity at rest.
    """

    rate: float = 0.02
    force: float = 0.2
    seconds: float = 0.5
    speed: float = 0.5
    noise: float = 0.02


@block
def standing(  # type: ignore[no-untyped-def]
    state, belief: Any, imu: Imu, *, resting: Resting, dt: float, xp: Any
):
    """A velocity of zero where the body stands still, by readings that stay as they are; NaN where it moves.

    A body that moves steadily reads the same: so none is taken for resting that the belief has moving.

    Fires when its inputs do. State: the mean of the readings over `seconds`, and for how long they have been
    near it, 0 before the first.
    """
    reading = xp.concat([imu.gyro, imu.specific_force], axis=-1)
    share = xp.minimum(1.0 + 0.0 * state["calm"], (dt + 0.0 * state["calm"]) / resting.seconds)
    share = xp.where(state["begun"] > 0.0, share, 1.0 + 0.0 * share)
    mean = state["mean"] + (reading - state["mean"]) * share
    off = xp.abs(reading - mean)
    bound = xp.asarray([resting.rate] * 3 + [resting.force] * 3, dtype=reading.dtype)
    near = xp.all(off <= bound, axis=-1)
    calm = xp.where(near, state["calm"] + dt, 0.0 * state["calm"])
    slow = xp.linalg.vecdot(belief.velocity, belief.velocity) <= resting.speed**2
    still = (calm >= resting.seconds) & slow
    zero = 0.0 * belief.velocity
    velocity = xp.where(still[..., None], zero, zero + xp.asarray(math.nan, dtype=zero.dtype))
    S = xp.eye(3, dtype=zero.dtype) * resting.noise**2
    return {"mean": mean, "calm": calm, "begun": 1.0 + 0.0 * calm}, GnssVelocity(
        velocity=velocity, covariance=S
    )


@standing.init
def _moving(*_: Any, **__: Any) -> dict[str, Any]:
    return {"mean": np.zeros(6), "calm": np.float64(0.0), "begun": np.float64(0.0)}


def _directed(
    prior: Any,
    seen: Array,
    across: Array,
    along: Array,
    variance: Any,
    scale: Any,
    gate: float | None,
    xp: Any,
    robust: Robust | None,
) -> tuple[Any, KalmanInnovation]:
    """The correction by a vector of the body (3) that points `along` the ground, and has nothing `across`."""

    def see(x: Any, xp: Any) -> Array:
        m = rotate(x.attitude, seen, xp=xp)
        return xp.atan2(xp.linalg.vecdot(across, m), xp.linalg.vecdot(along, m))[..., None]

    nothing = 0.0 * prior.position[..., :1]
    S = scaled((variance + 0.0 * nothing)[..., None], scale, xp)
    return aided(prior, nothing, see, S, gate, False, xp, robust)


def _antenna(x: Any, antenna: Antenna, estimated: tuple[str, ...], xp: Any) -> tuple[Array, Any]:
    """Its lever (3) and by how much it is late, of a state; estimated or known."""
    where, parameters = places(estimated), x.biases[..., 6:]
    arm = parameters[..., where["lever"]] if "lever" in where else None
    arm = xp.asarray(antenna.lever, dtype=x.position.dtype) if arm is None else arm
    return arm, parameters[..., where["time_offset"]] if "time_offset" in where else antenna.late
