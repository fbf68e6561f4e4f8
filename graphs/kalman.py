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

from functools import partial

import numpy as np

from flowgraph import (
    Case,
    DataError,
    Flight,
    Series,
    Stream,
    arrays,
    clocks_of,
    collect,
    delay,
    graph,
)  # fmt: skip
from flowgraph.blocks.kalman.filters import predict_linear, update_linear
from flowgraph.blocks.metrics.consistency import point_errors
from flowgraph.blocks.models.point import between, point_belief, point_model, point_steps, start_point
from flowgraph.blocks.scoring.scorer import scorer
from flowgraph.blocks.scoring.streams import told_acceleration
from flowgraph.blocks.scoring.tuning import check_settings, given, imu_noise_of, noise_of, reading_of
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
):
    """Kalman filter of position and velocity: a record holds an acceleration and what was measured with it.

    A `control` is of an "instant", and a step is driven by the mean of the two at its ends; or it is the
    "mean" over the time since the one before, and drives that step alone.

    Collected: `belief`, `prior` and `posterior` at every tick, and the `innovation` where a coordinate was
    measured.
    """
    belief = delay(start, name="belief")
    last = delay(WorldAcceleration.at_rest(), name="last_control")
    now = reading.map(lambda r: WorldAcceleration(acceleration=r.acceleration))
    mean = (now if control == "mean" else between(last, now)).map(lambda u: u.acceleration)
    prior = predict_linear(belief, mean, model=point_model(noise))
    posterior, innovation = update_linear(
        prior, reading.map(lambda r: r.position), H=np.eye(3, 6), R=np.eye(3) * position_noise**2, gate=gate
    )
    belief.feed(posterior)
    last.feed(now)
    collect(innovation, "innovation")
    return {"belief": point_belief(posterior), "prior": prior, "posterior": posterior}


@kalman.on_flight
def for_flight(
    flight: Flight,
    *,
    position_noise: float | None = None,
    accelerometer_noise: float | None = None,
    gate: float | None = None,
    smooth: str = "none",
    lag: float | None = None,
    settle: float = 1.0,
) -> Case:
    """Start the filter on a flight with an IMU, a motion capture and a truth, which tells it the attitude.

    The positions must come at times of the IMU. Told the exact attitude and bias, the filter is the bound
    that no filter on these data can beat.

    Args:
        flight: with the streams `imu` and `vicon` (Pose).
        position_noise: standard deviation, m; the flight's own if left out.
        accelerometer_noise: density, m/s^2/sqrt(Hz); the flight's own if left out.
        gate: below 1 the probability with which an honest measurement passes, from 1 on the largest NIS.
        smooth: "rts" also scores the smoothed run.
        lag: s; also scores the run smoothed with a fixed lag.
        settle: seconds at the start that the errors leave out.
    """
    own = {"position_noise": position_noise, "accelerometer_noise": accelerometer_noise}
    check_settings("kalman", {**own, "gate": gate}, settle=settle, smooth=smooth, lag=lag)
    reading = readings(flight)
    density = given(accelerometer_noise, imu_noise_of("kalman", flight).accelerometer)
    built = kalman.build(
        **clocks_of({"reading": reading}),
        start=start_point(flight.streams["vicon"]["position"][0]),
        noise=density,
        position_noise=noise_of("kalman", flight, "position_noise", position_noise),
        control=reading_of(flight),
        gate=gate,
    )
    steps = partial(point_steps, model=point_model(density))
    score = scorer(flight, point_errors, settle=settle, steps=steps, smooth=smooth, lag=lag)
    return Case(built, {"reading": reading}, score)


def readings(flight: Flight) -> Series:
    """The flight's accelerations, each with the position of its time, NaN where there was none.

    Raises:
        DataError: without an IMU, motion capture or truth, or where a position comes between two IMU
            readings.
    """
    vicon = flight.need("kalman", "imu", "vicon")["vicon"]
    control = told_acceleration(flight)
    if not np.isin(vicon.time, control.time).all():
        raise DataError(
            "the positions do not come with the controls",
            path=flight.name,
            expected="a stream vicon, at times of the stream imu",
            got="positions between two readings of the imu",
            fix="use async_kalman, which takes each when it comes",
        )
    position = np.full((len(control), 3), np.nan)
    position[np.searchsorted(control.time, vicon.time)] = vicon["position"]
    values = PointReading(acceleration=control["acceleration"], position=position)
    return arrays(control.time, values, not_finite="keep", name="reading")
