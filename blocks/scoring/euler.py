"""Filters of fifteen states with Euler angles on flights: what is set, where they start, how they did.

Their score is that of other filters, and how near the attitude came to where the angles fail.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np

from flowgraph import Case, Result, Series
from flowgraph.blocks.geometry.euler import ORDERS
from flowgraph.blocks.geometry.rotations import rotate
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.euler_ins import (
    euler_steps,
    singularity_warning,
    start_gaussian,
    with_heading,
)
from flowgraph.blocks.models.recordings import euler_recording
from flowgraph.blocks.models.unscented_ins import far_points
from flowgraph.blocks.scoring.cases import (
    Adapted,
    Factors,
    HeldControl,
    OnFlight,
    PoseAided,
    Scored,
    SmoothedPoseFilter,
)
from flowgraph.blocks.scoring.covariances import Covariance, six_by_six
from flowgraph.blocks.scoring.scorer import Scorer
from flowgraph.blocks.scoring.settings import NotNegative, Positive, Settings, named
from flowgraph.blocks.scoring.tuning import given, reading_of
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.unscented.sigma_points import SigmaPoints
from flowgraph.errors import DeclarationError

__all__ = [
    "MEASURED",
    "EulerFilter",
    "EulerKalman",
    "EulerModel",
    "EulerOrder",
    "EulerPose",
    "FarPoints",
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
    """What is believed of an IMU; its factors are numbers where they are left out, too.

    Args:
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU.
        gyro_bias_noise, accelerometer_bias_noise: densities of the random walks of the biases, in
            rad/s^2/sqrt(Hz) and m/s^3/sqrt(Hz); those of the flight's IMU if left out.
    """

    gyro_factor: Positive = 1.0
    accelerometer_factor: Positive = 1.0
    gyro_bias_noise: NotNegative | None = None
    accelerometer_bias_noise: NotNegative | None = None

    def imu_noise(self, on: OnFlight, otherwise: tuple[float, float] = (1.0, 1.0)) -> ImuNoise:
        """The noise of the flight's IMU, times the factors, with the walks that are set."""
        noise = super().imu_noise(on, otherwise)
        return replace(
            noise,
            gyro_bias=given(self.gyro_bias_noise, noise.gyro_bias),
            accelerometer_bias=given(self.accelerometer_bias_noise, noise.accelerometer_bias),
        )


@dataclass(frozen=True)
class EulerModel(ScaledFactors, Scored):
    """What is set of every filter with Euler angles.

    Args:
        order: zxy (the course's) or zyx (the report's).
    """

    order: EulerOrder = "zxy"

    def judge(
        self, on: OnFlight, inputs: Mapping[str, Series], start: Any, known: Mapping[str, Any]
    ) -> EulerScore:
        """The score of a run on that flight.

        Args:
            inputs: by source.
            start: what the graph starts from.
            known: settings of the graph itself.
        """
        return euler_score(on, self, self.order)

    def case(
        self, on: OnFlight, start: Any, *, inputs: Mapping[str, Series] | None = None, **settings: Any
    ) -> Case:
        """The filter on that flight.

        Args:
            on: with the stream `imu`.
            start: what the graph starts from.
            inputs: by source; those that were needed if left out.
            settings: of the graph itself, beside noise, order and start.
        """
        known = {
            "noise": self.imu_noise(on),
            "order": self.order,
            "reading": reading_of(on.flight),
            "gravity": on.gravity,
            **settings,
        }
        given_ = on.inputs if inputs is None else inputs
        return on.case(self.judge(on, given_, start, known), inputs=inputs, start=start, **known)


@dataclass(frozen=True)
class EulerKalman(EulerModel, HeldControl, Adapted):
    """What is set of every Kalman filter with Euler angles."""

    def case(
        self, on: OnFlight, start: Any, *, inputs: Mapping[str, Series] | None = None, **settings: Any
    ) -> Case:
        """As of `EulerModel`, with a gate, and with what the age of the IMU's readings does."""
        held = self.held(on, (on.inputs if inputs is None else inputs)["imu"], inputs)
        return super().case(on, start, inputs=inputs, held=held, **self.gating(), **settings)


@dataclass(frozen=True)
class EulerPose(EulerModel, PoseAided):
    """What is set of a filter with Euler angles that is corrected by measured poses.

    Args:
        tags: all, even or odd: the ids that PnP uses.
        position_noise, attitude_noise: standard deviations, m and rad, beyond the pose's own covariance; the
            flight's, or 0.002 and 0.002, if left out.
        R: in place of these, the covariance of (x, y, z, phi, theta, psi), m and rad: a matrix (6, 6), its
            diagonal or one variance; in words, so many numbers with commas between them, or a file of them.
    """

    tags: str = "all"
    R: Annotated[Covariance | None, six_by_six] = None

    def covariance(self, on: OnFlight) -> np.ndarray:
        """R (6, 6) of (position, angles), beyond the covariance of a measured pose itself.

        Raises:
            DeclarationError: where both R and a deviation are set.
        """
        if self.R is not None:
            if (self.position_noise, self.attitude_noise) != (None, None):
                raise DeclarationError(
                    "the noise of a pose is said twice",
                    path=f"{on.name}.R",
                    expected="R, or position_noise and attitude_noise",
                    got="both",
                    fix="leave R out, or the deviations",
                )
            return Covariance.of(self.R).matrix(6)
        info = on.flight.info
        p = given(self.position_noise, info.get("position_noise", 0.002))
        a = given(self.attitude_noise, info.get("attitude_noise", 0.002))
        return np.diag(np.repeat(np.square([p, a]), 3))


@dataclass(frozen=True)
class EulerFilter(EulerKalman, EulerPose, SmoothedPoseFilter):
    """What is set of a Kalman filter with Euler angles that is corrected by measured poses."""

    def judge(
        self, on: OnFlight, inputs: Mapping[str, Series], start: Any, known: Mapping[str, Any]
    ) -> EulerScore:
        """The score of a run, and of the smoothed one."""
        steps = partial(euler_steps, order=self.order)
        told = ("noise", "order", "reading", "gravity", "R", "lever", "held")
        recording = euler_recording(inputs, start=start, **{name: known[name] for name in told})
        return EulerScore(self.score(on, pose_errors, steps=steps, recording=recording), self.order)


@dataclass(frozen=True)
class FarPoints(Settings):
    """Where the sigma points of state and noises lie.

    Args:
        alpha, beta, kappa: of the sigma points; without alpha they lie sqrt(3) deviations away, where they
            match a Gaussian's fourth moment. In float32 or fixed point alpha must be at least 0.1.
    """

    alpha: Positive | None = None
    beta: float = 2.0
    kappa: float = 0.0

    def points(self, noises: int) -> SigmaPoints:
        """The set for a state with so many noises.

        Raises:
            DeclarationError: where the three numbers make no set.
        """
        return far_points(noises, alpha=self.alpha, beta=self.beta, kappa=self.kappa)


MEASURED = ("pose", "tags", "vicon")
"""The streams that poses are taken from: the first that a flight has."""


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

    Where the flight says that the poses are those of a point of the body, `pose_lever` or `vicon_lever`, the
    filter is told.

    Args:
        on: with the stream `imu`.
        pose: the measured poses.
        inflate: on all standard deviations of the measured pose beyond its own covariance.
        start: makes the graph's start of a belief around the first measured pose.
        settings: of the graph itself.
    """
    begin = filter.pose(on, {**on.inputs, "pose": pose}, position=pose, attitude=pose, usual="file")
    place = begin.position
    source = next((name for name in MEASURED if name in on.flight.streams), "pose")
    lever = tuple(float(x) for x in on.flight.info.get(f"{source}_lever", (0.0, 0.0, 0.0)))
    if any(lever) and not begin.told:
        place = place - rotate(begin.attitude, np.asarray(lever), xp=np)
    first = start_gaussian(place, begin.attitude, order=filter.order)
    return filter.case(
        on,
        start(with_heading(first, begin.heading)),
        inputs=begin.inputs,
        R=filter.covariance(on) * inflate**2,
        lever=lever,
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
