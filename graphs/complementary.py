"""The complementary filter: attitude from a gyroscope, high-passed, and an accelerometer, low-passed.

With Q the attitude by the gyroscope alone, and u = R(Q) f the specific force as Q carries it to the world:
where the body does not accelerate, u would point up if Q were right. What is slow in u is Q's drift, what is
fast is noise and acceleration of the body:

    Q_k = Q_(k-1) * Exp(w dt)     s_k = low_pass(R(Q_k) f_k)     q_k = [shortest arc from s_k to +z] * Q_k

The arc takes out of Q what the low pass lets through, so q = high_pass(Q) + low_pass(accelerometer) on the
rotations: on one axis, y_k = a (y_(k-1) + w dt) + (1 - a) z_k. The filtering is done in the world, where
drift is slow however fast the body turns. Gravity shows no heading: it stays that of the gyroscope.

It fails on a flying quadrotor, whose specific force is its thrust, always along body z: the accelerometer
says "level" whatever the attitude. See `orientation_complementary`.

Source: R. Mahony, T. Hamel, J.-M. Pflimlin, "Nonlinear complementary filters on the special orthogonal
group", IEEE Trans. Automatic Control 53(5), 2008, sec. II (one axis) and III (rotations); R. Fiszel, thesis
(2017), section on the complementary filter.
"""

from __future__ import annotations

from flowgraph import Case, Stream, collect, delay, graph, high_pass, latest, low_pass
from flowgraph.blocks.kalman.lost import stay
from flowgraph.blocks.metrics.errors import attitude_errors
from flowgraph.blocks.orientation.complementary import carry_to_world, level_near, turn_by_gyro
from flowgraph.blocks.orientation.fixed_gain import AttitudeNoise, attitude_spread
from flowgraph.blocks.scoring.cases import OnFlight, Scored, on_flight
from flowgraph.blocks.scoring.orientation import Share
from flowgraph.blocks.scoring.settings import NotNegative
from flowgraph.blocks.scoring.start import Started
from flowgraph.blocks.scoring.streams import own_density, reading_deviation, with_parts
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.blocks.signals import Attitude, Gyro, SpecificForce, WorldForce


@graph
def complementary(
    gyro: Stream[Gyro],
    accelerometer: Stream[SpecificForce],
    *,
    start: Attitude,
    alpha: float = 0.98,
    reading: str = "instant",
    covariance: AttitudeNoise | None = None,
    longest: float | None = None,
):
    """Complementary filter of attitude: gyroscope high-passed, accelerometer low-passed.

    `alpha` is the gyroscope's share at each reading of the accelerometer; 1 is the gyroscope alone. Its time
    constant is period * alpha / (1 - alpha): 0.245 s for 0.98 at 200 Hz. `reading` of the gyroscope as in
    `turn_by_gyro`.

    Collected: at each reading of the gyroscope `attitude`, and for comparison `gyroscope` and
    `accelerometer`, the attitudes by one of them alone; at each reading of the accelerometer `rejected`, what
    the filter took for noise in it. With the noise of a `covariance`, `belief` at each reading of either: the
    attitude, and the covariance that a body which does not accelerate has.
    """
    at_rest = WorldForce.at_rest()
    previous = delay(start, name="turned")
    turned = turn_by_gyro(previous, gyro, reading=reading, name="gyroscope")
    if longest is not None:
        turned = stay(previous, turned, longest=longest)
    previous.feed(turned)

    force = carry_to_world(latest(turned, init=start, name="by_gyro"), accelerometer, name="carried")
    collect(high_pass(force, alpha=alpha, init=at_rest), "rejected")
    last = latest(force, init=at_rest, name="last_force")
    collect(level_near(turned, last, name="by_force"), "accelerometer")

    attitude = turned
    if alpha < 1.0:
        steady = low_pass(force, alpha=1.0 - alpha, init=at_rest)
        attitude = level_near(turned, latest(steady, init=at_rest, name="steady"), name="attitude")
    if covariance is not None:
        now = latest(attitude, init=start, at=gyro | accelerometer, name="held")
        collect(attitude_spread(now, accelerometer, alpha=alpha, noise=covariance), "belief")
    return {"attitude": attitude, "gyroscope": turned}


_UNSMOOTHED = (
    "its gains are set by hand, so nothing says how much of a later correction belongs to an earlier time"
)


@on_flight(
    complementary,
    "gyro",
    "accelerometer",
    told=with_parts,
    measured=None,
    fix="choose a flight with an imu",
    unsmoothed=_UNSMOOTHED,
)
def for_flight(
    on: OnFlight,
    *,
    alpha: Share = 0.98,
    covariance: bool = False,
    gyro_noise: NotNegative | None = None,
    accelerometer_noise: NotNegative | None = None,
    scored: Scored,
    started: Started,
) -> Case:
    """Start the filter on a flight with a gyroscope and an accelerometer, at the truth's first attitude.

    Args:
        flight: with the streams `gyro` (Gyro) and `accelerometer` (SpecificForce), or `imu`, which holds
            both.
        alpha: the gyroscope's share, in (0, 1].
        covariance: whether to give one too, and score it.
        gyro_noise, accelerometer_noise: densities in rad/s/sqrt(Hz) and m/s^2/sqrt(Hz), for the covariance;
            the flight's own if left out.
    """
    flight, push, noise = on.flight, on.inputs["accelerometer"], None
    attitude, begin = started.levelled(on, "accelerometer", push["force"], deviates=covariance)
    if covariance:
        force = reading_deviation(flight, "accelerometer", push, accelerometer_noise)
        start = 1e-3 if begin.told else 0.3
        noise = AttitudeNoise(own_density(flight, "gyro", gyro_noise), (force,) * 3, start, begin.heading)
    return on.case(
        scored.score(on, attitude_errors, estimate="belief" if covariance else "attitude"),
        inputs=begin.inputs,
        start=Attitude(attitude=attitude),
        alpha=alpha,
        reading=reading_of(flight, "gyro"),
        covariance=noise,
        longest=on.longest(),
    )
