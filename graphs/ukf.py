"""The unscented Kalman filter of a quadrotor's pose: ten states, IMU as control, motion capture as
measurement.

State: position, velocity, quaternion; the error of the quaternion is a rotation vector, so the covariance is
9 x 9. Every tick predicts to now with the IMU; a tick with a pose also corrects.

    predict   31 sigma points, of nine errors of the state and six of the IMU, through the motion
    correct   19 sigma points, of the state, through what the motion capture sees

    x = mean(Y_i)      P = W sum (Y_i minus Y_0)(Y_i minus Y_0)^T + (beta - alpha^2) u u^T

The mean of the quaternions is Markley's eigenvector, or Kraft's gradient descent.

Source: R. Fiszel, thesis (2017), section on the unscented Kalman filter, whose state this is; E. Wan and R.
van der Merwe, "The unscented Kalman filter for nonlinear estimation", 2000; E. Kraft, "A quaternion-based
unscented Kalman filter for orientation tracking", 2003. The equations stand in
`blocks/unscented/sigma_points.py`, `blocks/unscented/filters.py` and `blocks/models/unscented_pose.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, Case, Stream, collect, delay, graph, latest
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.backward import collect_steps
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.models.pose import POSE, driving
from flowgraph.blocks.models.unscented_pose import (
    STATE,
    carry_pose,
    imu_density,
    named_pose,
    see_pose,
    start_state,
    state_at_start,
    unscented_steps,
)
from flowgraph.blocks.scoring.capture import on_capture
from flowgraph.blocks.scoring.cases import OnFlight, SmoothedPoseFilter, on_flight
from flowgraph.blocks.scoring.settings import Positive
from flowgraph.blocks.scoring.tuning import with_imu
from flowgraph.blocks.signals import Gaussian, Imu, Pose
from flowgraph.blocks.unscented.filters import predict_unscented, unscented_crossing, update_unscented
from flowgraph.blocks.unscented.sigma_points import GAUSSIAN, SigmaPoints

_NONE = (0.0, 0.0, 0.0)


def stacked_pose(pose: Pose, *, xp: Any) -> Array:
    """A pose as one vector (7)."""
    return xp.concat([pose.position, pose.attitude], axis=-1)


@graph
def ukf(
    imu: Stream[Imu],
    vicon: Stream[Pose],
    *,
    start: Gaussian,
    noise: ImuNoise,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = _NONE,
    gravity: tuple[float, float, float] = GRAVITY,
    reading: str = "instant",
    points: SigmaPoints = GAUSSIAN,
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
    smoothing: bool = False,
):
    """Unscented Kalman filter of position, velocity and quaternion: IMU control, motion capture pose.

    Collected: `belief` at every tick, and the `innovation` at every pose; with `smoothing` what a smoother
    needs too.
    """
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(gravity), name="last_control")
    control = latest(imu, init=Imu.at_rest(gravity), at=imu | vicon, name="control")
    drive = driving(last, control, reading)
    moving: dict[str, Any] = {"move": carry_pose(gravity), "noise": imu_density(noise), "space": STATE}
    moving["points"] = points
    prior = predict_unscented(belief, drive, **moving)
    prior = bridged(belief, prior, imu, held=held, position=0, velocity=3, attitude=6)
    scale = scale_of(adaptive, "vicon")
    posterior, innovation = update_unscented(
        prior,
        vicon.map(stacked_pose, name="pose"),
        observe=see_pose(lever),
        R=np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3),
        space=STATE,
        measured_space=POSE,
        points=points,
        gate=gate,
        robust=robust,
        scale=scale,
    )
    feed_scale(scale, innovation, adaptive, "vicon")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=9, attitude=6)
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    if smoothing:
        collect_steps(belief, prior, drive, crossing=unscented_crossing(**moving), held=held)
        collect(posterior, "posterior")
    return {"belief": named_pose(posterior)}


@on_flight(ukf, "imu", "vicon", told=with_imu)
def for_flight(
    on: OnFlight,
    *,
    filter: SmoothedPoseFilter,
    alpha: Positive = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    mean: str = "markley",
) -> Case:
    """Start the filter on a flight with an IMU and a motion capture, at the capture's first pose and at rest.

    Args:
        flight: with the streams `imu` and `vicon` (Pose). In place of `imu` it may have the thesis's unit:
            `gyro` and `coordinate_acceleration`, with the same times.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. The filter knows no biases,
            so left out they are 20 for a unit whose biases walk, and 1 for one that has none.
        alpha, beta, kappa: of the sigma points; in float32 or fixed point alpha must be at least 0.1.
        mean: of quaternions, "markley" or "kraft".
    """
    return on_capture(
        on, filter, start=start_state, believed=lambda start: start, steps=unscented_steps,
        begin=lambda first, at: {"belief": state_at_start(first("vicon"), at=at)}, smoothing=filter.smoothed,
        points=SigmaPoints(alpha, beta, kappa, mean),
    )  # fmt: skip
