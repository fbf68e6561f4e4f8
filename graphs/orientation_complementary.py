"""The orientation complementary filter: thrust is taken off first, and what remains is gravity.

The accelerometer of a flying quadrotor shows its thrust, not the vertical. But the thrust is known: it is
commanded. With R^T a the coordinate acceleration in the body and T the thrust per mass,

    T e_z - R^T a = -R^T g              points up, in body coordinates, however the body accelerates

and the attitude which that shows corrects what the gyroscope predicts:

    q-_k = q_(k-1) * Exp(w dt)          q_k = q-_k * Exp((1 - alpha) Log(q-_k^-1 s_k))

The attitude seen, s, is the *shortest arc* that takes that direction up, as in the thesis, whose vehicles fly
without a heading of their own: so the heading is corrected too. For a vehicle that turns about its vertical
this is wrong; with heading="gyroscope", s is the attitude nearest to q- that takes the direction up, and the
heading drifts.

Source: R. Fiszel, thesis (2017), section on the complementary filter and figures 9 and 10 (in scala-flow:
OrientationComplementaryFilter, whose weighted sum of quaternions is a step on the shortest way here); R.
Mahony, T. Hamel, J.-M. Pflimlin, "Nonlinear complementary filters on the special orthogonal group", IEEE
Trans. Automatic Control 53(5), 2008, sec. III.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import (
    Case,
    DeclarationError,
    Flight,
    Result,
    Stream,
    delay,
    graph,
    latest,
    timing_of,
)  # fmt: skip
from flowgraph.blocks.alignment import level_attitude
from flowgraph.blocks.complementary import (
    attitude_errors,
    blend,
    carry_to_world,
    check_alpha,
    first_attitude,
    inertial_streams,
    level_near,
    needed,
    remove_thrust,
    turn_by_gyro,
)
from flowgraph.blocks.inertial import GRAVITY
from flowgraph.blocks.signals import Attitude, CoordinateAcceleration, Gyro, Thrust

_STILL = Gyro(rate=np.zeros(3))
_HOVER = Thrust(thrust=np.float64(-GRAVITY[2]))


@graph
def orientation_complementary(
    gyro: Stream[Gyro],
    coordinate_acceleration: Stream[CoordinateAcceleration],
    thrust: Stream[Thrust],
    *,
    start: Attitude,
    alpha: float = 0.98,
    heading: str = "shortest_arc",
):
    """Complementary filter of a quadrotor's attitude: thrust is removed, and gravity remains.

    `alpha` is the gyroscope's share at each acceleration; 1 is the gyroscope alone. `heading` is
    "shortest_arc" or "gyroscope". The last thrust is held; before the first, the vehicle hovers. Collected:
    `attitude` at every tick of gyroscope or acceleration, and `seen`, by gravity alone, at every
    acceleration.
    """
    previous = delay(start, name="previous")
    rate = latest(gyro, init=_STILL, name="rate")
    turned = turn_by_gyro(previous, rate, at=gyro | coordinate_acceleration, name="gyroscope")
    up = remove_thrust(coordinate_acceleration, latest(thrust, init=_HOVER, name="last_thrust"))
    if heading == "shortest_arc":
        seen = level_attitude(up, name="seen")
    else:
        now = latest(turned, at=coordinate_acceleration)
        seen = level_near(now, carry_to_world(now, up, name="carried"), name="seen")
    attitude = blend(turned, seen, alpha=alpha, name="attitude")
    previous.feed(attitude)
    return {"attitude": attitude, "seen": seen}


@orientation_complementary.on_flight
def for_flight(
    flight: Flight, *, alpha: float = 0.98, heading: str = "shortest_arc", settle: float = 1.0
) -> Case:
    """Start the filter on a flight with thrust and coordinate acceleration, at the truth's first attitude.

    `sim:thesis` with sensors=gyro,coordinate_acceleration,thrust is such a flight.

    Args:
        flight: with the streams `coordinate_acceleration` (CoordinateAcceleration), `thrust` (Thrust) and
            `gyro` (Gyro) or `imu`.
        alpha: the gyroscope's share, in (0, 1].
        heading: "shortest_arc" (the vehicle has no heading of its own) or "gyroscope" (it has, and drifts).
        settle: seconds at the start that the errors leave out.
    """
    check_alpha("orientation_complementary", alpha)
    if heading not in ("shortest_arc", "gyroscope"):
        raise DeclarationError(
            "this rule for the heading does not exist",
            path="orientation_complementary",
            expected='"shortest_arc" or "gyroscope"',
            got=repr(heading),
            fix="write heading=gyroscope",
        )
    streams = inertial_streams(flight)
    names = ("gyro", "coordinate_acceleration", "thrust")
    inputs = needed("orientation_complementary", flight, streams, *names)
    clocks: dict[str, Any] = {name: timing_of(series) for name, series in inputs.items()}
    up = np.array([0.0, 0.0, inputs["thrust"]["thrust"][0]])
    start = first_attitude(flight, inputs["gyro"], up - inputs["coordinate_acceleration"]["acceleration"][0])
    built = orientation_complementary.build(**clocks, start=start, alpha=alpha, heading=heading)
    truth = flight.truth

    def score(result: Result) -> dict[str, float]:
        return {} if truth is None else attitude_errors(result["attitude"], truth, settle=settle)

    return Case(built, inputs, score, estimate="attitude")
