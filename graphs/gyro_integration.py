"""Attitude from the gyroscope alone: the baseline that follows every turn, and drifts.

    q_k = q_(k-1) * Exp((w_(k-1) + w_k) dt / 2)

It starts level, with the heading of the truth, and knows of no bias.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, sec. 4.6
(midpoint method).
"""

from __future__ import annotations

import numpy as np

from flowgraph import Case, Series, Stream, delay, graph
from flowgraph.blocks.kalman.lost import stay
from flowgraph.blocks.metrics.errors import orientation_errors
from flowgraph.blocks.orientation.complementary import turn_by_gyro
from flowgraph.blocks.scoring.cases import OnFlight, Scored, on_flight
from flowgraph.blocks.scoring.settings import NotNegative
from flowgraph.blocks.scoring.start import Started
from flowgraph.blocks.scoring.tuning import reading_of, with_imu
from flowgraph.blocks.signals import Attitude, Gyro, Imu


@graph
def gyro_integration(
    imu: Stream[Imu], *, start: Attitude, reading: str = "instant", longest: float | None = None
):
    """Integral of the gyroscope's rate from a given attitude; `reading` as in `turn_by_gyro`.

    Collected: `attitude` at every reading.
    """
    previous = delay(start, name="previous")
    rate = imu.map(lambda reading: Gyro(rate=reading.gyro), name="gyro")
    attitude = turn_by_gyro(previous, rate, reading=reading, name="attitude")
    if longest is not None:
        attitude = stay(previous, attitude, longest=longest)
    previous.feed(attitude)
    return {"attitude": attitude}


_UNSMOOTHED = "nothing corrects it, so the later readings say nothing of the earlier ones"


@on_flight(gyro_integration, "imu", told=with_imu, measured=None, unsmoothed=_UNSMOOTHED)
def for_flight(on: OnFlight, *, still: NotNegative | None = None, scored: Scored, started: Started) -> Case:
    """Start it on a flight with an inertial unit, level, with the heading of the truth if it has one.

    Args:
        flight: with the stream `imu`, or `gyro` and `coordinate_acceleration`, which do not level it.
        still: seconds at the start in which the body rests; told by the flight or its readings if left out.
    """
    attitude, inputs = _start(on, started, still)
    score = scored.score(on, orientation_errors, estimate="attitude", innovations=False)
    start = Attitude(attitude=attitude)
    longest = on.longest(inputs)
    return on.case(score, inputs=inputs, start=start, reading=reading_of(on.flight), longest=longest)


def _start(on: OnFlight, started: Started, still: float | None) -> tuple[np.ndarray, dict[str, Series]]:
    """The attitude (4) at the start, and the inputs from then on."""
    if on.weightless:  # nothing levels it
        pose = started.pose(on, on.inputs, deviates=False)
        return pose.attitude, pose.inputs
    begin, pose = started.orientation(on, on.inputs["imu"], still, deviates=False)
    return begin.attitude, pose.inputs
