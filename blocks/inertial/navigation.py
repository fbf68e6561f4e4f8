"""Navigation over the Earth: the prediction of `imu` where the Earth turns and is round, with more to
estimate.

The world is east, north, up about a place. It turns with the Earth, and gravity points to the Earth's middle
and fades with height. Beside the fifteen numbers of a `Belief` a filter may estimate, as chosen when it is
built, numbers that stay or walk slowly: where the antenna sits, scale factors of the unit, by how much fixes
are late, the level of a barometer.

Source: P. Groves, "Principles of GNSS, inertial, and multisensor integrated navigation systems", 2nd ed.,
2013, secs. 2.4 (gravity, the Earth's turn), 5.4 (a local frame), 14.2 (the states of an integration).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry.geodetic import FLATTENING, SEMI_MAJOR_AXIS
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.inertial.imu import ImuNoise, carried
from flowgraph.blocks.signals import Belief, Imu, NavigationBelief

__all__ = [
    "PARAMETERS",
    "Earth",
    "Parameter",
    "earth_at",
    "extended",
    "gravity_at",
    "navigation_crossing",
    "places",
    "predict_navigation",
]


class Parameter(NamedTuple):
    """A number, or a few, that a filter may estimate: how many, their deviation at the start, and how fast
    they walk, per sqrt(s)."""

    size: int
    deviation: float
    walk: float


PARAMETERS: Mapping[str, Parameter] = {
    "lever": Parameter(3, 0.3, 0.0),
    "gyro_scale": Parameter(3, 0.01, 0.0),
    "accelerometer_scale": Parameter(3, 0.01, 0.0),
    "time_offset": Parameter(1, 0.1, 0.0),
    "height_offset": Parameter(1, 30.0, 0.05),
}
"""What can be estimated. A barometer's level walks by 3 m in an hour, as the weather does."""


def places(estimated: Sequence[str]) -> dict[str, slice]:
    """Where each stands among the parameters."""
    found, at = {}, 0
    for name in estimated:
        found[name] = slice(at, at + PARAMETERS[name].size)
        at += PARAMETERS[name].size
    return found


def extended(
    start: Belief, estimated: Sequence[str], *, lever: Sequence[float] = (0.0, 0.0, 0.0), **deviations: float
) -> Belief | NavigationBelief:
    """A belief to start from, with parameters of zero, or the `lever` as far as it is known (m).

    The position of the start is taken for that of the antenna, so that it is less sure, and hangs together
    with the lever, where that is estimated.

    Args:
        estimated: names of `PARAMETERS`; with none it is the belief as it is.
        deviations: by name, where they are others than those of `PARAMETERS`.
    """
    R = to_matrix(start.attitude, xp=np)
    start = start.replace(position=start.position - R @ np.asarray(lever, dtype=float))
    if not estimated:
        return start
    spread = np.concatenate(
        [np.full(PARAMETERS[n].size, deviations.get(n, PARAMETERS[n].deviation)) for n in estimated]
    )
    values = np.zeros(len(spread))
    where = places(estimated)
    if "lever" in where:
        values[where["lever"]] = lever
    P = np.zeros((15 + len(spread),) * 2)
    P[:15, :15] = start.covariance
    P[15:, 15:] = np.diag(spread**2)
    if "lever" in where:
        columns = slice(15 + where["lever"].start, 15 + where["lever"].stop)
        variance = spread[where["lever"]] ** 2
        P[:3, :3] += R @ np.diag(variance) @ R.T
        P[:3, columns] = -R * variance
        P[columns, :3] = P[:3, columns].T
    kept = {n: getattr(start, n) for n in start._fields if n != "covariance"}
    return NavigationBelief(**kept, parameters=values, covariance=P)


class Earth(NamedTuple):
    """The Earth about the origin of the world.

    Args:
        turn: rad/s, in the world.
        radius: m, over which gravity changes its direction and size.
    """

    turn: tuple[float, float, float]
    radius: float


def earth_at(latitude: float) -> Earth:
    """The Earth at a latitude, rad."""
    rate = 7.292115e-5
    return Earth((0.0, rate * math.cos(latitude), rate * math.sin(latitude)), 6_371_000.0)


def gravity_at(latitude: float, height: float) -> tuple[float, float, float]:
    """Gravity in a world of east, north, up, m/s^2: Somigliana's on the ellipsoid, less by the height (m).

    Source: Groves eqs. 2.134 and 2.139, WGS84.
    """
    s = math.sin(latitude) ** 2
    on_it = 9.7803253359 * (1.0 + 0.001931853 * s) / math.sqrt(1.0 - FLATTENING * (2.0 - FLATTENING) * s)
    share = 0.00344978650684  # of the centrifugal force, at the equator
    near = 1.0 - 2.0 / SEMI_MAJOR_AXIS * (1.0 + FLATTENING * (1.0 - 2.0 * s) + share) * height
    return 0.0, 0.0, -on_it * (near + 3.0 * height**2 / SEMI_MAJOR_AXIS**2)


@block
def predict_navigation(
    belief: Any,
    imu: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float],
    earth: Earth | None = None,
    estimated: tuple[str, ...] = (),
    dt: float,
    xp: Any,
) -> Any:
    """Predict a belief over `dt` seconds with one IMU reading, held over the step: `predict`, and

        w = (gyro - gyro_bias) (1 - gyro_scale) - R^T turn       f = (specific_force - bias) (1 - scale)
        a = R f + gravity(p) - 2 turn x v,   gravity(p) = |gravity| (-x/r, -y/r, -(1 - 2 z/r))

    Scale factors are of each axis. What gravity and the Earth's turn do to errors is left out of the
    Jacobian: over the seconds between fixes it is below 1e-3 of them.

    Args:
        belief: `Belief`, or with anything `estimated` a `NavigationBelief`.
        noise: densities of the unit.
        gravity: m/s^2, at the origin of the world.
        earth: None: it is flat and does not turn.
        estimated: names of `PARAMETERS`, in the order of `belief.parameters`.

    Fires when its inputs do. No state of its own.
    """
    values, F = _carried(belief, imu, gravity, earth, estimated, dt, xp)
    if estimated:
        values["parameters"] = belief.parameters
    Q = xp.asarray(_power(noise, estimated), dtype=belief.position.dtype) * (0.5 * dt)
    P = F @ (belief.covariance + Q) @ F.mT + Q
    return type(belief)(
        **values,
        gyro_bias=belief.gyro_bias,
        accelerometer_bias=belief.accelerometer_bias,
        covariance=0.5 * (P + P.mT),
    )


def navigation_crossing(
    gravity: tuple[float, float, float], earth: Earth | None, estimated: tuple[str, ...]
) -> Callable[[Any, Imu, Any, Any], Array]:
    """What `cross_covariance` asks of a filter that predicts with `predict_navigation`."""

    def crossing(belief: Any, imu: Imu, dt: Any, xp: Any) -> Array:
        return belief.covariance @ _carried(belief, imu, gravity, earth, estimated, dt, xp)[1].mT

    return crossing


def _carried(
    belief: Any,
    imu: Imu,
    gravity: tuple[float, float, float],
    earth: Earth | None,
    estimated: tuple[str, ...],
    dt: Any,
    xp: Any,
) -> tuple[dict[str, Array], Array]:
    """Position, velocity and attitude after a step, by name, and the Jacobian of all that is estimated."""
    kind = belief.position.dtype
    rate = imu.gyro - belief.gyro_bias
    force = imu.specific_force - belief.accelerometer_bias
    raw = {"gyro_scale": rate, "accelerometer_scale": force}
    where = places(estimated)
    gyro, pushed = imu.gyro, imu.specific_force
    if "gyro_scale" in where:
        gyro = gyro - rate * belief.parameters[..., where["gyro_scale"]]
    if "accelerometer_scale" in where:
        pushed = pushed - force * belief.parameters[..., where["accelerometer_scale"]]
    pull = xp.asarray(gravity, dtype=kind)
    if earth is not None:
        turn = xp.asarray(earth.turn, dtype=kind)
        R = to_matrix(belief.attitude, xp=xp)
        gyro = gyro - (R.mT @ turn[..., None])[..., 0]
        strength = math.sqrt(sum(g * g for g in gravity)) / earth.radius
        fades = xp.asarray(np.diag([-strength, -strength, 2.0 * strength]), dtype=kind)
        swing = xp.asarray(-2.0 * _cross(earth.turn), dtype=kind)
        pull = pull + (fades @ belief.position[..., None] + swing @ belief.velocity[..., None])[..., 0]
    values, F = carried(belief, Imu(gyro=gyro, specific_force=pushed), pull, dt, xp)
    more = sum(PARAMETERS[name].size for name in estimated)
    if not more:
        return values, F
    columns, left = [], {9: 1.0 + 0.0 * rate, 12: 1.0 + 0.0 * force}
    for name in estimated:
        if name in raw:  # as the bias of its axis does, times the reading
            at = 9 if name == "gyro_scale" else 12
            left[at] = 1.0 - belief.parameters[..., where[name]]  # of a bias
            upper = F[..., :9, at : at + 3] * raw[name][..., None, :]
            columns.append(xp.concat([upper, 0.0 * F[..., 9:, :3]], axis=-2))
        else:
            columns.append(0.0 * F[..., :, : PARAMETERS[name].size])
    if any(name in raw for name in estimated):
        biased = F[..., :9, 9:] * xp.concat([left[9], left[12]], axis=-1)[..., None, :]
        F = xp.concat([xp.concat([F[..., :9, :9], biased], axis=-1), F[..., 9:, :]], axis=-2)
    corner = 0.0 * F[..., :more, :more] + xp.eye(more, dtype=kind)
    below = xp.concat([0.0 * F[..., :more, :], corner], axis=-1)
    return values, xp.concat([xp.concat([F, *columns], axis=-1), below], axis=-2)


def _power(noise: ImuNoise, estimated: Sequence[str]) -> np.ndarray:
    """The spectral density of all that drives the error."""
    walks = [PARAMETERS[name].walk ** 2 for name in estimated for _ in range(PARAMETERS[name].size)]
    return np.diag([*noise.power(), *walks])


def _cross(v: Sequence[float]) -> np.ndarray:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
