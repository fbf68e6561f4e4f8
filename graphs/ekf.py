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

from flowgraph import Case, Flight, Stream, clocks_of, collect, delay, graph, latest
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.pose import (
    between_imu,
    pose_belief,
    pose_steps,
    predict_pose,
    start_pose,
    update_pose,
)
from flowgraph.blocks.scoring.scorer import scorer
from flowgraph.blocks.scoring.tuning import (
    check_settings,
    gravity_of,
    noise_of,
    reading_of,
    unbiased_noise_of,
    with_imu,
)
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
    gravity: tuple[float, float, float] = GRAVITY,
):
    """Extended Kalman filter of velocity, position and quaternion: IMU control, motion capture pose.

    A `reading` of the IMU is of an "instant", and a step is driven by the mean of the two at its ends; or it
    is the "mean" over the time since the one before, and drives that step alone.

    Collected: at every tick `belief`, and `prior`, `posterior` and `control` for a smoother; at every pose
    the `innovation`.
    """
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | vicon, name="control")
    drive = control if reading == "mean" else between_imu(last, control)
    prior = predict_pose(belief, drive, noise=noise, gravity=gravity)
    posterior, innovation = update_pose(
        prior, vicon, position_noise=position_noise, attitude_noise=attitude_noise, lever=lever, gate=gate
    )
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    return {"belief": pose_belief(posterior), "prior": prior, "posterior": posterior, "control": drive}


@ekf.on_flight
def for_flight(
    flight: Flight,
    *,
    gyro_factor: float | None = None,
    accelerometer_factor: float | None = None,
    position_noise: float | None = None,
    attitude_noise: float | None = None,
    gate: float | None = None,
    smooth: str = "none",
    lag: float | None = None,
    settle: float = 1.0,
) -> Case:
    """Start the filter on a flight with an IMU and a motion capture, at the capture's first pose and at rest.

    Args:
        flight: with the streams `imu` and `vicon` (Pose). In place of `imu` it may have the thesis's unit:
            `gyro` and `coordinate_acceleration`, with the same times.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. The filter knows no biases,
            so left out they are 20 for a unit whose biases walk, and 1 for one that has none.
        position_noise, attitude_noise: standard deviations in m and rad; the flight's own if left out.
        gate: below 1 the probability with which an honest measurement passes, from 1 on the largest NIS.
        smooth: "rts" also scores the smoothed run.
        lag: s; also scores the run smoothed with a fixed lag.
        settle: seconds at the start that the errors leave out.
    """
    factors = {"gyro_factor": gyro_factor, "accelerometer_factor": accelerometer_factor}
    noises = {"position_noise": position_noise, "attitude_noise": attitude_noise}
    check_settings("ekf", {**factors, **noises, "gate": gate}, settle=settle, smooth=smooth, lag=lag)
    flight = with_imu(flight)
    inputs = flight.need("ekf", "imu", "vicon")
    first = inputs["vicon"][0]
    built = ekf.build(
        **clocks_of(inputs),
        start=start_pose(first.position, first.attitude),
        noise=unbiased_noise_of("ekf", flight, gyro_factor, accelerometer_factor),
        position_noise=noise_of("ekf", flight, "position_noise", position_noise, 0.004),
        attitude_noise=noise_of("ekf", flight, "attitude_noise", attitude_noise, 0.01),
        lever=tuple(flight.info.get("vicon_lever", (0.0, 0.0, 0.0))),
        reading=reading_of(flight),
        gate=gate,
        gravity=gravity_of(flight),
    )
    score = scorer(flight, pose_errors, settle=settle, steps=pose_steps, smooth=smooth, lag=lag)
    return Case(built, inputs, score)
