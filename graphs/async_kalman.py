"""The asynchronous Kalman filter: controls and measurements each come when they come.

State: position and velocity, in the world. Every tick predicts to now, with the last control; each
measurement that is present then corrects the part of the state that it sees, one after the other.

    predict   x-_k = F(dt) x_(k-1) + G(dt) u_last       P-_k = F P_(k-1) F^T + Q(dt)
    correct   with H = [I 0] for a position, H = [0 I] for a velocity: from the prediction x-_k

Source: R. Fiszel, thesis (2017), section on the asynchronous Kalman filter. Mended: a partial correction
starts from the prediction (the thesis prints x_(t-1)), with a minus sign in that of the covariance, and G
holds dt.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph, latest
from flowgraph.blocks.kalman.filters import predict_linear, update_linear
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.models.point import between, point_belief, point_model
from flowgraph.blocks.scoring.cases import OnFlight, on_flight
from flowgraph.blocks.scoring.point import PointFilter, on_point, positions
from flowgraph.blocks.scoring.streams import told_acceleration
from flowgraph.blocks.scoring.tuning import with_imu
from flowgraph.blocks.signals import Gaussian, Position, Velocity, WorldAcceleration


@graph
def async_kalman(
    acceleration: Stream[WorldAcceleration],
    position: Stream[Position],
    velocity: Stream[Velocity] | None = None,
    *,
    start: Gaussian,
    noise: float,
    position_noise: float,
    velocity_noise: float = 0.1,
    control: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
):
    """Kalman filter of position and velocity whose control and measurements keep clocks of their own.

    `control` as in `kalman`: of an "instant", or the "mean" since the one before.

    Collected: `belief`, `prior` and `posterior` at every tick, and the innovation of each measurement.
    """
    ticks = acceleration | position if velocity is None else acceleration | position | velocity
    belief = delay(start, name="belief")
    last = delay(WorldAcceleration.at_rest(), name="last_control")
    now = latest(acceleration, init=WorldAcceleration.at_rest(), at=ticks, name="control")
    mean = (now if control == "mean" else between(last, now)).map(lambda u: u.acceleration)
    prior = predict_linear(belief, mean, model=point_model(noise))
    prior = bridged(belief, prior, acceleration, held=held, position=0, velocity=3)
    scale = scale_of(adaptive, "position")
    posterior, innovation = update_linear(
        prior,
        position.map(lambda z: z.position),
        H=np.eye(3, 6),
        R=np.eye(3) * position_noise**2,
        gate=gate,
        robust=robust,
        scale=scale,
    )
    collect(innovation, "position_innovation")
    feed_scale(scale, innovation, adaptive, "position")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=6)
    if velocity is not None:
        scale = scale_of(adaptive, "velocity")
        posterior, innovation = update_linear(
            posterior, velocity.map(lambda z: z.velocity),
            H=np.eye(3, 6, 3), R=np.eye(3) * velocity_noise**2, gate=gate, robust=robust,
            scale=scale,
        )  # fmt: skip
        feed_scale(scale, innovation, adaptive, "velocity")
        collect(innovation, "velocity_innovation")
        if gate is not None:
            posterior = find_back(
                posterior, innovation, patience=patience, moving=6, name="find_back_velocity"
            )
    belief.feed(posterior)
    last.feed(now)
    return {"belief": point_belief(posterior), "prior": prior, "posterior": posterior}


@on_flight(async_kalman, "imu", "vicon", told=with_imu)
def for_flight(on: OnFlight, *, filter: PointFilter) -> Case:
    """Start the filter on a flight with an IMU, a motion capture and a truth, which tells it the attitude.

    Args:
        flight: with the streams `imu` and `vicon` (Pose), at any times.
    """
    inputs = {"position": positions(on.inputs["vicon"]), "acceleration": told_acceleration(on.flight)}
    return on_point(on, filter, inputs)
