"""Navigation outdoors over a space: what a smoother of `gnss_ins` goes back over, and what a batch is given.

The motion is that of `inertial.navigation`, with its noise; what is seen stands in `navigation_seen`.
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
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.inertial.navigation import (
    PARAMETERS,
    Earth,
    navigation_crossing,
    predict_navigation,
)
from flowgraph.blocks.inertial.outdoors import AT_UNIT, Antenna
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.kalman.smoothing import Steps
from flowgraph.blocks.models.navigation_seen import (
    antenna_seen,
    antennas_seen,
    compass_seen,
    height_seen,
    turning,
    velocity_seen,
    wheels_seen,
)
from flowgraph.blocks.models.recordings import drive_at
from flowgraph.blocks.signals import Belief, Gaussian, Imu, NavigationBelief
from flowgraph.blocks.statespace import Measurement

__all__ = [
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


def navigation_recording(
    inputs: Mapping[str, Series], *, start: Any, noise: ImuNoise, gravity: tuple[float, float, float],
    reading: str, earth: Earth | None = None, antenna: Antenna = AT_UNIT, estimated: tuple[str, ...] = (),
    baseline: tuple[float, float, float] = (1.0, 0.0, 0.0), north: float = 0.0, compass_noise: float = 0.1,
    height_noise: float = 0.5, speed_noise: float = 0.1, slip: float = 0.1,
    axle: tuple[float, float, float] = (0.0, 0.0, 0.0), held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `gnss_ins` is given: `imu`, and any of the other sensors.

    Args:
        inputs: of the graph. start: its belief.
        reading: as in `drive_at`.
        noise, gravity, earth, antenna, estimated, baseline, north, compass_noise, height_noise, speed_noise,
            slip, axle, held: as the graph has them.
    """
    moves, imu = navigation_moves(noise, gravity, earth, estimated), inputs["imu"]
    space = moves.space
    models: dict[str, Measurement] = {
        "gnss": antenna_seen(space, antenna, estimated),
        "gnss_velocity": velocity_seen(space, antenna, estimated),
        "heading": antennas_seen(space, baseline),
        "magnetometer": compass_seen(space, north, compass_noise),
        "barometer": height_seen(space, height_noise, estimated),
        "wheels": wheels_seen(space, speed_noise, slip, axle),
    }
    told = {name: inputs[name] for name in models if name in inputs}
    told |= {name: turning(told[name], imu) for name in ("gnss_velocity", "wheels") if name in told}
    for name, leaf in (("magnetometer", "field"), ("heading", "angle")):  # a NaN has no derivative
        if name in told:
            told[name] = told[name][np.isfinite(told[name][leaf]).reshape(len(told[name]), -1).all(axis=-1)]
    mean = np.concatenate([getattr(start, part) for part in space.names])
    aged = None if held is None else Aged(imu, held, {"position": 0, "velocity": 3, "attitude": 6})
    return Recording(
        moves,
        {models[name]: series for name, series in told.items()},
        Gaussian(mean=mean, covariance=np.asarray(start.covariance)),
        partial(drive_at, controls=imu, reading=reading),
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
