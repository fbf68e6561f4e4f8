"""Navigation outdoors over a space: what a smoother of `gnss_ins` goes back over, and what a batch is given.

The motion is that of `inertial.navigation`, with its noise; a position is seen as `aid_gnss_position` sees
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from flowgraph import Array, Result, Series
from flowgraph.blocks.filtering.batch import Aged, Derived, Recording
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import rotate
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.inertial.navigation import (
    PARAMETERS,
    Earth,
    navigation_crossing,
    places,
    predict_navigation,
)
from flowgraph.blocks.inertial.outdoors import AT_UNIT, Antenna
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.kalman.smoothing import Steps
from flowgraph.blocks.models.recordings import drive_at
from flowgraph.blocks.signals import Belief, Gaussian, Imu, NavigationBelief
from flowgraph.blocks.statespace import Measurement, MeasurementModel

__all__ = [
    "antenna_seen",
    "height_seen",
    "navigation_moves",
    "navigation_recording",
    "navigation_space",
    "navigation_steps",
]

_PARTS = ("position", "velocity", "attitude", "gyro_bias", "accelerometer_bias")


def navigation_space(estimated: tuple[str, ...]) -> StateSpace:
    """Pose, velocity, biases, and what is estimated beside them."""
    more = sum(PARAMETERS[name].size for name in estimated)
    return StateSpace(
        **{name: quaternion() if name == "attitude" else euclidean(3) for name in _PARTS},
        **({"parameters": euclidean(more)} if more else {}),
    )


def navigation_steps(result: Result, *, estimated: tuple[str, ...]) -> Steps:
    """Those of a run of `gnss_ins` that was wired for a smoother.

    Args:
        estimated: what the filter estimates, names of `PARAMETERS`.
    """
    space = navigation_space(estimated)
    prior, posterior = (_stacked(result[name], space) for name in ("prior", "belief"))
    return Steps(prior, posterior, result["cross"], space, _named)


def navigation_moves(
    noise: ImuNoise, gravity: tuple[float, float, float], earth: Earth | None, estimated: tuple[str, ...]
) -> Derived:
    """`predict_navigation` as a motion: its step, its Jacobian and its noise. Arguments as there."""
    space = navigation_space(estimated)
    n = space.tangent
    crossing = navigation_crossing(gravity, earth, estimated)

    def linearised(x: Array, imu: Imu, dt: Any, xp: Any) -> tuple[Array, Array, Array]:
        one = xp.eye(n, dtype=x.dtype)
        here = _belief(x, 0.0 * one, xp)
        after = predict_navigation.step(
            here, imu, noise=noise, gravity=gravity, earth=earth, estimated=estimated, dt=dt, xp=xp
        )
        F = crossing(_belief(x, one, xp), imu, dt, xp).mT
        mean = xp.concat([getattr(after, part) for part in space.names], axis=-1)
        return mean, F, after.covariance  # which, of what was exact, is Q

    return Derived(space, linearised)


def antenna_seen(antenna: Antenna, estimated: tuple[str, ...]) -> MeasurementModel:
    """The position of an antenna, as `aid_gnss_position` sees it, with the covariance of the message."""
    where = places(estimated)

    def observe(x: Any, xp: Any) -> Array:
        kind = x.position.dtype
        arm, late = xp.asarray(antenna.lever, dtype=kind), antenna.late
        if "lever" in where:
            arm = x.parameters[..., where["lever"]]
        if "time_offset" in where:
            late = x.parameters[..., where["time_offset"]]
        return x.position + rotate(x.attitude, arm, xp=xp) - x.velocity * late

    read = lambda fix: fix.position
    return MeasurementModel(navigation_space(estimated), observe, noise=lambda fix: fix.covariance, read=read)


def height_seen(noise: float, estimated: tuple[str, ...]) -> MeasurementModel:
    """A height by the pressure of the air, as `aid_height` sees it (m)."""
    where = places(estimated)

    def observe(x: Any, xp: Any) -> Array:
        up = x.position[..., 2:3]
        return up + x.parameters[..., where["height_offset"]] if "height_offset" in where else up

    return MeasurementModel(navigation_space(estimated), observe, noise=np.array([noise**2]))


def navigation_recording(
    inputs: Mapping[str, Series], *, start: Any, noise: ImuNoise, gravity: tuple[float, float, float],
    reading: str, earth: Earth | None = None, antenna: Antenna = AT_UNIT, estimated: tuple[str, ...] = (),
    height_noise: float = 0.5, held: Held | None = None,
) -> Recording | None:  # fmt: skip
    """What `gnss_ins` is given; None where it is more than `imu`, `gnss` and `barometer`.

    Args:
        inputs: of the graph. start: its belief.
        reading: as in `drive_at`.
        noise, gravity, earth, antenna, estimated, height_noise, held: as the graph has them.
    """
    if not {"imu", "gnss"} <= set(inputs) <= {"imu", "gnss", "barometer"}:
        return None
    seen: dict[Measurement, Series] = {antenna_seen(antenna, estimated): inputs["gnss"]}
    if "barometer" in inputs:
        seen[height_seen(height_noise, estimated)] = inputs["barometer"]
    moves = navigation_moves(noise, gravity, earth, estimated)
    mean = np.concatenate([getattr(start, part) for part in moves.space.names])
    aged = None if held is None else Aged(inputs["imu"], held, {"position": 0, "velocity": 3, "attitude": 6})
    return Recording(
        moves,
        seen,
        Gaussian(mean=mean, covariance=np.asarray(start.covariance)),
        partial(drive_at, imu=inputs["imu"], reading=reading),
        None if held is None else held.longest,
        aged,
    )


def _belief(x: Array, covariance: Array, xp: Any) -> Any:
    """A state (size) with names."""
    ends = (0, 3, 6, 10, 13, 16)
    parts: tuple[Any, ...] = (*(x[..., a:b] for a, b in pairwise(ends)),)
    if x.shape[-1] == 16:
        return Belief(*(*parts, covariance))
    return NavigationBelief(*(*parts, x[..., 16:], covariance))


def _stacked(series: Series, space: StateSpace) -> Series:
    mean = np.concatenate([series[part] for part in space.names], axis=-1)
    return Series(series.time, Gaussian(mean=mean, covariance=series["covariance"]), name=series.name)


def _named(smoothed: Series) -> Series:
    return Series(smoothed.time, _belief(smoothed["mean"], smoothed["covariance"], np), name=smoothed.name)
