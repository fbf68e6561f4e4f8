"""How a filter is tuned for a flight: with what the user says, or else what the flight says of its sensors.

A filter weighs by the noise that it is told, so a noise of zero is no setting: the first reading would be
taken for the truth and divided by. That is refused here, by the name of what would have to be said instead.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu
from flowgraph.errors import DataError, DeclarationError

__all__ = ["WEIGHTLESS", "given", "imu_noise_of", "noise_of", "reading_of", "unbiased_factors", "with_imu"]

WEIGHTLESS = (0.0, 0.0, 0.0)
"""The gravity of a world without one, m/s^2."""


def given(value: Any, otherwise: Any) -> Any:
    """The value, or what to use where it was left out (None)."""
    return otherwise if value is None else value


def noise_of(
    graph: str, flight: Flight, name: str, setting: float | None, otherwise: float | None = None
) -> float:
    """A standard deviation: the setting, or the flight's own, or `otherwise`.

    Args:
        graph: who asks.
        name: of the setting, and of the entry in the flight's `info`.

    Raises:
        DataError: where nobody says it.
        DeclarationError: where it is zero.
    """
    found = given(setting, flight.info.get(name, otherwise))
    if found is None:
        raise DataError(
            f"this flight does not say its {name}, and {graph} needs it",
            path=f"{flight.name}: info",
            expected=f"{name}, in SI units",
            got=", ".join(flight.info) or "nothing",
            fix=f"write --set {name}=0.1, or {name}=0.1 in code",
        )
    if not found > 0.0:
        raise DeclarationError(
            f"{graph} cannot weigh measurements without noise",
            path=f"{graph}.{name}",
            expected="a positive number",
            got=f"{found:g}" + (" (the flight's own)" if setting is None else ""),
            fix=f"say how far to trust them, --set {name}=0.001, or give the flight's sensor some noise",
        )
    return float(found)


def imu_noise_of(
    graph: str, flight: Flight, gyro_factor: float = 1.0, accelerometer_factor: float = 1.0
) -> ImuNoise:
    """The noise of the flight's inertial unit, its densities times factors.

    Raises:
        DataError: where the flight does not say it.
    """
    noise = flight.info.get("imu_noise")
    if not isinstance(noise, ImuNoise):
        raise DataError(
            f"this flight does not say the noise of its imu, and {graph} needs it",
            path=f"{flight.name}: info",
            expected="imu_noise, an ImuNoise",
            got=", ".join(flight.info) or "nothing",
            fix="give the Flight info={'imu_noise': ImuNoise(...)}",
        )
    return noise.scaled(gyro=gyro_factor, accelerometer=accelerometer_factor)


def unbiased_factors(graph: str, flight: Flight) -> tuple[float, float]:
    """Factors on the densities of gyroscope and accelerometer, for a filter that knows no biases.

    They are 20 for a unit whose biases walk, and 1 for one that has none.
    """
    noise = imu_noise_of(graph, flight)
    factor = 20.0 if noise.gyro_bias or noise.accelerometer_bias else 1.0
    return factor, factor


def reading_of(flight: Flight, sensor: str = "imu") -> str:
    """Whether the flight's sensor reads an "instant", or the "mean" since its last reading."""
    info = flight.info
    averages = info.get(f"{sensor}_oversample", 1) > 1 or info.get(f"{sensor}_turn", False)
    return "mean" if averages else "instant"


def with_imu(flight: Flight) -> Flight:
    """The flight, with an `imu` of the thesis's unit, `gyro` and `coordinate_acceleration`, if it has none.

    A coordinate acceleration is the specific force of a world without gravity, and the flight then says so.
    Where one of the two oversamples, or the gyroscope reads turns, so does the `imu`: a reading of both is
    then that of the step since the one before, which is the mean of such a sensor's own readings in it, and
    of an instant's the mean of the two at its ends.
    """
    parts = ("gyro", "coordinate_acceleration")
    if "imu" in flight.streams or not set(parts) <= set(flight.streams):
        return flight
    gyro, push = (flight.streams[name] for name in parts)
    kept, *rows = np.intersect1d(gyro.time, push.time, return_indices=True)
    looks = [int(flight.info.get(f"{name}_oversample", 1)) for name in parts]
    turn = bool(flight.info.get("gyro_turn", False))
    means = [looks[0] > 1 or turn, looks[1] > 1]
    columns = [
        _of_steps(values, row, mean=mean) if any(means) else values[row]
        for values, row, mean in zip((gyro["rate"], push["acceleration"]), rows, means, strict=True)
    ]
    values = Imu(gyro=columns[0], specific_force=columns[1])
    streams = {"imu": Series(kept, values, name="imu", gaps=gyro.gaps or push.gaps), **flight.streams}
    info = {**flight.info, "gravity": WEIGHTLESS}
    if set(parts) <= set(flight.info.get("noise", ())):
        told = [flight.info["noise"][name] for name in parts]
        info["imu_noise"] = ImuNoise(*(n["noise"] for n in told), *(n["walk"] for n in told))
    info |= {"imu_oversample": max(looks), "imu_turn": turn}
    if len(kept) > 1:
        info["imu_period_ns"] = int(np.median(np.diff(kept)))
    return replace(flight, streams=streams, info=info)


def _of_steps(values: np.ndarray, rows: np.ndarray, *, mean: bool) -> np.ndarray:
    """What readings (n, 3) say of the steps that end at some of them: the mean of those in the step, where
    each is a mean itself, or that of the two at its ends."""
    before = np.concatenate([rows[:1], rows[:-1]])
    if not mean:
        return np.asarray(0.5 * (values[before] + values[rows]))
    count = rows - before
    if (count <= 1).all():
        return values[rows]
    total = np.cumsum(values, axis=0)
    return np.where(
        count[:, None], (total[rows] - total[before]) / np.maximum(count, 1)[:, None], values[rows]
    )
