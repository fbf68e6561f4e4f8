"""Flights of a small quadrotor with on-board vision: AprilTag poses and optical-flow velocities.

    rob6213:FILE[:CSV]     proj2_dataset1.mat; vicon_dataset1.csv beside it if left out

    time, position (m), angle (Z-Y-X Euler: roll, pitch, yaw): the body in the world, from AprilTags
    linearVel, angVel: of the camera relative to the world, in camera coordinates, from optical flow
    csv: t,x,y,z,roll,pitch,yaw,vx,vy,vz,wx,wy,wz by motion capture; Z-X-Y Euler angles, rates in the body

The files hold no IMU. The one given here is derived from the motion capture: local parabolas through its
positions and attitudes, differentiated. It has no bias and knows the future a little; a filter fed with it
shows what its measurement model is worth, not what a flight would have been. The flight's notes say so.

Rows that are not finite were not measured: poses and velocities are absent there, and the truth is masked.
Where the motion capture is blind for longer than the parabolas are wide, no IMU can be had of it.

The camera velocity is late, by about 0.07 s, and its stamps are shifted back. The world of the tags and that
of the motion capture differ by a fixed shift, which no filter could find: `SHIFT` and `TURN` take one into
the other. They were fitted to flights 1 and 4 together (each alone gives the same within 5 mm); frame=raw
leaves the poses as they were recorded.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.matfile import columns_of, read_structs
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    chosen,
    imu_noise,
    known,
    number,
    present,
    split_argument,
    stream_settings,
)
from flowgraph.blocks.datasets.tables import strictly_later
from flowgraph.blocks.geometry.euler import quaternion_from_angles
from flowgraph.blocks.geometry.rotations import multiply
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.signals import CameraMotion, Imu, MotionTruth
from flowgraph.blocks.vision.camera import COURSE_MOUNT
from flowgraph.blocks.vision.motion import find_delay, velocity_error
from flowgraph.blocks.vision.pnp import as_measurements
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["NOISE", "SETTINGS", "derived_imu", "load"]

SETTINGS: Mapping[str, str] = {
    "frame": "registered: poses taken into the motion capture's world; raw: as recorded",
    "delay": "s by which the camera velocity is late; found from the motion capture if left out",
    "imu.window": "s, of the local parabolas behind the derived IMU",
    **NOISE_SETTINGS,
    **stream_settings("pose", "motion", "imu", "truth", only=("time_offset", "every")),
}
"""The settings of `load` and what they mean."""

SHIFT, TURN = (-0.0087, -0.0135, 0.0015), -0.0067
"""What takes the on-board poses into the motion capture's: a shift of the world, m, and a turn of the body's
axes about its z, rad."""

USUAL_DELAY = 0.067
"""s, where no motion capture tells."""

NOISE = ImuNoise(gyro=0.002, accelerometer=0.2, gyro_bias=1e-4, accelerometer_bias=1e-3)
"""Densities of the derived IMU: a motion capture's attitude is better than what two derivatives leave of its
position."""

POSE_NOISE = {"position_noise": 0.01, "attitude_noise": 0.05}
"""What the on-board poses are taken for, m and rad; their errors last for tenths of a second, so the rad are
more than the errors' own 0.015."""

_COLUMNS = "t,x,y,z,roll,pitch,yaw,vx,vy,vz,wx,wy,wz"


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a flight: the streams `pose` (`PoseMeasurement`), `motion` (`CameraMotion`), and, with the motion
    capture, `imu` (`Imu`, derived).

    Args:
        argument: FILE[:CSV].
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight`; truth: `MotionTruth`, or None. info: `mount`, `imu_noise`, `delay` (s).

    Raises:
        DataError: a file, variable or column is missing or of another form; names it.
        DeclarationError, UnknownNameError: for settings.
    """
    given = settings or {}
    known(given, SETTINGS, "rob6213")
    frame = chosen(given, "frame", ("registered", "raw"), "rob6213")
    file, csv = split_argument(argument, "rob6213:FILE[:CSV]")
    content = read_structs(file, "time", "position", "angle", "linearVel", "angVel")
    seconds = columns_of(content, "time", file, gaps=True)
    table = {
        n: columns_of(content, n, file, 3, gaps=True) for n in ("position", "angle", "linearVel", "angVel")
    }
    for name, values in table.items():
        if len(values) != len(seconds):
            raise DataError(
                f"variable {name!r} does not have one row a stamp",
                path=str(file),
                expected=f"{len(seconds)} rows",
                got=str(len(values)),
                fix="restore the file",
            )
    made = Recording(file.stem, kind="rob6213", given=given, place=str(file))
    notes, absent = made.notes, made.info["absent"]
    stamped = _stamped(seconds, file, notes)
    seconds, table = seconds[stamped], {name: values[stamped] for name, values in table.items()}
    keep, unordered = strictly_later(seconds, "time", file)
    notes += unordered
    seen = np.concatenate([table["position"], table["angle"]], axis=1)[keep]
    moved = np.concatenate([table["linearVel"], table["angVel"]], axis=1)[keep]
    stamps = Series.from_seconds(seconds[keep], seconds[keep]).time
    time, seen = present("pose", str(file), stamps, _finite(seen), notes, absent)
    position = seen[:, :3]
    attitude = np.asarray(quaternion_from_angles(seen[:, 3:], order="zyx", xp=np))
    if frame == "registered":
        position, attitude = _registered(position, attitude)
        sentence = f"poses taken into the motion capture's frames: shift {SHIFT} m, turn {TURN:g} rad"
        notes.append(note("info", sentence))
    made.take(Series(time, as_measurements(position, attitude), name="pose"), str(file))
    time, moved = present("motion", str(file), stamps, _finite(moved), notes, absent)
    motion = Series(time, CameraMotion(velocity=moved[:, :3], rate=moved[:, 3:]), name="motion")
    made.info.update(mount=COURSE_MOUNT, **POSE_NOISE)
    truth = None
    csv = csv or _beside(file)
    delay = USUAL_DELAY
    if csv is None:
        notes.append(note("info", "no motion capture beside the file: no truth and no IMU"))
    else:
        truth = _truth(csv, notes, absent)
        window = number(given, "imu.window", 0.11, "rob6213", positive=True)
        derived = derived_imu(truth, window)
        notes.append(note("info", "imu: derived from the motion capture, not recorded"))
        delay = find_delay(motion, truth, COURSE_MOUNT)
    delay = number(given, "delay", delay, "rob6213", signed=True)
    if truth is not None:
        error = velocity_error(motion, truth, COURSE_MOUNT, delay)
        sentence = f"motion: {delay:.3f} s late; then {error:.4f} m/s RMS from the motion capture"
        notes.append(note("info" if "delay" in given else "assumed", sentence))
        made.take(derived, str(csv))
        made.take(truth, str(csv))
    late = motion.time - round(delay * 1e9)
    made.take(Series(late, motion.values, name="motion"), str(file))
    made.info.update(delay=delay, imu_noise=imu_noise(given, "rob6213", notes, NOISE))
    return made.flight()


def _registered(position: np.ndarray, attitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turn = np.array([np.cos(0.5 * TURN), 0.0, 0.0, np.sin(0.5 * TURN)])
    return position + np.asarray(SHIFT), np.asarray(multiply(attitude, turn, xp=np))


def _beside(file: Path) -> Path | None:
    """The motion capture with the same number."""
    number = re.search(r"(\d+)$", file.stem)
    csv = file.parent / f"vicon_dataset{number.group(1)}.csv" if number else None
    return csv if csv is not None and csv.is_file() else None


def _finite(table: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(table), table, np.nan)


def _stamped(seconds: np.ndarray, file: Path, notes: list[str]) -> np.ndarray:
    """Which rows have a stamp; a note on the others."""
    known = np.isfinite(seconds)
    if not known.all():
        many = int((~known).sum())
        notes.append(
            note("skipped", f"{file.name}: {many} of {len(seconds)} stamps are not finite: rows left out")
        )
    return known


def _truth(file: Path, notes: list[str], absent: dict[str, int]) -> Series:
    """The motion capture; rows that are not finite are masked."""
    if not file.is_file():
        raise DataError(
            "the motion capture is missing",
            path=str(file),
            expected=f"a csv with the columns {_COLUMNS}",
            got="no such file",
            fix="give FILE:CSV, or leave the csv out",
        )
    lines = file.read_text(encoding="utf-8-sig").splitlines()
    try:
        if "".join(lines[:1]).replace(" ", "") != _COLUMNS:
            raise ValueError("another heading: " + "".join(lines[:1])[:60])
        x = np.array([[float(cell or "nan") for cell in line.split(",")] for line in lines[1:]])
        known = np.isfinite(x)
        if x.ndim != 2 or x.shape[1] != 13 or known.all(axis=1).sum() < 20:
            raise ValueError(f"shape {x.shape}, or too few rows that are finite")
        numbers = np.flatnonzero(known[:, 0])
        if not (np.diff(x[numbers, 0]) > 0.0).all():
            row = int(np.flatnonzero(~(np.diff(x[numbers, 0]) > 0.0))[0])
            raise ValueError(f"line {numbers[row + 1] + 2}: time does not increase")
    except ValueError as error:
        raise DataError(
            "this is no motion capture of the family",
            path=str(file),
            expected=f"at least 20 finite rows of {_COLUMNS}, times increasing",
            got=str(error),
            fix="restore the file",
        ) from error
    x = x[_stamped(x[:, 0], file, notes)]
    time = Series.from_seconds(x[:, 0], x[:, 0]).time
    time, x = present("truth", str(file), time, _finite(x[:, 1:]), notes, absent)
    q = np.asarray(quaternion_from_angles(x[:, 3:6], order="zxy", xp=np))
    truth = MotionTruth(position=x[:, :3], velocity=x[:, 6:9], attitude=q, rate=x[:, 9:12])
    return Series(time, truth, name="truth", gaps=True)


def derived_imu(truth: Series, window: float, rate: float = 100.0) -> Series:
    """The IMU (no bias, no noise of its own) that a motion capture implies, at `rate` Hz.

    specific force = R^T (d^2 p / dt^2 - g), and the rate is what turns R. Both come from parabolas fitted to
    `window` seconds around each time (Savitzky and Golay, Analytical Chemistry 36, 1964). Where the motion
    capture has no finite row for longer than that, and half a window on either side, there is none.
    """
    truth = truth[np.isfinite(truth["position"]).all(axis=1)]
    step = round(1e9 / rate)
    time = np.arange(truth.time[0], truth.time[-1] + 1, step)
    size = max(round(window * rate) | 1, 5)
    position = np.stack([np.interp(time, truth.time, truth["position"][:, k]) for k in range(3)], axis=1)
    acceleration = scipy.signal.savgol_filter(position, size, 2, deriv=2, delta=1.0 / rate, axis=0)
    measured = scipy.spatial.transform.Rotation.from_quat(truth["attitude"][:, [1, 2, 3, 0]])
    turns = scipy.spatial.transform.Slerp(truth.time - truth.time[0], measured)(time - truth.time[0])
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec() * rate
    between = scipy.signal.savgol_filter(steps, size, 2, axis=0)
    gyro = np.concatenate([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
    force = turns.inv().apply(acceleration - np.asarray(GRAVITY))
    imu = Series(time, Imu(gyro=gyro, specific_force=force), name="imu")
    blind = np.flatnonzero(np.diff(truth.time) > round(window * 1e9))
    half = round(0.5 * window * 1e9)
    for k in blind.tolist():
        imu = imu[(imu.time <= truth.time[k] - half) | (imu.time >= truth.time[k + 1] + half)]
    return imu
