"""Attitude from the gyroscope alone: the baseline that follows every turn, and drifts.

    q_k = q_(k-1) * Exp((w_(k-1) + w_k) dt / 2)

It starts level, with the heading of the truth, and knows of no bias.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, sec. 4.6
(midpoint method).
"""

from __future__ import annotations

from flowgraph import Case, Flight, Result, Stream, clocks_of, delay, graph
from flowgraph.blocks.inertial.alignment import orientation_start
from flowgraph.blocks.metrics.errors import orientation_errors
from flowgraph.blocks.orientation.complementary import turn_by_gyro
from flowgraph.blocks.signals import Attitude, Gyro, Imu
from flowgraph.language.checks import need_numbers


@graph
def gyro_integration(imu: Stream[Imu], *, start: Attitude):
    """Integral of the gyroscope's rate from a given attitude.

    Collected: `attitude` at every reading.
    """
    previous = delay(start, name="previous")
    rate = imu.map(lambda reading: Gyro(rate=reading.gyro), name="gyro")
    attitude = turn_by_gyro(previous, rate, name="attitude")
    previous.feed(attitude)
    return {"attitude": attitude}


@gyro_integration.on_flight
def for_flight(flight: Flight, *, still: float | None = None, settle: float = 1.0) -> Case:
    """Start it on a flight with an inertial unit, level, with the heading of the truth if it has one.

    Args:
        flight: with the stream `imu`.
        still: seconds at the start in which the body rests; told by the flight or its readings if left out.
        settle: seconds at the start that the errors leave out.
    """
    need_numbers("gyro_integration", not_negative={"still": still, "settle": settle})
    inputs = flight.need("gyro_integration", "imu")
    start = Attitude(attitude=orientation_start(flight, inputs["imu"], still).attitude)
    truth = flight.truth

    def score(result: Result) -> dict[str, float]:
        return {} if truth is None else orientation_errors(result["attitude"], truth, settle=settle)

    return Case(gyro_integration.build(**clocks_of(inputs), start=start), inputs, score, "attitude")
