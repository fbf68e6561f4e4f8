"""The unscented Kalman filter of a pose: IMU as control, camera (or motion capture) as measurement.

    x = (p, e, v, b_g, b_a)      e: Euler angles, Z-X-Y as in the course or Z-Y-X as in the report

Every tick predicts to now, through sigma points that are augmented with the IMU's noises; a tick with a pose
also corrects. The pose, found by PnP on the host (`tag_pose`), is a source.

Sources: the report's first filter, and the course's nonlinear Kalman filter. Equations: `blocks/euler_ins.py`
and `blocks/unscented.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Case, Flight, Stream, collect, delay, graph, latest
from flowgraph.blocks.euler import need_order
from flowgraph.blocks.euler_ins import (
    STATE,
    euler_angles,
    increment_variances,
    navigation_belief,
    update_pose_angles,
)
from flowgraph.blocks.extended import between_imu
from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.kalman import Gaussian
from flowgraph.blocks.signals import Imu
from flowgraph.blocks.unscented import predict_unscented
from flowgraph.blocks.unscented_ins import carried, far_points
from flowgraph.blocks.vision.pnp import PoseMeasurement
from flowgraph.checks import need_numbers
from flowgraph.graphs.euler_flight import noise_of, pose_covariance, scored, start_at
from flowgraph.graphs.tag_pose import poses_of
from flowgraph.inputs import clocks_of


@graph
def ins_ukf_pose(
    imu: Stream[Imu],
    pose: Stream[PoseMeasurement],
    *,
    start: Gaussian,
    noise: ImuNoise,
    R: Any,
    order: str = "zxy",
    factor: float = 1.0,
    gate: float | None = None,
):
    """15-state unscented Kalman filter with Euler angles: IMU control, camera pose.

    Collected: `belief` and `angles` at every tick, and the `innovation` at every pose.
    """
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | pose, name="control")
    prior = predict_unscented(
        belief, between_imu(last, control), move=carried(order), noise=np.diag(increment_variances(noise)),
        space=STATE, points=far_points(12), name="predict",
    )  # fmt: skip
    posterior, innovation = update_pose_angles(
        prior, pose, order=order, R=R, factor=factor, gate=gate, name="update"
    )
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    return {
        "belief": navigation_belief(posterior, order=order),
        "angles": euler_angles(posterior, order=order),
    }


@ins_ukf_pose.on_flight
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
        flight: with the stream `imu`, and one of `pose`, `tags` (of which PnP makes poses first) and `vicon`.
        order: zxy (the course's) or zyx (the report's).
        tags: all, even or odd: the ids that PnP uses.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU.
        position_noise, attitude_noise: standard deviations, m and rad, beyond the pose's own covariance; the
            flight's, or 0.002 and 0.002, if left out.
        gate: a measurement with a larger normalised innovation squared changes nothing.
        settle: seconds at the start that the errors leave out.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    need_order(order, "ins_ukf_pose.order")
    need_numbers(
        "ins_ukf_pose",
        positive={
            "gyro_factor": gyro_factor,
            "accelerometer_factor": accelerometer_factor,
            "position_noise": position_noise,
            "attitude_noise": attitude_noise,
            "gate": gate,
        },
        not_negative={"settle": settle},
    )
    inputs = flight.need("ins_ukf_pose", "imu") | {"pose": poses_of("ins_ukf_pose", flight, tags=tags)}
    built = ins_ukf_pose.build(
        **clocks_of(inputs),
        start=start_at(inputs["pose"], order),
        noise=noise_of(flight, gyro_factor, accelerometer_factor),
        R=pose_covariance(flight.info, position_noise, attitude_noise),
        order=order,
        gate=gate,
    )
    return Case(built, inputs, scored(flight, order, settle))
