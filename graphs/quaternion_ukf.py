"""The quaternion-based unscented Kalman filter: attitude and body rate from an inertial unit alone.

State: quaternion and body rate; six errors, so twelve sigma points and the centre. Every reading predicts to
now and corrects.

    predict   q' = q * Exp(w dt)     w' = w         the points are drawn from P + Q dt, at sqrt(n) deviations
    correct   gyroscope: w           accelerometer: gravity turned into the body

Kraft prints points at sqrt(2 n) deviations with weights 1/(2 n), which doubles the covariance at each step;
they are at sqrt(n) here, and the centre has no weight. With weighted=True it is the scaled set of Wan and van
der Merwe instead. Noise, process and correction all multiply from the right, in the body.

Source: E. Kraft, "A quaternion-based unscented Kalman filter for orientation tracking", Fusion 2003, sec. 3.
The equations stand in `blocks/orientation/accelerometer.py`, `blocks/unscented/filters.py` and
`blocks/unscented/sigma_points.py`.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.inertial.calibration import silence_frozen_gyro, subtract_rest_bias
from flowgraph.blocks.kalman.lost import PATIENCE, find_back, stay
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.metrics.errors import orientation_errors
from flowgraph.blocks.orientation.accelerometer import (
    STATE,
    named_orientation,
    see_rate_and_gravity,
    stacked_imu,
    start_orientation,
    turn_by_rate,
)
from flowgraph.blocks.scoring.cases import OnFlight, Scored, Weighed, on_flight
from flowgraph.blocks.scoring.settings import NotNegative, Positive
from flowgraph.blocks.scoring.start import Started
from flowgraph.blocks.scoring.tuning import given
from flowgraph.blocks.signals import Gaussian, Imu
from flowgraph.blocks.unscented.filters import predict_unscented, update_unscented
from flowgraph.blocks.unscented.sigma_points import SigmaPoints

KRAFT = SigmaPoints(alpha=1.0, beta=0.0, kappa=0.0, mean="kraft")
"""2 n points at sqrt(n) deviations, of weight 1/(2 n)."""


@graph
def quaternion_ukf(
    imu: Stream[Imu],
    *,
    start: Gaussian,
    attitude_walk: float,
    rate_walk: float,
    gyro_noise: float,
    force_noise: float,
    points: SigmaPoints = KRAFT,
    still: float = 0.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    frozen: float = 0.0,
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    longest: float | None = None,
):
    """Unscented Kalman filter of attitude and body rate: gyroscope and accelerometer as measurements.

    `attitude_walk` (rad/sqrt(s)) and `rate_walk` (rad/s/sqrt(s)) drive the state; `gyro_noise` (rad/s) and
    `force_noise` (m/s^2) are standard deviations of a reading, the latter with all that accelerates the body.
    When the body stands `still` for some seconds at first, with its vertical along `up`, what the unit reads
    then is its bias. A gyroscope that is `frozen` for so many seconds is taken to read nothing.
    Collected: `belief` and `innovation` at every reading.
    """
    if still > 0.0:
        imu = subtract_rest_bias(imu, seconds=still, up=up, name="calibrate")
    if frozen > 0.0:
        imu = silence_frozen_gyro(imu, seconds=frozen, name="thaw")
    belief = delay(start, name="belief")
    prior = predict_unscented(
        belief,
        imu,
        move=turn_by_rate,
        Q=np.diag(np.repeat([attitude_walk, rate_walk], 3) ** 2),
        Q_first=True,
        space=STATE,
        points=points,
    )
    if longest is not None:
        prior = stay(belief, prior, longest=longest)
    posterior, innovation = update_unscented(
        prior,
        stacked_imu(imu, name="reading"),
        observe=see_rate_and_gravity,
        R=np.diag(np.repeat([gyro_noise, force_noise], 3) ** 2),
        space=STATE,
        points=points,
        gate=gate,
        robust=robust,
    )
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=6, attitude=0)
    belief.feed(posterior)
    collect(innovation, "innovation")
    return {"belief": named_orientation(posterior)}


@on_flight(quaternion_ukf, "imu", measured=("imu",))
def for_flight(
    on: OnFlight,
    *,
    attitude_walk: Positive = 0.02,
    rate_walk: Positive = 10.0,
    gyro_noise: Positive | None = None,
    force_noise: Positive | None = None,
    weighted: bool = False,
    alpha: Positive = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    mean: str = "kraft",
    still: NotNegative | None = None,
    frozen: NotNegative | None = None,
    gated: Weighed,
    scored: Scored,
    started: Started,
) -> Case:
    """Start the filter on a flight with an inertial unit, level, with the heading of the truth if it has one.

    Args:
        flight: with the stream `imu`.
        attitude_walk, rate_walk: densities of the random walks, rad/sqrt(s) and rad/s/sqrt(s).
        gyro_noise, force_noise: standard deviations of one reading, rad/s and m/s^2; those that the flight
            brings, or 0.02 and 2, if left out.
        weighted: whether the sigma points are the scaled set of alpha, beta and kappa.
        alpha, beta, kappa: of that set.
        mean: of quaternions, "kraft" or "markley".
        still: seconds at the start in which the body rests; told by the flight or its readings if left out.
        frozen: after so many seconds of one level a gyroscope is taken to read nothing; 0 for never, and what
            the flight says of its unit if left out: never, for nearly all.
    """
    after = float(given(frozen, on.flight.info.get("gyro_freezes", 0.0)))
    if after > 0.0:
        on.note(
            "assumed", f"imu: a gyroscope that keeps one level for {after:g} s has frozen, and reads nothing"
        )
    brought = on.flight.info.get("orientation_noise", {})
    begin, pose = started.orientation(on, on.inputs["imu"], still)
    start = start_orientation(begin.attitude)
    if pose.heading is not None:
        up = to_matrix(begin.attitude, xp=np)[2]  # the vertical, in the body
        start.covariance[:3, :3] += np.outer(up, up) * (pose.heading**2 - up @ start.covariance[:3, :3] @ up)
    return on.case(
        scored.score(on, orientation_errors, innovations=False),
        inputs=pose.inputs,
        start=start,
        attitude_walk=attitude_walk,
        rate_walk=rate_walk,
        gyro_noise=given(gyro_noise, brought.get("gyro", 0.02)),
        force_noise=given(force_noise, brought.get("force", 2.0)),
        points=SigmaPoints(alpha, beta, kappa, mean) if weighted else SigmaPoints(1.0, 0.0, 0.0, mean),
        still=begin.still,
        up=begin.up,
        frozen=after,
        longest=on.longest(),
        **gated.gating(),
    )
