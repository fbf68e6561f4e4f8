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

import math
from typing import Annotated

import numpy as np

from flowgraph import Case, DataError, Flight, Stream, collect, delay, graph, latest
from flowgraph.blocks.inertial.alignment import level_attitude
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.kalman.lost import stay
from flowgraph.blocks.metrics.errors import attitude_errors
from flowgraph.blocks.orientation.complementary import (
    blend,
    carry_to_world,
    level_near,
    remove_thrust,
    turn_by_gyro,
)
from flowgraph.blocks.orientation.fixed_gain import AttitudeNoise, attitude_spread
from flowgraph.blocks.scoring.cases import OnFlight, Scored, on_flight
from flowgraph.blocks.scoring.orientation import Share
from flowgraph.blocks.scoring.settings import NotNegative, one_of
from flowgraph.blocks.scoring.start import Started
from flowgraph.blocks.scoring.streams import own_density, reading_deviation, with_parts
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.blocks.signals import Attitude, CoordinateAcceleration, Gyro, Thrust

_STILL = Gyro(rate=np.zeros(3))
_HOVER = Thrust(thrust=np.float64(-GRAVITY[2]))

MOST_ACROSS = 0.5
"""m/s^2: more specific force across body z than this is not thrust."""


@graph
def orientation_complementary(
    gyro: Stream[Gyro],
    coordinate_acceleration: Stream[CoordinateAcceleration],
    thrust: Stream[Thrust],
    *,
    start: Attitude,
    alpha: float = 0.98,
    heading: str = "shortest_arc",
    reading: str = "instant",
    covariance: AttitudeNoise | None = None,
    longest: float | None = None,
):
    """Complementary filter of a quadrotor's attitude: thrust is removed, and gravity remains.

    `alpha` is the gyroscope's share at each acceleration; 1 is the gyroscope alone. `heading` is
    "shortest_arc" or "gyroscope"; `reading` of the gyroscope as in `turn_by_gyro`. The last thrust is held;
    before the first, the vehicle hovers. Collected: `attitude` at every tick of gyroscope or acceleration,
    and `seen`, by gravity alone, at every acceleration. With the noise of a `covariance`, `belief` with every
    `attitude`.
    """
    previous = delay(start, name="previous")
    rate = latest(gyro, init=_STILL, name="rate")
    ticks = gyro | coordinate_acceleration
    turned = turn_by_gyro(previous, rate, reading=reading, at=ticks, name="gyroscope")
    if longest is not None:
        turned = stay(previous, turned, longest=longest)
    up = remove_thrust(coordinate_acceleration, latest(thrust, init=_HOVER, name="last_thrust"))
    if heading == "shortest_arc":
        seen = level_attitude(up, name="seen")
    else:
        now = latest(turned, at=coordinate_acceleration)
        seen = level_near(now, carry_to_world(now, up, name="carried"), name="seen")
    attitude = blend(turned, seen, alpha=alpha, name="attitude")
    previous.feed(attitude)
    if covariance is not None:
        collect(attitude_spread(attitude, up, alpha=alpha, noise=covariance, heading=heading), "belief")
    return {"attitude": attitude, "seen": seen}


_STREAMS = ("gyro", "coordinate_acceleration", "thrust")
_FIX = f"simulated, with the sensors: --data sim:thesis --set sensors={','.join(_STREAMS)}"


_UNSMOOTHED = (
    "its gains are set by hand, so nothing says how much of a later correction belongs to an earlier time"
)


@on_flight(
    orientation_complementary, *_STREAMS, told=with_parts, measured=None, fix=_FIX, unsmoothed=_UNSMOOTHED
)
def for_flight(
    on: OnFlight,
    *,
    alpha: Share = 0.98,
    heading: Annotated[str, one_of("shortest_arc", "gyroscope")] = "shortest_arc",
    covariance: bool = False,
    gyro_noise: NotNegative | None = None,
    acceleration_noise: NotNegative | None = None,
    thrust_noise: NotNegative | None = None,
    scored: Scored,
    started: Started,
) -> Case:
    """Start the filter on a flight with thrust and coordinate acceleration, at the truth's first attitude.

    `sim:thesis` with sensors=gyro,coordinate_acceleration,thrust is such a flight.

    Args:
        flight: with the streams `coordinate_acceleration` (CoordinateAcceleration), `thrust` (Thrust) and
            `gyro` (Gyro) or `imu`.
        alpha: the gyroscope's share, in (0, 1].
        heading: "shortest_arc" (the vehicle has no heading of its own) or "gyroscope" (it has, and drifts).
        covariance: whether to give one too, and score it.
        gyro_noise, acceleration_noise: densities in rad/s/sqrt(Hz) and m/s^2/sqrt(Hz), for the covariance;
            the flight's own if left out.
        thrust_noise: m/s^2, the standard deviation of a thrust, which should be as frequent as the
            acceleration: one that is held errs alike from one reading to the next.

    Raises:
        DataError: where a stream is missing, or the vehicle is not carried by its thrust.
    """
    flight, noise = on.flight, None
    acceleration, thrust = on.inputs["coordinate_acceleration"], on.inputs["thrust"]
    need_carried(flight)
    lift = thrust["thrust"]
    up = np.array([0.0, 0.0, lift[int(np.argmax(np.isfinite(lift)))]]) - acceleration["acceleration"]
    attitude, begin = started.levelled(on, "coordinate_acceleration", up, deviates=covariance)
    if covariance:
        push = reading_deviation(flight, "coordinate_acceleration", acceleration, acceleration_noise)
        own = flight.info.get("noise", {}).get("thrust", {}).get("noise")
        spread = on.noise("thrust_noise", thrust_noise, own)
        rate = own_density(flight, "gyro", gyro_noise)
        start = 1e-3 if begin.told else 0.3
        noise = AttitudeNoise(rate, (push, push, math.hypot(push, spread)), start, begin.heading)
    return on.case(
        scored.score(on, attitude_errors, estimate="belief" if covariance else "attitude"),
        inputs=begin.inputs,
        start=Attitude(attitude=attitude),
        alpha=alpha,
        heading=heading,
        reading=reading_of(flight, "gyro"),
        covariance=noise,
        longest=on.longest(),
    )


def need_carried(flight: Flight) -> None:
    """Refuse a flight of which the thrust is not all that carries the vehicle."""
    if flight.info.get("across", 0.0) > MOST_ACROSS:
        raise DataError(
            "thrust is not all that carries this vehicle",
            path=flight.name,
            expected=f"no specific force across body z (root mean square below {MOST_ACROSS:g} m/s^2)",
            got=f"{flight.info['across']:.2g} m/s^2: the body is held, and its thrust shows no vertical",
            fix="choose a flying world, --data sim:thesis or sim:hover, or the graph complementary",
        )
