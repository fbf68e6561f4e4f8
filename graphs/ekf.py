"""The extended Kalman filter of a quadrotor's pose: ten states, IMU as control, motion capture as
measurement.

State: velocity, position, quaternion. Every tick predicts to now with the IMU; a tick with a pose also
corrects.

    predict   x- = f(x, u, dt)                 P- = F P F^T + Q      F = df/dx
    correct   x = x- + K (z minus h(x-))       P = (I - K H) P- (I - K H)^T + K R K^T      H = dh/dx

The noise of the quaternion, 4 x 4, is an unscented transform of the rate noise; the quaternion is scaled to
unit norm after each step, and the covariance with it.

Source: R. Fiszel, thesis (2017), section on the extended Kalman filter. Mended: the covariance is corrected
with a minus sign, and a correction starts from the prediction. The equations stand in
`blocks/models/pose.py`.
"""

from __future__ import annotations

from flowgraph import Case, Stream, collect, delay, graph, latest
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.models.pose import (
    driving,
    in_tangent_space,
    pose_at_start,
    pose_belief,
    pose_steps,
    predict_pose,
    start_pose,
    update_pose,
)
from flowgraph.blocks.scoring.capture import on_capture
from flowgraph.blocks.scoring.cases import OnFlight, SmoothedPoseFilter, on_flight
from flowgraph.blocks.scoring.tuning import with_imu
from flowgraph.blocks.signals import Imu, Pose, QuaternionBelief


@graph
def ekf(
    imu: Stream[Imu],
    vicon: Stream[Pose],
    *,
    start: QuaternionBelief,
    noise: ImuNoise,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    reading: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
    gravity: tuple[float, float, float] = GRAVITY,
):
    """Extended Kalman filter of velocity, position and quaternion: IMU control, motion capture pose.

    A `reading` of the IMU is of an "instant", and a step is driven by the mean of the two at its ends; or it
    is the "mean" over the time since the one before, and drives that step alone.

    Collected: at every tick `belief`, and `prior`, `posterior` and `control` for a smoother; at every pose
    the `innovation`.
    """
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(gravity), name="last_control")
    control = latest(imu, init=Imu.at_rest(gravity), at=imu | vicon, name="control")
    drive = driving(last, control, reading)
    prior = predict_pose(belief, drive, noise=noise, gravity=gravity)
    prior = bridged(belief, prior, imu, held=held, position=3, velocity=0, attitude=6)
    scale = scale_of(adaptive, "vicon")
    posterior, innovation = update_pose(
        prior,
        vicon,
        position_noise=position_noise,
        attitude_noise=attitude_noise,
        lever=lever,
        gate=gate,
        robust=robust,
        scale=scale,
    )
    feed_scale(scale, innovation, adaptive, "vicon")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=10, attitude=6)
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    return {"belief": pose_belief(posterior), "prior": prior, "posterior": posterior, "control": drive}


@on_flight(ekf, "imu", "vicon", told=with_imu)
def for_flight(on: OnFlight, *, filter: SmoothedPoseFilter) -> Case:
    """Start the filter on a flight with an IMU and a motion capture, at the capture's first pose and at rest.

    Args:
        flight: with the streams `imu` and `vicon` (Pose). In place of `imu` it may have the thesis's unit:
            `gyro` and `coordinate_acceleration`, with the same times.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. The filter knows no biases,
            so left out they are 20 for a unit whose biases walk, and 1 for one that has none.
    """
    return on_capture(
        on, filter, start=start_pose, believed=in_tangent_space, steps=pose_steps,
        begin=lambda first, at: {"belief": pose_at_start(first("vicon"), at=at)},
    )  # fmt: skip
