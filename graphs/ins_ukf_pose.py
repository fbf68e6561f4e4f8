"""The unscented Kalman filter of a pose: IMU as control, camera (or motion capture) as measurement.

    x = (p, e, v, b_g, b_a)      e: Euler angles, Z-X-Y as in the course or Z-Y-X as in the report

Every tick predicts to now, through sigma points that are augmented with the IMU's noises; a tick with a pose
also corrects. The pose, found by PnP on the host (`tag_pose`), is a source.

Sources: the report's first filter, and the course's nonlinear Kalman filter. Equations:
`blocks/models/euler_ins.py` and `blocks/unscented/filters.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Case, Stream, graph
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.lost import PATIENCE, Held
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.models.euler_ins import STATE, increment_variances, update_pose_angles
from flowgraph.blocks.models.unscented_ins import carried, far_points
from flowgraph.blocks.scoring.cases import OnFlight, on_flight
from flowgraph.blocks.scoring.euler import EulerFilter, FarPoints, on_measured_pose
from flowgraph.blocks.scoring.tuning import with_imu
from flowgraph.blocks.signals import Gaussian, Imu, PoseMeasurement
from flowgraph.blocks.unscented.filters import predict_unscented, unscented_crossing
from flowgraph.blocks.unscented.sigma_points import SigmaPoints
from flowgraph.graphs.euler_loop import euler_loop
from flowgraph.graphs.tag_pose import poses_of

FAR = far_points(12)
"""Of the state and the IMU's twelve noises."""


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
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    points: SigmaPoints = FAR,
    gravity: tuple[float, float, float] = GRAVITY,
    reading: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
    smoothing: bool = False,
):
    """15-state unscented Kalman filter with Euler angles: IMU control, camera pose.

    A `reading` of the IMU is of an "instant", or the "mean" over the time since the one before (`driving`).
    Collected: `belief` and `angles` at every tick, and the `innovation` at every pose; with `smoothing` what
    a smoother needs too.
    """
    moving: dict[str, Any] = {"move": carried(order, gravity), "noise": np.diag(increment_variances(noise))}
    moving |= {"space": STATE, "points": points}
    return euler_loop(
        imu, pose, start=start, order=order, reading=reading, gate=gate, patience=patience, adaptive=adaptive,
        held=held,
        gravity=gravity, crossing=unscented_crossing(**moving) if smoothing else None,
        predict=lambda belief, drive: predict_unscented(belief, drive, name="predict", **moving),
        update=lambda prior, _, scale: update_pose_angles(
            prior, pose, scale, order=order, R=R, factor=factor, lever=lever, gate=gate, robust=robust,
            name="update",
        ),
    )  # fmt: skip


@on_flight(ins_ukf_pose, "imu", told=with_imu)
def for_flight(on: OnFlight, *, filter: EulerFilter, sigma: FarPoints) -> Case:
    """Start the filter at the first measured pose of a flight, at rest and without biases.

    Args:
        flight: with the stream `imu`, and one of `pose`, `tags` (of which PnP makes poses first) and
            `vicon`.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    poses = poses_of(on.name, on.flight, tags=filter.tags)
    return on_measured_pose(on, filter, poses, points=sigma.points(12), smoothing=filter.smoothed)
