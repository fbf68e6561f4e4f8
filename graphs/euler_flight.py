"""What the filters of `euler_ins` do alike with a flight: their settings, where they start, how noisy it is,
how they did."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flowgraph import Case, Flight, Result, Series
from flowgraph.blocks.geometry.euler import need_order
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.euler_ins import singularity_warning, start_gaussian
from flowgraph.blocks.scoring.scorer import scorer
from flowgraph.blocks.signals import Gaussian
from flowgraph.data.inputs import clocks_of
from flowgraph.graphs.tag_pose import poses_of
from flowgraph.language.checks import need_numbers
from flowgraph.language.declare import GraphFunction

__all__ = [
    "POSE_NOISE",
    "SingularityWarning",
    "need_settings",
    "noise_of",
    "on_pose_flight",
    "pose_case",
    "pose_covariance",
    "scored",
    "start_at",
]

POSE_NOISE = (0.002, 0.002)
"""Standard deviations in m and rad that a measured pose has at least, beyond its own covariance."""


class SingularityWarning(RuntimeWarning):
    """The attitude of a filter came near to where its Euler angles fail."""


def pose_covariance(
    info: Mapping[str, Any], position_noise: float | None, attitude_noise: float | None
) -> np.ndarray:
    """R (6, 6) of (position, angles): what is given, what the flight says, or `POSE_NOISE`."""
    p = info.get("position_noise", POSE_NOISE[0]) if position_noise is None else position_noise
    a = info.get("attitude_noise", POSE_NOISE[1]) if attitude_noise is None else attitude_noise
    return np.diag(np.repeat(np.square([p, a]), 3))


def noise_of(flight: Flight, gyro_factor: float, accelerometer_factor: float) -> ImuNoise:
    """The densities of the flight's IMU, times factors."""
    unit: ImuNoise = flight.info["imu_noise"]
    return unit.scaled(gyro=gyro_factor, accelerometer=accelerometer_factor)


def start_at(pose: Series, order: str) -> Gaussian:
    """A start at the first measured pose, at rest and without biases."""
    return start_gaussian(pose["position"][0], pose["attitude"][0], order=order)


def scored(flight: Flight, order: str, settle: float) -> Callable[[Result], dict[str, float]]:
    """The score of a run: errors and consistency, as every filter has them, and how near the attitude came to
    the singularity (a warning, if near)."""
    usual = scorer(flight, pose_errors, settle=settle)

    def score(result: Result) -> dict[str, float]:
        cosine = result["angles"]["cosine"]
        said = singularity_warning(cosine, order)
        if said:
            warnings.warn(said, SingularityWarning, stacklevel=2)
        return usual(result) | {"least_cosine": float(np.abs(cosine).min(initial=1.0))}

    return score


def need_settings(name: str, order: str, settle: float, **positive: float | None) -> None:
    """Refuse a convention that does not exist, and numbers out of range.

    Raises:
        DeclarationError, UnknownNameError: naming the graph and the setting.
    """
    need_order(order, f"{name}.order")
    need_numbers(name, positive=positive, not_negative={"settle": settle})


def pose_case(
    graph: GraphFunction,
    flight: Flight,
    *,
    order: str,
    tags: str,
    gyro_factor: float,
    accelerometer_factor: float,
    position_noise: float | None,
    attitude_noise: float | None,
    settle: float,
    inflate: float = 1.0,
    start: Callable[[Gaussian], Any] = lambda first: first,
    **settings: Any,
) -> Case:
    """A graph over `imu` and `pose`, made ready for a flight; settings as in `on_pose_flight`.

    Args:
        inflate: on all standard deviations of the measured pose beyond its own covariance.
        start: makes the graph's start of a belief around the first measured pose.
        settings: of the graph itself.
    """
    inputs = flight.need(graph.name, "imu") | {"pose": poses_of(graph.name, flight, tags=tags)}
    built = graph.build(
        **clocks_of(inputs),
        start=start(start_at(inputs["pose"], order)),
        noise=noise_of(flight, gyro_factor, accelerometer_factor),
        R=pose_covariance(flight.info, position_noise, attitude_noise) * inflate**2,
        order=order,
        **settings,
    )
    return Case(built, inputs, scored(flight, order, settle))


def on_pose_flight(graph: GraphFunction) -> Callable[..., Case]:
    """Register how a Kalman filter over `imu` and `pose` starts on a flight, extended or unscented."""

    @graph.on_flight
    def for_flight(
        flight: Flight,
        *,
        order: str = "zxy",
        tags: str = "all",
        gyro_factor: float = 1.0,
        accelerometer_factor: float = 1.0,
        position_noise: float | None = None,
        attitude_noise: float | None = None,
        gate: float | None = None,
        settle: float = 1.0,
    ) -> Case:
        """Start the filter at the first measured pose of a flight, at rest and without biases.

        Args:
            flight: with the stream `imu`, and one of `pose`, `tags` (of which PnP makes poses first) and
                `vicon`.
            order: zxy (the course's) or zyx (the report's).
            tags: all, even or odd: the ids that PnP uses.
            gyro_factor, accelerometer_factor: on the densities of the flight's IMU.
            position_noise, attitude_noise: standard deviations, m and rad, beyond the pose's own covariance;
                the flight's, or 0.002 and 0.002, if left out.
            gate: a measurement with a larger normalised innovation squared changes nothing.
            settle: seconds at the start that the errors leave out.

        Raises:
            DataError: where the flight lacks a stream.
            DeclarationError, UnknownNameError: for a setting that is out of range.
        """
        shared: dict[str, Any] = {
            "gyro_factor": gyro_factor,
            "accelerometer_factor": accelerometer_factor,
            "position_noise": position_noise,
            "attitude_noise": attitude_noise,
        }
        need_settings(graph.name, order, settle, gate=gate, **shared)
        return pose_case(graph, flight, order=order, tags=tags, gate=gate, settle=settle, **shared)

    return for_flight
