"""Filters of fifteen states with Euler angles on flights: what is set, where they start, how they did.

Their score is that of other filters, and how near the attitude came to where the angles fail.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from flowgraph import Case, Result, Series
from flowgraph.blocks.geometry.euler import ORDERS
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.euler_ins import singularity_warning, start_gaussian, with_heading
from flowgraph.blocks.scoring.cases import Factors, HeldControl, OnFlight, PoseAided, PoseFilter, Scored
from flowgraph.blocks.scoring.scorer import Scorer
from flowgraph.blocks.scoring.settings import Positive, named
from flowgraph.blocks.scoring.tuning import given
from flowgraph.blocks.signals import Gaussian

__all__ = [
    "EulerFilter",
    "EulerOrder",
    "EulerPose",
    "ScaledFactors",
    "SingularityWarning",
    "euler_score",
    "on_measured_pose",
]

EulerOrder = Annotated[str, named("convention of Euler angles", ORDERS)]


class SingularityWarning(RuntimeWarning):
    """The attitude of a filter came near to where its Euler angles fail."""


@dataclass(frozen=True)
class ScaledFactors(Factors):
    """Factors that are numbers where they are left out, too.

    Args:
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU.
    """

    gyro_factor: Positive = 1.0
    accelerometer_factor: Positive = 1.0


@dataclass(frozen=True)
class EulerPose(ScaledFactors, PoseAided):
    """What is set of a filter with Euler angles that is corrected by measured poses.

    Args:
        order: zxy (the course's) or zyx (the report's).
        tags: all, even or odd: the ids that PnP uses.
        position_noise, attitude_noise: standard deviations, m and rad, beyond the pose's own covariance; the
            flight's, or 0.002 and 0.002, if left out.
    """

    order: EulerOrder = "zxy"
    tags: str = "all"

    def covariance(self, on: OnFlight) -> np.ndarray:
        """R (6, 6) of (position, angles), beyond the covariance of a measured pose itself."""
        info = on.flight.info
        p = given(self.position_noise, info.get("position_noise", 0.002))
        a = given(self.attitude_noise, info.get("attitude_noise", 0.002))
        return np.diag(np.repeat(np.square([p, a]), 3))


@dataclass(frozen=True)
class EulerFilter(EulerPose, PoseFilter):
    """What is set of a Kalman filter with Euler angles that is corrected by measured poses."""


def on_measured_pose(
    on: OnFlight,
    filter: EulerPose,
    pose: Series,
    *,
    inflate: float = 1.0,
    start: Callable[[Gaussian], Any] = lambda first: first,
    **settings: Any,
) -> Case:
    """A filter over `imu` and `pose`, at the first measured pose, at rest and without biases.

    Args:
        on: with the stream `imu`.
        pose: the measured poses.
        inflate: on all standard deviations of the measured pose beyond its own covariance.
        start: makes the graph's start of a belief around the first measured pose.
        settings: of the graph itself.
    """
    begin = filter.pose(on, {**on.inputs, "pose": pose}, position=pose, attitude=pose, usual="file")
    first = start_gaussian(begin.position, begin.attitude, order=filter.order)
    more = {"held": filter.held(on, begin.inputs["imu"])} if isinstance(filter, HeldControl) else {}
    return on.case(
        euler_score(on, filter, filter.order),
        inputs=begin.inputs,
        start=start(with_heading(first, begin.heading)),
        noise=filter.imu_noise(on),
        R=filter.covariance(on) * inflate**2,
        order=filter.order,
        gravity=on.gravity,
        **more,
        **settings,
    )


@dataclass(frozen=True)
class EulerScore:
    """The score of a run: errors and consistency, as every filter has them, and how near the attitude came to
    the singularity (a warning, if near)."""

    usual: Scorer
    order: str

    def __call__(self, result: Result) -> dict[str, float]:
        cosine = result["angles"]["cosine"]
        said = singularity_warning(cosine, self.order)
        if said:
            warnings.warn(said, SingularityWarning, stacklevel=2)
        return self.usual(result) | {"least_cosine": float(np.abs(cosine).min(initial=1.0))}

    def remarks(self, result: Result) -> tuple[str, ...]:
        """Those of every filter."""
        return self.usual.remarks(result)


def euler_score(on: OnFlight, scored: Scored, order: str) -> EulerScore:
    """The score of a run on that flight."""
    return EulerScore(scored.score(on, pose_errors), order)
