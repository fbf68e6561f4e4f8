"""The Kalman filter in its textbook form: one record a tick, with the control and what was measured with it.

State: position and velocity, in the world. Control: the coordinate acceleration in the world, so the attitude
must be known. A record holds a position too; a coordinate that was not measured with this control is NaN, and
then the filter corrects with the others, or only predicts.

    predict   x-_k = F x_(k-1) + G u_k                  P-_k = F P_(k-1) F^T + Q
    correct   x_k = x-_k + K (z_k - H x-_k)             P_k = (I - K H) P-_k (I - K H)^T + K R K^T

Source: R. Fiszel, thesis (2017), section on the Kalman filter, after R. Kalman, "A new approach to linear
filtering and prediction problems", 1960. Three slips of the thesis are mended: the covariance is corrected
with a minus sign (its P- + K S K^T would grow), the prediction starts from the last posterior (it prints S-
for S), and the control matrix holds dt. Where the positions have a clock of their own, see `async_kalman`.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph, latest
from flowgraph.blocks.kalman.filters import predict_linear, update_linear
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.models.point import between, point_belief, point_model, whole
from flowgraph.blocks.scoring.cases import OnFlight, on_flight
from flowgraph.blocks.scoring.point import PointFilter, on_point, readings
from flowgraph.blocks.scoring.tuning import with_imu
from flowgraph.blocks.signals import Gaussian, PointReading, WorldAcceleration


@graph
def kalman(
    reading: Stream[PointReading],
    *,
    start: Gaussian,
    noise: float,
    position_noise: float,
    control: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
):
    """Kalman filter of position and velocity: a record holds an acceleration and what was measured with it.

    A `control` is of an "instant", and a step is driven by the mean of the two at its ends; or it is the
    "mean" over the time since the one before, and drives that step alone.

    Collected: `belief`, `prior` and `posterior` at every tick, and the `innovation` where a coordinate was
    measured.
    """
    belief = delay(start, name="belief")
    last = delay(WorldAcceleration.at_rest(), name="last_control")
    fresh = now = reading.map(lambda r: WorldAcceleration(acceleration=r.acceleration))
    if held is not None:  # a record without a control holds NaN in its place
        fresh = whole(now, name="fresh")
        now = latest(fresh, init=WorldAcceleration.at_rest(), at=reading, name="control")
    mean = (now if control == "mean" else between(last, now)).map(lambda u: u.acceleration)
    prior = predict_linear(belief, mean, model=point_model(noise))
    prior = bridged(belief, prior, fresh, held=held, position=0, velocity=3)
    scale = scale_of(adaptive, "position")
    posterior, innovation = update_linear(
        prior,
        reading.map(lambda r: r.position),
        H=np.eye(3, 6),
        R=np.eye(3) * position_noise**2,
        gate=gate,
        robust=robust,
        scale=scale,
    )
    feed_scale(scale, innovation, adaptive, "position")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=6)
    belief.feed(posterior)
    last.feed(now)
    collect(innovation, "innovation")
    return {"belief": point_belief(posterior), "prior": prior, "posterior": posterior}


@on_flight(kalman, "imu", "vicon", told=with_imu)
def for_flight(on: OnFlight, *, filter: PointFilter) -> Case:
    """Start the filter on a flight with an IMU, a motion capture and a truth, which tells it the attitude.

    The positions must come at times of the IMU. Told the exact attitude and bias, the filter is the bound
    that no filter on these data can beat.

    Args:
        flight: with the streams `imu` and `vicon` (Pose).
    """
    return on_point(on, filter, {"reading": readings(on.flight)})
