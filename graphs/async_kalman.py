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

from typing import Any

import numpy as np

from flowgraph import (
    Case,
    DataError,
    Flight,
    Result,
    Series,
    Stream,
    collect,
    delay,
    graph,
    latest,
    timing_of,
)  # fmt: skip
from flowgraph.blocks.consistency import point_errors
from flowgraph.blocks.kalman import Gaussian, predict_linear, update_linear
from flowgraph.blocks.point import (
    WorldAcceleration,
    between,
    point_belief,
    point_model,
    start_point,
    told_acceleration,
)  # fmt: skip
from flowgraph.blocks.signals import Position, Velocity
from flowgraph.checks import need_numbers

_AT_REST = WorldAcceleration(acceleration=np.zeros(3))


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
    gate: float | None = None,
):
    """Kalman filter of position and velocity whose control and measurements keep clocks of their own.

    Collected: `belief`, `prior` and `posterior` at every tick, and the innovation of each measurement.
    """
    ticks = acceleration | position if velocity is None else acceleration | position | velocity
    belief = delay(start, name="belief")
    last = delay(_AT_REST, name="last_control")
    control = latest(acceleration, init=_AT_REST, at=ticks, name="control")
    mean = between(last, control).map(lambda u: u.acceleration)
    prior = predict_linear(belief, mean, model=point_model(noise))
    posterior, innovation = update_linear(
        prior, position.map(lambda z: z.position), H=np.eye(3, 6), R=np.eye(3) * position_noise**2, gate=gate
    )
    collect(innovation, "position_innovation")
    if velocity is not None:
        posterior, innovation = update_linear(
            posterior, velocity.map(lambda z: z.velocity),
            H=np.eye(3, 6, 3), R=np.eye(3) * velocity_noise**2, gate=gate,
        )  # fmt: skip
        collect(innovation, "velocity_innovation")
    belief.feed(posterior)
    last.feed(control)
    return {"belief": point_belief(posterior), "prior": prior, "posterior": posterior}


@async_kalman.on_flight
def for_flight(
    flight: Flight,
    *,
    position_noise: float | None = None,
    accelerometer_noise: float | None = None,
    gate: float | None = None,
    settle: float = 1.0,
) -> Case:
    """Start the filter on a flight with an IMU, a motion capture and a truth, which tells it the attitude.

    Args:
        flight: with the streams `imu` and `vicon` (Pose), at any times.
        position_noise, accelerometer_noise, gate, settle: as for `kalman`.
    """
    need_numbers(
        "async_kalman",
        positive={
            "position_noise": position_noise,
            "accelerometer_noise": accelerometer_noise,
            "gate": gate,
        },
        not_negative={"settle": settle},
    )
    control = told_acceleration(flight)
    position = positions(flight)
    truth = flight.truth
    assert truth is not None  # as `told_acceleration` has checked
    inputs = {"acceleration": control, "position": position}
    clocks: dict[str, Any] = {name: timing_of(series) for name, series in inputs.items()}
    own = flight.info["imu_noise"].accelerometer
    built = async_kalman.build(
        **clocks,
        start=start_point(position["position"][0]),
        noise=own if accelerometer_noise is None else accelerometer_noise,
        position_noise=flight.info["position_noise"] if position_noise is None else position_noise,
        gate=gate,
    )

    def score(result: Result) -> dict[str, float]:
        return point_errors(result["belief"], truth, settle=settle)

    return Case(built, inputs, score)


def positions(flight: Flight) -> Series:
    """The positions of the flight's motion capture.

    Raises:
        DataError: without one.
    """
    vicon = flight.streams.get("vicon")
    if vicon is None:
        raise DataError(
            "this flight lacks what async_kalman needs",
            path=flight.name,
            expected="streams imu and vicon",
            got=", ".join(flight.streams),
            fix="choose another flight, or build async_kalman with your own sources",
        )
    return Series(vicon.time, Position(position=vicon["position"]), name="position")
