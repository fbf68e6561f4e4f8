"""Streams that a filter asks for and a flight has in other words, and what it may know of them beforehand.

A recording has one inertial unit where a filter reads gyroscope and accelerometer apart; a truth and an
inertial unit tell the acceleration in the world; a density and a rate tell the noise of one reading.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.metrics.truth import interpolate
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.blocks.signals import GRAVITY, Gyro, SpecificForce, WorldAcceleration
from flowgraph.errors import DataError

__all__ = ["own_density", "reading_deviation", "told_acceleration", "with_parts"]


def told_acceleration(flight: Flight) -> Series:
    """The flight's specific force as a `WorldAcceleration`, by the truth's attitude and accelerometer bias.

    Raises:
        DataError: for a flight without an IMU or without a truth.
    """
    imu, truth = flight.streams.get("imu"), flight.truth
    if imu is None or truth is None or "attitude" not in truth.leaves:
        raise DataError(
            "the acceleration in the world is not known",
            path=flight.name,
            expected="a stream imu, and a truth that tells the attitude",
            got=", ".join(flight.streams) + (", no truth" if truth is None else ""),
            fix="choose a simulated flight, or give the filter accelerations of your own",
        )
    half = flight.info["imu_period_ns"] // 2 if reading_of(flight) == "mean" else 0
    attitude = interpolate(truth, "attitude", imu.time - half)  # of a mean, that of its middle
    force = imu["specific_force"]
    if "accelerometer_bias" in truth.leaves:
        last = np.maximum(np.searchsorted(truth.time, imu.time, side="right") - 1, 0)
        force = force - truth["accelerometer_bias"][last]
    turned = (to_matrix(attitude, xp=np) @ force[..., None])[..., 0]
    found = WorldAcceleration(acceleration=turned + np.array(flight.info.get("gravity", GRAVITY)))
    return Series(imu.time, found, name="acceleration")


def with_parts(flight: Flight) -> Flight:
    """The flight, with `gyro` and `accelerometer` taken out of its `imu` where they are missing."""
    streams, info = dict(flight.streams), dict(flight.info)
    if "imu" in streams:
        imu = streams["imu"]
        if "gyro" not in streams:
            info.update(gyro_oversample=info.get("imu_oversample", 1), gyro_turn=info.get("imu_turn", False))
        streams.setdefault("gyro", imu.holding(Gyro(rate=imu["gyro"]), "gyro"))
        force = SpecificForce(force=imu["specific_force"])
        streams.setdefault("accelerometer", imu.holding(force, "accelerometer"))
    return replace(flight, streams=streams, info=info)


def reading_deviation(flight: Flight, part: str, series: Series, density: float | None) -> float:
    """The standard deviation of one reading of a gyroscope or accelerometer: its density times sqrt(rate).

    Args:
        part: gyro, accelerometer or coordinate_acceleration.
        density: the setting; the flight's own if left out.
    """
    step = float(np.median(np.diff(series.time))) * 1e-9 if len(series) > 1 else 1.0
    return own_density(flight, part, density) / math.sqrt(step)


def own_density(flight: Flight, part: str, density: float | None) -> float:
    """The density of the white noise of an inertial sensor: the setting, or the flight's own.

    Raises:
        DataError: where nobody says it.
    """
    own = flight.info.get("noise", {}).get(part, {}).get("noise")
    if density is None and own is None and "imu_noise" in flight.info:
        own = getattr(flight.info["imu_noise"], part, None)
    if density is None and own is None:
        raise DataError(
            f"this flight does not say the noise of its {part}, and a covariance needs it",
            path=f"{flight.name}: info",
            expected="imu_noise, or noise by sensor",
            got=", ".join(flight.info) or "nothing",
            fix="give it as a setting, or leave the covariance out",
        )
    return float(own if density is None else density)
