"""Problems of estimation whose model is known exactly: what is drawn is drawn from the model itself.

So the right filter is consistent, its NEES is the dimension of the state in the mean, and what a method loses
it loses by its approximation alone. Each is a motion, a measurement and a start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array, Series, Signal, Stream, graph, real
from flowgraph.blocks.filtering import (
    DiscreteModel,
    Gaussian,
    LinearMeasurement,
    MeasurementModel,
    StateSpace,
    angle,
    euclidean,
    filtered,
)
from flowgraph.blocks.geometry.rotations import conjugate, rotate
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.models.inertial_pose import INERTIAL, inertial_motion, pose_seen
from flowgraph.blocks.models.tracking import (
    BICYCLE,
    PENDULUM,
    TURNING,
    bicycle,
    constant_velocity,
    coordinated_turn,
    pendulum,
)
from flowgraph.blocks.signals import Imu, Steering
from flowgraph.language.declare import GraphFunction

__all__ = ["BEACONS", "PROBLEMS", "Drawn", "Measured", "Problem", "declared", "distances", "drawn"]

SECOND = 1_000_000_000


class Measured(Signal):
    """What was measured, as a vector."""

    value: Array = real("m")


@dataclass(frozen=True)
class Problem:
    """A model, and how long it is followed.

    Args:
        motion, measurement, start: of the filter, and of the truth.
        step: s, between measurements.
        steps: how many there are.
        control: of each step (n, ...), given the state before it; None where the motion takes none.
        control_type: of `control`. linear: whether the Kalman filter will do.
    """

    motion: Any
    measurement: Any
    start: Gaussian
    step: float
    steps: int
    control: Callable[[int, np.ndarray], Any] | None = None
    control_type: type[Signal] | None = None
    linear: bool = False


@dataclass(frozen=True)
class Drawn:
    """A truth (n, size) and what is told of it."""

    truth: np.ndarray
    inputs: dict[str, Series]


def drawn(problem: Problem, seed: int) -> Drawn:
    """One run of the model: states and measurements by its own noise."""
    rng, space = np.random.default_rng(seed), problem.motion.space
    root = np.linalg.cholesky(problem.start.covariance)
    x = space.plus(problem.start.mean, root @ rng.normal(size=space.tangent), np)[None, :]
    states, seen, told = [], [], []
    for k in range(problem.steps):
        u = None if problem.control is None else problem.control(k, x[0])
        if k:
            shaken = problem.motion.noise_root(u, problem.step, np.float64, np)
            x = problem.motion.carry(x, u, rng.normal(size=(1, len(shaken))) @ shaken.T, problem.step, np)
        states.append(x[0])
        told.append(u)
        seen.append(_seen(problem.measurement, x, rng))
    time = np.arange(problem.steps) * round(problem.step * SECOND)
    inputs = {"z": Series(time, Measured(value=np.array(seen)), name="z")}
    if problem.control_type is not None:
        fields = problem.control_type._fields
        stacked = {name: np.array([getattr(u, name) for u in told]) for name in fields}
        inputs = {"control": Series(time, problem.control_type(**stacked), name="control"), **inputs}
    return Drawn(np.array(states), inputs)


def _seen(measurement: Any, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if measurement.inside:
        noise = np.linalg.cholesky(measurement.covariance(None, 0, np.float64, np))
        return np.asarray(measurement.seen(x, rng.normal(size=(1, len(noise))) @ noise.T, None, np)[0])
    z = measurement.seen(x, None, None, np)[0]
    space = measurement.measured_space
    m = len(z) if space is None else space.tangent
    v = np.linalg.cholesky(measurement.covariance(None, m, np.float64, np)) @ rng.normal(size=m)
    return np.asarray(z + v if space is None else space.plus(z, v, np))


def declared(problem: Problem) -> GraphFunction:
    """The filter of a problem, with its method as a setting."""
    if problem.control_type is None:

        @graph
        def free(z: Stream[Measured], *, method: Any):
            """A state that nothing drives."""
            return filtered(problem.motion, {problem.measurement: z}, start=problem.start, method=method)

        return free
    Control = problem.control_type

    @graph
    def driven(control: Stream[Control], z: Stream[Measured], *, method: Any):  # type: ignore[valid-type]
        """A state and what drives it."""
        return filtered(
            problem.motion, {problem.measurement: z}, control=control, start=problem.start, method=method
        )

    return driven


# -- the problems ----------------------------------------------------------------------------------------


def _point() -> Problem:
    motion = constant_velocity(0.5)
    start = motion.space.gaussian(position=((0.0, 0.0), 2.0), velocity=((1.0, -1.0), 1.0))
    return Problem(
        motion, LinearMeasurement(motion.space, np.eye(2, 4), noise=1.0), start, 0.5, 100, linear=True
    )


def _range_and_bearing(x: Any, xp: Any) -> tuple[Array, Array]:
    p = x.position
    return xp.sqrt(xp.sum(p * p, axis=-1)), xp.atan2(p[..., 1], p[..., 0])


def _radar() -> Problem:
    motion = constant_velocity(0.5)
    seen = MeasurementModel(
        motion.space, _range_and_bearing, noise=[4.0, 4e-4], measured_space=StateSpace(euclidean(1), angle())
    )
    start = motion.space.gaussian(position=((300.0, 200.0), 10.0), velocity=((-3.0, 2.0), 2.0))
    return Problem(motion, seen, start, 0.5, 100)


BEACONS = np.array([[0.0, 0.0], [400.0, 100.0]])
"""Whose distances are measured in `ranges`, m."""


def distances(p: Array, xp: Any) -> Array:
    """From each of the `BEACONS` (..., 2) to a position (..., 2)."""
    apart = p[..., None, :] - xp.asarray(BEACONS)
    return xp.sqrt(xp.sum(apart * apart, axis=-1))


def _ranges() -> Problem:
    motion = constant_velocity(0.5)
    seen = MeasurementModel(motion.space, lambda x, xp: distances(x.position, xp), noise=[4.0, 4.0])
    start = motion.space.gaussian(position=((150.0, 200.0), 10.0), velocity=((-3.0, 2.0), 2.0))
    return Problem(motion, seen, start, 0.5, 100)


_STATIONS = np.array([[0.0, 0.0], [200.0, 0.0]])


def _bearings(x: Any, xp: Any) -> Array:
    apart = x.position[..., None, :] - xp.asarray(_STATIONS)
    return xp.atan2(apart[..., 1], apart[..., 0])


def _turn() -> Problem:
    seen = MeasurementModel(TURNING, _bearings, noise=[1e-4, 1e-4], measured_space=StateSpace(angle(2)))
    start = TURNING.gaussian(
        position=((100.0, 150.0), 5.0), velocity=((10.0, 0.0), 1.0), rate=(0.1, 0.05)
    )  # fmt: skip
    return Problem(coordinated_turn(0.3, 0.01), seen, start, 0.5, 100)


def _bicycle() -> Problem:
    seen = MeasurementModel(BICYCLE, lambda x, xp: x.position, noise=4.0)
    start = BICYCLE.gaussian(position=((0.0, 0.0), 2.0), heading=(0.3, 0.2), speed=(5.0, 0.5))
    told = lambda k, x: Steering(
        angle=np.float64(0.2 * np.sin(0.1 * k)), acceleration=np.float64(-0.5 * (x[3] - 5.0))
    )
    motion = bicycle(2.7, steering=0.02, acceleration=0.3)
    return Problem(motion, seen, start, 0.2, 150, told, Steering)


def _pendulum() -> Problem:
    seen = MeasurementModel(PENDULUM, lambda x, xp: xp.sin(x.angle), noise=0.1)
    start = PENDULUM.gaussian(angle=(1.0, 0.3), rate=(0.0, 0.5))
    return Problem(pendulum(1.0, push=0.3), seen, start, 0.05, 200)


def _pose() -> Problem:
    noise = ImuNoise(gyro=0.02, accelerometer=0.1, gyro_bias=0.0, accelerometer_bias=0.0)
    start = INERTIAL.gaussian(
        position=(np.zeros(3), 0.3), velocity=(np.zeros(3), 0.3), attitude=([1.0, 0.0, 0.0, 0.0], 0.2)
    )

    def told(k: int, x: np.ndarray) -> Imu:
        """What turns the body about, and holds it near the origin."""
        wanted = np.array([0.0, 0.0, 9.81]) - 0.5 * x[:3] - 0.8 * x[3:6]
        rate = 0.8 * np.array([np.sin(0.11 * k), np.cos(0.07 * k), np.sin(0.05 * k + 1.0)])
        return Imu(gyro=rate, specific_force=np.asarray(rotate(conjugate(x[6:], xp=np), wanted, xp=np)))

    return Problem(inertial_motion(noise), pose_seen(0.1, 0.1), start, 0.05, 150, told, Imu)


def _volatility() -> Problem:
    motion = DiscreteModel([[0.95]], [[0.09]], space=StateSpace(level=euclidean(1)))
    seen = MeasurementModel(motion.space, lambda x, v, xp: xp.exp(0.5 * x.level) * v, noise=1.0)
    return Problem(motion, seen, motion.space.gaussian(level=(0.0, 0.95)), 0.1, 300)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "point": _point,
    "radar": _radar,
    "ranges": _ranges,
    "turn": _turn,
    "bicycle": _bicycle,
    "pendulum": _pendulum,
    "pose": _pose,
    "volatility": _volatility,
}
"""A point seen in place, by range and bearing, and by two ranges; a turn seen by two bearings; a car with
GPS; a pendulum seen from the side; a pose by an IMU and motion capture; a noise whose level is sought."""
