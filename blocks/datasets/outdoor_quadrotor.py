"""Flights of an outdoor quadrotor: four consumer inertial units, and a receiver of satellites with RTK.

    outdoor_quadrotor:DIR[:IMU]     path_2/GT.csv and path_2/IMU_1.csv; the unit is 1 if left out

    IMU_k.csv  time [s], Euler_X, Euler_Y, Euler_Z, Acc_X, Acc_Y, Acc_Z [m/s^2, with gravity],
               Gyr_X, Gyr_Y, Gyr_Z [deg/s]                                                     at 120 Hz
    GT.csv     time, distance, speed, compass heading, pitch, roll, height, North, East, Down [m]  at 10 Hz

The body is the unit. The world is east, north, up about the first position. `rtk` is every position, thinned
by rtk.every, and the truth is all of them: what a filter was not given is what it is judged by. The two
clocks of a recording are apart by up to 0.6 s, the same over a session; rtk.time_offset moves the truth too,
which has the receiver's clock. The angles of the unit's own filter and of the autopilot are not read.

Source: D. Hurwitz, I. Klein, "Quadrotor dead reckoning with multiple inertial sensors", DGON Inertial Sensors
and Systems, 2023.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.cells import decimal_mark, numbers, stamps
from flowgraph.blocks.datasets.dialect import read_sheet
from flowgraph.blocks.datasets.shape import (
    MEASURED_NOISE,
    NOISE_SETTINGS,
    Recording,
    imu_noise,
    known,
    measured_noise,
    policy,
    split_argument,
    stream_settings,
)
from flowgraph.blocks.datasets.stamps import POLICIES
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu, Position
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["NOISE", "SETTINGS", "load"]

SETTINGS: Mapping[str, str] = {
    **NOISE_SETTINGS,
    "position.noise": MEASURED_NOISE["position.noise"],
    **stream_settings("imu", "rtk", "truth"),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""

NOISE = ImuNoise(gyro=1.2e-4, accelerometer=6e-3, gyro_bias=1e-5, accelerometer_bias=1e-4)
"""Densities of the unit by its maker's sheet; of the walks of its biases, which it leaves out, those of
units of its kind."""

RTK_NOISE = 0.02
"""m, an axis, of a position with its ambiguities fixed."""

_FORCE, _RATE = ("Acc_X", "Acc_Y", "Acc_Z"), ("Gyr_X", "Gyr_Y", "Gyr_Z")
_PLACE = ("East", "North", "Down")
_SHIFT = "rtk.time_offset"


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a flight: the streams `imu` (`Imu`) and `rtk` (`Position`, east, north, up).

    Args:
        argument: DIR[:IMU], the folder of a flight and the number of one of its units.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight` with the truth (`Position`). info: `imu_noise`, `position_noise` (m), `absent`.

    Raises:
        DataError: a file or column is missing, a cell is no number (file, line), stamps are out of order, or
            values cannot be of their unit.
        DeclarationError, UnknownNameError: for settings.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "outdoor_quadrotor")
    folder, unit = split_argument(argument, "outdoor_quadrotor:DIR[:IMU]")
    if _SHIFT in given:
        given.setdefault("truth.time_offset", given[_SHIFT])
    inertial, satellites = _files(folder, "1" if unit is None else str(unit))
    made = Recording(
        folder.name,
        policy(given, "outdoor_quadrotor"),
        kind="outdoor_quadrotor",
        given=given,
        place=str(folder),
    )
    time, columns, where = _columns(inertial, (*_RATE, *_FORCE), made.notes)
    readings = {"gyro": np.radians(columns[:, :3]), "specific_force": columns[:, 3:]}
    made.add("imu", str(inertial), time, readings, Imu, row=where)
    time, columns, where = _columns(satellites, _PLACE, made.notes)
    place = {"position": columns * (1.0, 1.0, -1.0)}
    made.add("truth", str(satellites), time, place, Position, row=where)
    made.add("rtk", str(satellites), time, place, Position, row=where)
    steps = np.diff(np.unique(np.round(columns[:, 2], 3)))
    if len(steps) and steps.min() > 2.0 * RTK_NOISE:
        said = (
            f"Down is written in steps of {steps.min():g} m, more than a position is off by ({RTK_NOISE:g} m)"
        )
        made.notes.append(note("info", f"{satellites.name}: {said}"))
    made.notes.append(note("skipped", f"{inertial.name}, {satellites.name}: the columns of angles"))
    made.info["imu_noise"] = imu_noise(given, "outdoor_quadrotor", made.notes, NOISE)
    made.info["position_noise"] = RTK_NOISE
    measured_noise(given, "outdoor_quadrotor", made.info)
    return made.flight()


def _files(folder: Path, unit: str) -> tuple[Path, Path]:
    """The tables of a unit and of the receiver.

    Raises:
        DataError: where one is missing.
    """
    found = folder / f"IMU_{unit}.csv", folder / "GT.csv"
    for file in found:
        if not file.is_file():
            units = sorted(f.stem.removeprefix("IMU_") for f in folder.glob("IMU_*.csv"))
            flights = sorted(f.parent.name for f in folder.glob("*/GT.csv"))
            raise DataError(
                "this is no flight of the outdoor quadrotor",
                path=str(file),
                expected="a folder with GT.csv and IMU_1.csv",
                got="no such file"
                + (f"; there are units {', '.join(units)}" if units else "")
                + (f"; there are flights {', '.join(flights)}" if flights else ""),
                fix="name the folder of one flight, outdoor_quadrotor:DIR:IMU",
            )
    return found


def _columns(file: Path, names: tuple[str, ...], notes: list[str]):  # type: ignore[no-untyped-def]
    """Times (n,) ns, the named columns (n, k), and what to call a row.

    Raises:
        DataError: for a column that is not there, or a cell that is no number.
    """
    sheet = read_sheet(file, wanted=("time", *names))
    places = [sheet.column(name) for name in ("time", *names)]
    cells = [sheet.cells(k) for k in places]
    decimal, said = decimal_mark(cells, sheet.where, None)
    time, clock = stamps(cells[0], sheet.where, unit="s", decimal=decimal)
    notes.extend([*sheet.notes, *filter(None, [said, clock])])
    parts = [numbers(c, sheet.where, k, decimal=decimal) for c, k in zip(cells[1:], places[1:], strict=True)]
    return time, np.stack(parts, axis=1), sheet.where
