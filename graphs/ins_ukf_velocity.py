"""The unscented Kalman filter of a camera's velocity: IMU as control, optical flow as measurement.

    x = (p, e, v, b_g, b_a)      v_c = R_cb (R(e)^T v + w x r)

The camera sits at r in the body, so its velocity has a part of the body's rate w. That rate is the camera's
own (rate="camera", the report's eq. 9), or the gyroscope's minus its bias (rate="gyro", eq. 10), which the
filter estimates. The noises of rate and velocity augment the sigma points. Nothing measures position and
heading: both drift.

Source: the report's second filter. Equations: `blocks/models/euler_ins.py` and
`blocks/models/unscented_ins.py`.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from flowgraph import Case, DataError, Stream, graph
from flowgraph.blocks.geometry.rotations import level
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.lost import PATIENCE, Held
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.models.euler_ins import STATE, increment_variances, start_gaussian, with_heading
from flowgraph.blocks.models.unscented_ins import RATES, carried, far_points, update_camera_velocity
from flowgraph.blocks.scoring.cases import OnFlight, on_flight
from flowgraph.blocks.scoring.euler import EulerKalman, FarPoints
from flowgraph.blocks.scoring.settings import Positive, named
from flowgraph.blocks.scoring.start import Started
from flowgraph.blocks.scoring.tuning import given, with_imu
from flowgraph.blocks.signals import CameraMotion, Gaussian, Imu
from flowgraph.blocks.unscented.filters import predict_unscented
from flowgraph.blocks.unscented.sigma_points import SigmaPoints
from flowgraph.blocks.vision.camera import Mount
from flowgraph.graphs.euler_loop import euler_loop

FAR = (far_points(12), far_points(6))
"""Of the state and the IMU's noises, and of the state and those of the camera's velocity."""

_REPORTS = EulerKalman(order="zyx")


@graph
def ins_ukf_velocity(
    imu: Stream[Imu],
    motion: Stream[CameraMotion],
    *,
    start: Gaussian,
    noise: ImuNoise,
    mount: Mount,
    velocity_noise: float,
    rate_noise: float,
    rate: str = "gyro",
    order: str = "zyx",
    points: tuple[SigmaPoints, SigmaPoints] = FAR,
    gravity: tuple[float, float, float] = GRAVITY,
    reading: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
):
    """15-state unscented Kalman filter with Euler angles: IMU control, camera velocity.

    A `reading` of the IMU is of an "instant", or the "mean" over the time since the one before (`driving`).
    Collected: `belief` and `angles` at every tick, and the `innovation` at every camera velocity.
    """
    predict = lambda belief, drive: predict_unscented(
        belief, drive, move=carried(order, gravity), noise=np.diag(increment_variances(noise)), space=STATE,
        points=points[0], name="predict",
    )  # fmt: skip
    return euler_loop(
        imu, motion, start=start, order=order, reading=reading, gate=gate, patience=patience,
        adaptive=adaptive, held=held, gravity=gravity,
        predict=predict,
        update=lambda prior, control, scale: update_camera_velocity(
            prior, motion, control, scale, order=order, mount=mount, velocity_noise=velocity_noise,
            rate_noise=rate_noise, rate=rate, points=points[1], gate=gate, robust=robust, name="update",
        ),
    )  # fmt: skip


@on_flight(ins_ukf_velocity, "imu", "motion", told=with_imu)
def for_flight(
    on: OnFlight,
    *,
    rate: Annotated[str, named("source of the rate", RATES)] = "gyro",
    velocity_noise: Positive = 0.1,
    rate_noise: Positive | None = None,
    filter: EulerKalman = _REPORTS,
    sigma: FarPoints,
    started: Started,
) -> Case:
    """Start the filter at the truth's first pose, which nothing else would tell it, at rest.

    Args:
        flight: with the streams `imu` and `motion`, and the `mount` of the camera in its info. In place of
            `imu` it may have the thesis's unit: `gyro` and `coordinate_acceleration`, with the same times.
        rate: gyro (the report's eq. 10) or camera (eq. 9).
        velocity_noise: standard deviation of the camera's velocity, m/s.
        rate_noise: of the rate, rad/s; 0.02 for the gyroscope and 0.2 for the camera if left out.
        start: must be said where there is neither a truth nor a measured attitude; the position is then the
            origin, and the first force levels the body.

    Raises:
        DataError: where the flight lacks a stream, or does not tell where to start.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    seen, imu = on.flight.streams.get("vicon"), on.inputs["imu"]
    begin = started.pose(on, on.inputs, position=seen, attitude=seen)
    if started == Started() and begin.unknown:
        truth = on.flight.truth
        raise DataError(
            "this flight does not tell where ins_ukf_velocity starts",
            path=on.flight.name,
            expected="a truth of position and attitude",
            got="none" if truth is None else ", ".join(truth.leaves),
            fix="write --set start=unknown_yaw, or build the graph with a start of your own",
        )
    turn, tilt = begin.attitude, 0.01
    if not begin.tilted:
        tilt = 0.1
        if not on.weightless:
            force = on.first_up("imu", imu["specific_force"][imu.time >= begin.time])
            turn = np.asarray(level(turn, force, xp=np))
    first = start_gaussian(begin.position, turn, order=filter.order, deviations=(0.01, tilt, 0.3, 0.02, 0.05))
    return filter.case(
        on,
        with_heading(first, begin.heading),
        inputs=begin.inputs,
        mount=on.flight.info["mount"],
        velocity_noise=velocity_noise,
        rate_noise=given(rate_noise, {"gyro": 0.02, "camera": 0.2}[rate]),
        rate=rate,
        points=(sigma.points(12), sigma.points(6)),
    )
