"""Folders of text as KF-GINS and awesome-gins have them: increments of a unit, fixes, and a solution.

    gins:DIR[:IMU]

    IMU.txt     seconds of the week, increments of angle (3, rad) and of velocity (3, m/s) of forward, right,
                down
    GNSS*.txt   seconds of the week, latitude, longitude (degrees), height (m), deviations north, east, down
                (m); perhaps velocity north, east, down (m/s) and its deviations
    *.nav       week, seconds, latitude, longitude (degrees), height (m), velocity north, east, down (m/s),
                roll, pitch, yaw (degrees)

An increment over its step is what `imu` reads, held until the next. Axes are turned into forward, left, up,
and east, north, up about the first fix. The week is that of the solution; without one, stamps are seconds of
a week that is not known. Time is that of GPS. Where the antenna sits stands in no file of these: gps.lever
says it. The solution, of a better unit and worked up afterwards, is the truth.

Source: X. Niu et al., i2Nav, Wuhan University: https://github.com/i2Nav-WHU/KF-GINS, awesome-gins-datasets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.cells import numbers, stamps
from flowgraph.blocks.datasets.dialect import read_sheet
from flowgraph.blocks.datasets.places import (
    GPS_EPOCH,
    NAVIGATION_SETTINGS,
    add_fixes,
    add_solution,
    add_velocities,
    diagonal,
    from_frd,
    from_ned,
)
from flowgraph.blocks.datasets.shape import (
    Recording,
    imu_noise,
    known,
    policy,
    split_argument,
)
from flowgraph.blocks.signals import Imu
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["SETTINGS", "load"]

SETTINGS = NAVIGATION_SETTINGS
"""The settings of `load` and what they mean."""

_WEEK = 604_800 * 10**9
_Table = tuple[np.ndarray, np.ndarray, Callable[[int], str]]


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read `imu`, `gps` (`GnssFix`), perhaps `gps_velocity`; truth: `Pose`, where there is a solution.

    Args:
        argument: DIR[:IMU], the folder and the name of its unit's file without .txt.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: a file is missing or there are several, or a row is none of its kind (file, line); values
            cannot be of their unit. UnknownNameError: for a setting.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "gins")
    folder, unit = split_argument(argument, "gins:DIR[:IMU]")
    inertial, satellites, solution = _files(folder, None if unit is None else str(unit))
    made = Recording(folder.name, policy(given, "gins"), kind="gins", given=given, place=str(folder))
    origin = 0
    solved = None
    if solution is not None:
        time, x, where = _table(solution, (11,), clock=1)
        week = int(x[0, 0])
        origin = GPS_EPOCH + week * _WEEK
        solved = time + (GPS_EPOCH + np.round(x[:, 0]).astype(np.int64) * _WEEK), x, where
    time, x, where = _table(inertial, (7,))
    step = np.diff(time) * 1e-9
    if len(step) < 1 or (step <= 0.0).any():
        k = int(np.argmax(step <= 0.0)) if len(step) else 0
        raise DataError(
            "increments need the time since the row before",
            path=where(min(k + 1, len(time) - 1)),
            expected="stamps that go up",
            got="one row" if not len(step) else f"a step of {step[k]:g} s",
            fix="mend or delete the row",
        )
    step = np.concatenate([step[:1], step])[:, None]
    readings = {"gyro": from_frd(x[:, 1:4] / step), "specific_force": from_frd(x[:, 4:7] / step)}
    made.add("imu", str(inertial), origin + time, readings, Imu, row=where)
    time, x, where = _table(satellites, (7, 13))
    add_fixes(made, str(satellites), origin + time, x[:, 1:4], diagonal(x[:, [5, 4, 6]]), where)
    if x.shape[1] == 13:
        worth = diagonal(x[:, [11, 10, 12]])
        add_velocities(made, str(satellites), origin + time, from_ned(x[:, 7:10]), worth)
    if solved is not None and solution is not None:
        time, x, where = solved
        first = made.streams["gps"]
        here = tuple(float(first[name][0]) for name in ("latitude", "longitude", "height"))
        places = np.concatenate([np.radians(x[:, 2:4]), x[:, 4:5]], axis=1)
        add_solution(made, str(solution), time, places, np.radians(x[:, 8:11]), here, where)
    else:
        made.notes.append(
            note("assumed", "there is no solution (.nav): stamps are seconds of an unknown week")
        )
    if "gps.lever" not in given:
        made.notes.append(note("assumed", "gps.lever, where the antenna sits in the body, is not known"))
    made.info["imu_noise"] = imu_noise(given, "gins", made.notes)
    return made.flight()


def _files(folder: Path, unit: str | None) -> tuple[Path, Path, Path | None]:
    """The unit's, the receiver's, and the solution where there is one.

    Raises:
        DataError: where one is missing, or there are several that it may be.
    """
    texts = sorted(folder.glob("*.txt")) if folder.is_dir() else []
    fixes = [f for f in texts if f.stem.lower().startswith("gnss")]
    units = [f for f in texts if f not in fixes and "readme" not in f.stem.lower()]
    if unit is not None:
        units = [f for f in units if f.stem == unit]
    solutions = sorted(folder.glob("*.nav")) if folder.is_dir() else []
    solutions = [f for f in solutions if f.stem.lower() == "truth"] or solutions
    for what, found, fix in (
        ("file of a unit", units, "name the unit, gins:DIR:IMU"),
        ("file of fixes, GNSS*.txt", fixes, "leave one in the folder"),
        ("solution, *.nav", solutions, "leave one in the folder, or call it truth.nav"),
    ):
        if len(found) > 1 or (not found and what[0] == "f"):
            raise DataError(
                "this is no folder of KF-GINS" if not found else f"there is more than one {what}",
                path=str(folder),
                expected=f"one {what}",
                got=", ".join(f.name for f in found or texts)[:200] or "no .txt",
                fix=fix if found else "name the folder of a recording, gins:DIR:IMU",
            )
    return units[0], fixes[0], solutions[0] if solutions else None


def _table(file: Path, widths: tuple[int, ...], clock: int = 0) -> _Table:
    """Times (n,) ns, all numbers (n, k), and what to call a row.

    Raises:
        DataError: where rows have another width, or a cell is no number.
    """
    sheet = read_sheet(file, width=widths[0], otherwise=None)
    wide = len(sheet.rows[0])
    if wide not in widths:
        raise DataError(
            "rows of this file have another width",
            path=sheet.where(0),
            expected=f"{' or '.join(map(str, widths))} columns",
            got=str(wide),
            fix="check what the file holds: it may be of another kind",
        )
    time, _ = stamps(sheet.cells(clock), sheet.where, unit="s")
    x = [numbers(sheet.cells(k), sheet.where, k) for k in range(wide)]
    return time, np.stack(x, axis=1), sheet.where
