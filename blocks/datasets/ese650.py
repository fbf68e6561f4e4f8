"""Orientation recordings of a course: raw counts of an inertial unit beside motion-capture rotations.

    imuRaw1.mat     vals (6, n) ADC counts: force x, y, z, then gyro z, x, y; ts (n,) s
    viconRot1.mat   rots (3, 3, m) body to world, some NaN; ts (m,) s

The counts are of unknown worth. Each set is calibrated by all *other* sets of its folder, so that no filter
is judged on a recording that its calibration has seen; `calibration=` names other sets, or "data_sheet".
The accelerometer gets a scale and a zero an axis (`fit_counts`, aligned): in four sets the body tilts by less
than 60 degrees or so, and what a full matrix makes of them is off by 1.5 degrees where it stands on end.

The motion capture is late by about 10 ms: with its stamps moved by -0.01 s, the rates of the two sides agree
best on four of the six sets, and to 20 ms on the others.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.matfile import read_mat
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    imu_noise,
    known,
    policy,
    stream_settings,
)
from flowgraph.blocks.datasets.tables import POLICIES
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.inertial.imu_calibration import CountsCalibration, calibrated, fit_counts, windows_of
from flowgraph.blocks.signals import Attitude, Imu, ImuCounts
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError

__all__ = ["DATA_SHEET", "FREEZES", "LATE", "NOISE", "SETTINGS", "load", "sets_in"]

LATE = -0.01
"""What is added to the stamps of the motion capture, s, when nothing else is said."""

FREEZES = 0.15
"""s: after so long at one level the gyroscope of these recordings has stopped measuring, as it does for a
second or two when it is knocked."""

NOISE = ImuNoise(gyro=0.01, accelerometer=0.05, gyro_bias=1e-3, accelerometer_bias=1e-2)
"""Densities of the order of what the unit's readings at rest show."""

_RATE = 3300.0 / 1023.0 / 3.33 * math.pi / 180.0
_FORCE = 3300.0 / 1023.0 / 330.0 * 9.81
DATA_SHEET = CountsCalibration.of(
    np.vstack([np.eye(3) * _RATE, -_RATE * np.array([373.6, 375.4, 369.6])]),
    np.vstack([np.diag([-_FORCE, -_FORCE, _FORCE]), _FORCE * np.array([511.5, 511.5, -511.5])]),
)
"""The nominal sensitivities (3.33 mV/(deg/s), 330 mV/g, 10 bit of 3.3 V), with the counts at rest for the
gyroscope and half the range for the accelerometer."""

SETTINGS: Mapping[str, str] = {
    "calibration": "whose recordings calibrate: others (all other sets), data_sheet, or numbers such as 1+3",
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
    **NOISE_SETTINGS,
    **stream_settings("imu", "truth"),
    **stream_settings("counts", only=("time_offset", "every")),
    "truth.time_offset": f"s, added to the stamps of the motion capture; {LATE} if left out",
}
"""The settings of `load` and what they mean."""


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a set: the streams `counts` (`ImuCounts`) and, calibrated, `imu` (`Imu`).

    Args:
        argument: FOLDER:N, for imuRawN.mat and viconRotN.mat in the folder.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight`. truth: `Attitude` of the motion capture, where it saw the body. info: `imu_noise`,
        `calibration` (`CountsCalibration`), `calibrated_by` (the numbers of the sets), `gyro_freezes` (s, see
        `FREEZES`), `absent`.

    Raises:
        DataError: a file is missing or cut off, a field is missing or of another shape, a matrix is no
            rotation, stamps are out of order, or no other set is there to calibrate with.
        DeclarationError, UnknownNameError: for a setting.
    """
    given = {"truth.time_offset": LATE, **(settings or {})}
    known(given, SETTINGS, "ese650")
    folder_text, colon, n_text = argument.rpartition(":")
    if not colon or not n_text.isdecimal():
        raise DataError(
            "this names no set",
            path=f"ese650:{argument}",
            expected="ese650:FOLDER:N, N the number of the set",
            got=repr(argument),
            fix="for example ese650:datasets/ese650:2",
        )
    folder, n = Path(folder_text).expanduser(), int(n_text)
    bad_time = policy(given, "ese650")
    if n not in sets_in(folder):
        raise DataError(
            f"there is no set {n}",
            path=str(folder),
            expected=f"imuRaw{n}.mat and viconRot{n}.mat",
            got="sets " + (", ".join(map(str, sets_in(folder))) or "none"),
            fix="check the folder and the number",
        )
    calibration, by = _calibration(folder, n, str(given.get("calibration", "others")), given, bad_time)
    made = _set(folder, n, given, bad_time)
    counts = made.streams["counts"]
    reading = calibrated.step(counts.values, calibration=calibration, xp=np)
    columns = {"gyro": reading.gyro, "specific_force": reading.specific_force}
    made.add("imu", str(folder / f"imuRaw{n}.mat"), counts.time, columns, Imu)
    made.info.update(calibration=calibration, calibrated_by=by)
    made.info["gyro_freezes"] = FREEZES
    made.info["imu_noise"] = imu_noise(given, "ese650", made.notes, NOISE)
    source = f"sets {', '.join(map(str, by))}" if by else "the data sheet"
    made.notes.append(note("info", f"imu: calibrated by {source}"))
    return made.flight()


def sets_in(folder: Path) -> list[int]:
    """The numbers of the sets of which both files are in a folder."""
    found = [re.fullmatch(r"imuRaw(\d+)\.mat", f.name) for f in sorted(folder.glob("imuRaw*.mat"))]
    numbers = [int(m[1]) for m in found if m]
    return sorted(n for n in numbers if (folder / f"viconRot{n}.mat").is_file())


def _calibration(
    folder: Path, n: int, rule: str, given: Mapping[str, Any], bad_time: str
) -> tuple[CountsCalibration, tuple[int, ...]]:
    if rule == "data_sheet":
        return DATA_SHEET, ()
    sets = sets_in(folder)
    try:
        by = [m for m in sets if m != n] if rule == "others" else sorted({int(m) for m in rule.split("+")})
    except ValueError:
        raise DeclarationError(
            "this names no sets",
            path="ese650.calibration",
            expected="others, data_sheet, or numbers of sets with + between them",
            got=repr(rule),
            fix="for example calibration=1+3",
        ) from None
    lacking = [m for m in by if m not in sets]
    if not by or lacking:
        raise DataError(
            f"set {n} has no other set to be calibrated with" if not by else f"there is no set {lacking[0]}",
            path=str(folder),
            expected="imuRawN.mat and viconRotN.mat of other sets in the folder",
            got="sets " + (", ".join(map(str, sets)) or "none"),
            fix="put other sets beside it, or write calibration=data_sheet",
        )
    windows = []
    for m in by:
        other = _set(folder, m, given, bad_time)
        counts, truth = other.streams["counts"], other.truth
        assert truth is not None
        truth = truth[np.isfinite(truth["attitude"]).all(axis=1)]
        readings = np.concatenate([counts["gyro"], counts["force"]], axis=1)
        windows.append(windows_of(counts.time, readings, truth.time, truth["attitude"]))
    return fit_counts(windows, aligned=True), tuple(by)


def _set(folder: Path, n: int, given: Mapping[str, Any], bad_time: str) -> Recording:
    """The counts and the truth of one set."""
    made = Recording(f"set{n}", bad_time, kind="ese650", given=given)
    file = folder / f"imuRaw{n}.mat"
    raw = read_mat(file, {"vals": (6, None), "ts": (None,)})
    vals = raw["vals"].T
    columns = {"gyro": vals[:, [4, 5, 3]], "force": vals[:, :3]}
    made.add("counts", str(file), _stamps(raw["ts"], len(vals), file), columns, ImuCounts, raw=True)
    if vals.min() < 0 or vals.max() > 1023:
        raise DataError(
            "these are no counts of a 10-bit converter",
            path=f"{file}: vals",
            expected="numbers from 0 to 1023",
            got=f"{vals.min():g} to {vals.max():g}",
            fix="give the raw recording, not a calibrated one",
        )
    file = folder / f"viconRot{n}.mat"
    seen = read_mat(file, {"rots": (3, 3, None), "ts": (None,)})
    rots = np.moveaxis(seen["rots"], 2, 0)
    time = _stamps(seen["ts"], len(rots), file)
    attitude = {"attitude": _attitudes(rots, file)}
    made.add("truth", str(file), time, attitude, Attitude, exact=True)
    return made


def _stamps(seconds: np.ndarray, n: int, file: Path) -> np.ndarray:
    if len(seconds) != n or not np.isfinite(seconds).all():
        raise DataError(
            "field 'ts' does not have one stamp a sample",
            path=f"{file}: ts",
            expected=f"{n} finite stamps in seconds",
            got=f"{int(np.isfinite(seconds).sum())} finite of {len(seconds)}",
            fix="restore the file",
        )
    return Series.from_seconds(seconds, np.zeros(n), name=f"{file}: ts").time


def _attitudes(rots: np.ndarray, file: Path) -> np.ndarray:
    """Quaternions (n, 4) of rotation matrices (n, 3, 3); NaN where one is."""
    seen = np.isfinite(rots).all(axis=(1, 2))
    off = np.abs(rots @ rots.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero(
        seen & ((off > 1e-3) | (np.linalg.det(np.where(seen[:, None, None], rots, np.eye(3))) < 0))
    )
    if len(wrong):
        raise DataError(
            "a matrix is no rotation",
            path=f"{file}: rots, {wrong[0] + 1}",
            expected="R R^T = 1 to 1e-3, and a positive determinant",
            got=f"off by {off[wrong[0]]:.3g}",
            fix="restore the file",
        )
    q = np.full((len(rots), 4), np.nan)
    if seen.any():
        q[seen] = scipy.spatial.transform.Rotation.from_matrix(rots[seen]).as_quat(canonical=True)[
            :, [3, 0, 1, 2]
        ]
    return q
