"""What the filters of `euler_ins` do alike with a flight: where they start, how noisy it is, how they did."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flowgraph import Flight, Result, Series
from flowgraph.blocks.euler_ins import singularity_warning, start_gaussian
from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.kalman import Gaussian
from flowgraph.blocks.metrics import pose_errors
from flowgraph.blocks.scores import scorer

__all__ = ["POSE_NOISE", "SingularityWarning", "noise_of", "pose_covariance", "scored", "start_at"]

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
