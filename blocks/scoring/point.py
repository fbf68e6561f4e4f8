"""Linear filters of a point on flights: told the attitude, they see accelerations and positions.

Told the exact attitude and bias, such a filter is the bound that no filter on the same data can beat.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from flowgraph import Case, DataError, Flight, Series, arrays
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.metrics.consistency import point_errors
from flowgraph.blocks.models.point import point_model, point_steps, start_point
from flowgraph.blocks.scoring.cases import Adapted, HeldControl, OnFlight, Smoothed
from flowgraph.blocks.scoring.settings import Positive
from flowgraph.blocks.scoring.start import from_first
from flowgraph.blocks.scoring.streams import told_acceleration
from flowgraph.blocks.scoring.tuning import given, imu_noise_of, reading_of
from flowgraph.blocks.signals import PointReading, Position

__all__ = ["PointFilter", "on_point", "positions", "readings"]


@dataclass(frozen=True)
class PointFilter(HeldControl, Adapted, Smoothed):
    """What is set of a linear filter of a point.

    Args:
        position_noise: standard deviation, m; the flight's own if left out.
        accelerometer_noise: density, m/s^2/sqrt(Hz); the flight's own if left out.
    """

    position_noise: Positive | None = None
    accelerometer_noise: Positive | None = None


def on_point(on: OnFlight, filter: PointFilter, inputs: Mapping[str, Series]) -> Case:
    """The filter on such inputs, at the first position and at rest.

    Args:
        on: with the streams `imu` and `vicon`.

    Raises:
        DataError: where the flight does not say its noise.
    """
    place, inputs = from_first(on, inputs, on.inputs["vicon"], "position")
    held = filter.held(on, on.inputs["imu"], inputs)
    if held is None and "reading" in inputs and np.isnan(inputs["reading"]["acceleration"]).any():
        held = Held(after=1.0, rate=0.0, force=0.0)  # a control is missing, none for long
    density = given(filter.accelerometer_noise, imu_noise_of(on.name, on.flight).accelerometer)
    return on.case(
        filter.score(on, point_errors, steps=partial(point_steps, model=point_model(density))),
        inputs=inputs,
        start=start_point(place),
        noise=density,
        position_noise=on.noise("position_noise", filter.position_noise),
        control=reading_of(on.flight),
        held=held,
        **filter.gating(),
    )


def positions(vicon: Series) -> Series:
    """The positions of a motion capture."""
    return vicon.holding(Position(position=vicon["position"]), "position")


def readings(flight: Flight) -> Series:
    """The flight's accelerations, each with the position of its time, NaN where there was none; and the
    positions of a gap of the controls, with NaN for these.

    Args:
        flight: with the stream `vicon`, and what `told_acceleration` asks for.

    Raises:
        DataError: without an IMU or truth, or where a position comes between two IMU readings that follow on
            each other.
    """
    vicon, control = flight.streams["vicon"], told_acceleration(flight)
    if not (np.isin(vicon.time, control.time) | _in_gap(vicon.time, control.time)).all():
        raise DataError(
            "the positions do not come with the controls",
            path=flight.name,
            expected="a stream vicon, at times of the stream imu",
            got="positions between two readings of the imu",
            fix="use async_kalman, which takes each when it comes",
        )
    time = np.union1d(control.time, vicon.time)
    position, acceleration = np.full((2, len(time), 3), np.nan)
    position[np.searchsorted(time, vicon.time)] = vicon["position"]
    acceleration[np.searchsorted(time, control.time)] = control["acceleration"]
    values = PointReading(acceleration=acceleration, position=position)
    return arrays(time, values, not_finite="keep", name="reading")


def _in_gap(time: np.ndarray, control: np.ndarray) -> np.ndarray:
    """Which times lie between two controls that others should have come between."""
    steps = np.diff(control)
    if not len(steps):
        return np.zeros(len(time), dtype=bool)
    wide = np.concatenate([[False], steps > 1.5 * np.median(steps), [False]])
    return wide[np.searchsorted(control, time)]
