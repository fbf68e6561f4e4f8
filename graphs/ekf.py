"""The extended Kalman filter of a quadrotor's pose: ten states, IMU as control, motion capture as
measurement.

State: velocity, position, quaternion. Every tick predicts to now with the IMU; a tick with a pose also
corrects.

    predict   x- = f(x, u, dt)                 P- = F P F^T + Q      F = df/dx
    correct   x = x- + K (z minus h(x-))       P = (I - K H) P- (I - K H)^T + K R K^T      H = dh/dx

The noise of the quaternion, 4 x 4, is an unscented transform of the rate noise; the quaternion is scaled to
unit norm after each step, and the covariance with it.

Source: R. Fiszel, thesis (2017), section on the extended Kalman filter. Mended: the covariance is corrected
with a minus sign, and a correction starts from the prediction. The equations stand in `blocks/extended.py`.
"""

from __future__ import annotations

from typing import Any

from flowgraph import (
    Case,
    DataError,
    Flight,
    Result,
    Stream,
    collect,
    delay,
    graph,
    latest,
    timing_of,
)  # fmt: skip
from flowgraph.blocks.extended import (
    QuaternionBelief,
    between_imu,
    pose_belief,
    predict_pose,
    start_pose,
    update_pose,
)  # fmt: skip
from flowgraph.blocks.inertial import GRAVITY, ImuNoise
from flowgraph.blocks.metrics import pose_errors
from flowgraph.blocks.signals import Imu, Pose
from flowgraph.checks import need_numbers


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
    gate: float | None = None,
    gravity: tuple[float, float, float] = GRAVITY,
):
    """Extended Kalman filter of velocity, position and quaternion: IMU control, motion capture pose.

    Collected: `belief` at every tick, and the `innovation` at every pose.
    """
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | vicon, name="control")
    prior = predict_pose(belief, between_imu(last, control), noise=noise, gravity=gravity)
    posterior, innovation = update_pose(
        prior, vicon, position_noise=position_noise, attitude_noise=attitude_noise, lever=lever, gate=gate
    )
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    return {"belief": pose_belief(posterior)}


@ekf.on_flight
def for_flight(
    flight: Flight,
    *,
    gyro_factor: float | None = None,
    accelerometer_factor: float | None = None,
    position_noise: float | None = None,
    attitude_noise: float | None = None,
    gate: float | None = None,
    settle: float = 1.0,
) -> Case:
    """Start the filter on a flight with an IMU and a motion capture, at the capture's first pose and at rest.

    Args:
        flight: with the streams `imu` and `vicon` (Pose).
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. The filter knows no biases,
            so left out they are 20 for a unit whose biases walk, and 1 for one that has none.
        position_noise, attitude_noise: standard deviations in m and rad; the flight's own if left out.
        gate: a measurement with a larger normalised innovation squared changes nothing.
        settle: seconds at the start that the errors leave out.
    """
    need_numbers(
        "ekf",
        positive={
            "gyro_factor": gyro_factor,
            "accelerometer_factor": accelerometer_factor,
            "position_noise": position_noise,
            "attitude_noise": attitude_noise,
            "gate": gate,
        },
        not_negative={"settle": settle},
    )
    if not {"imu", "vicon"} <= set(flight.streams):
        raise DataError(
            "this flight lacks what ekf needs",
            path=flight.name,
            expected="streams imu and vicon",
            got=", ".join(flight.streams),
            fix="choose another flight, or build ekf with your own sources",
        )
    inputs = {name: flight.streams[name] for name in ("imu", "vicon")}
    clocks: dict[str, Any] = {name: timing_of(series) for name, series in inputs.items()}
    truth, first, info = flight.truth, inputs["vicon"][0], flight.info
    unit = info["imu_noise"]
    otherwise = 20.0 if unit.gyro_bias or unit.accelerometer_bias else 1.0
    built = ekf.build(
        **clocks,
        start=start_pose(first.position, first.attitude),
        noise=unit.scaled(
            gyro=otherwise if gyro_factor is None else gyro_factor,
            accelerometer=otherwise if accelerometer_factor is None else accelerometer_factor,
        ),
        position_noise=info.get("position_noise", 0.004) if position_noise is None else position_noise,
        attitude_noise=info.get("attitude_noise", 0.01) if attitude_noise is None else attitude_noise,
        lever=tuple(info.get("vicon_lever", (0.0, 0.0, 0.0))),
        gate=gate,
    )

    def score(result: Result) -> dict[str, float]:
        return {} if truth is None else pose_errors(result["belief"], truth, settle=settle)

    return Case(built, inputs, score)
