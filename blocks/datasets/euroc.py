"""Flights of the EuRoC MAV dataset, and of recorders that write folders of the same shape.

    MH_01_easy/mav0/imu0/data.csv, sensor.yaml      t[ns], gyro xyz, specific force xyz
                    leica0/data.csv                 t[ns], position xyz of a prism
                    vicon0/data.csv                 t[ns], position xyz, quaternion wxyz
                    state_groundtruth_estimate0/data.csv
                                                    t[ns], p, q wxyz, v, gyro bias, accelerometer bias
    MH_01_easy/groundtruth.tum                      t[s], p, q xyzw (beside mav0 or in it)

Stamps are read as integers, exactly. Of the relatives: mocap0 in place of vicon0, imu0.csv in place of a
folder, a truth of fewer columns, no sensor.yaml or Kalibr's, and quaternions with the scalar last where the
names of the columns say so.

Source: M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowgraph import Flight
from flowgraph.blocks.datasets.adjust import check_settings
from flowgraph.blocks.datasets.sensor_yaml import (
    UNMOUNTED,
    described,
    extrinsics,
    period_of,
    rigid,
    unit_noise,
)
from flowgraph.blocks.datasets.shape import (
    MEASURED_NOISE,
    NOISE_SETTINGS,
    Recording,
    chosen,
    known,
    measured_noise,
    policy,
    stream_settings,
)
from flowgraph.blocks.datasets.stamps import UNITS
from flowgraph.blocks.datasets.tables import POLICIES, read_table
from flowgraph.blocks.signals import Imu, NavigationState, Pose, Position
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["LEICA_LEVER", "SETTINGS", "load"]

LEICA_LEVER = (0.0749, -0.0185, -0.1201)
"""The Leica prism in the body, m, where the sequence has no leica0/sensor.yaml of its own."""

SETTINGS: Mapping[str, str] = {
    **stream_settings("imu", "leica", "vicon", "truth"),
    "time.unit": "of the stamps in the folders: ns if left out; " + ", ".join(UNITS),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
    **NOISE_SETTINGS,
    **MEASURED_NOISE,
}
"""The settings of `load` and what they mean. leica.time_offset=-0.135 fits MH_01."""

_READINGS = {"gyro": [0, 1, 2], "specific_force": [3, 4, 5]}
_POSE = {"position": [0, 1, 2], "attitude": [3, 4, 5, 6]}
_STATE = {**_POSE, "velocity": [7, 8, 9], "gyro_bias": [10, 11, 12], "accelerometer_bias": [13, 14, 15]}
_TRUTHS = ("state_groundtruth_estimate0", "ground_truth0", "groundtruth0", "gt0")


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a sequence: the streams `imu` (`Imu`) and, where their folders exist, `leica` (`Position`) and
    `vicon` (`Pose`). Aiding samples from before the first IMU sample are left out, and a note says how many.

    Args:
        argument: the sequence's folder, or its mav0.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight`. truth: by the columns of state_groundtruth_estimate0 a `NavigationState`, `Pose` or
        `Position`, else `Pose` from groundtruth.tum, else None. info: `imu_noise` (`ImuNoise`),
        `imu_period_ns`, `leica_lever` (m, body), `vicon_lever` (m, body) and `vicon_mount` (quaternion,
        sensor to body), which is already taken out of the attitudes: they are the body's. The body's axes are
        those that T_BS of imu0 turns the readings into, its origin is the IMU. `absent`: by stream, how many
        rows held NaN.

    Raises:
        DataError: a folder or file is missing, a row is malformed (file, line) or out of order, stamps or
            units cannot be, or no aiding sample is left within the IMU's span.
        DeclarationError: for a setting that is not usable.
        UnknownNameError: for a setting or policy that is not there; lists the valid ones.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "euroc")
    unit = chosen({"time.unit": "ns", **given}, "time.unit", list(UNITS), "euroc")
    check_settings(given, "euroc")
    mav, imu0 = _find(Path(argument).expanduser())
    name = mav.parent.name if mav.name == "mav0" else mav.name
    made = Recording(
        name, policy(given, "euroc"), kind="euroc", given=given, unit=unit, begins="imu", place=str(mav)
    )
    info = made.info

    def add(stream: str, file: Path, fields: Mapping[str, list[int]], signal: Any, **more: Any) -> None:
        lines: list[int] = []
        width = more.pop("width", max(map(max, fields.values())) + 1)
        reading = {k: more.pop(k, v) for k, v in (("unit", unit), ("delimiter", ","))}
        time, x, said = read_table(file, columns=width, gaps=True, lines=lines, **reading)
        made.notes.extend(said)
        columns = {field: x[:, part] for field, part in fields.items()}
        made.add(stream, str(file), time, columns, signal, row=lambda k: f"{file}, line {lines[k]}", **more)

    found = described(mav, imu0)
    at, turn = UNMOUNTED
    if found is not None and "T_BS" in found[1]:
        at, turn = rigid(found[1]["T_BS"], found[0])
    as_it_is = turn == UNMOUNTED[1]
    if not as_it_is:
        made.notes.append(note("info", "imu: readings turned into the body's axes by T_BS of imu0"))
    table = _need(imu0 if imu0.is_file() else imu0 / "data.csv", "the IMU's data")
    add("imu", table, _READINGS, Imu, mount=None if as_it_is else turn)
    info["imu_noise"] = unit_noise(found, given, made.notes)
    info["imu_period_ns"] = period_of(found, made.streams["imu"].time, made.notes)
    if any(at):
        place = ", ".join(f"{x:g}" for x in at)
        made.notes.append(note("info", f"imu: sits at ({place}) m in the body by T_BS; levers are from it"))
    leica, vicon = mav / "leica0", _motion_capture(mav, made.notes)
    if leica.is_dir():
        add("leica", _need(leica / "data.csv", "the prism's positions"), {"position": [0, 1, 2]}, Position)
        placed = extrinsics(leica / "sensor.yaml")
        info.setdefault("leica_lever", _from(placed[0] if placed else LEICA_LEVER, at))
    if vicon is not None:
        lever, mount = extrinsics(vicon / "sensor.yaml") or UNMOUNTED
        data = _need(vicon / "data.csv", "the motion capture")
        add("vicon", data, _POSE, Pose, mount=mount, scalar_last=_scalar_last(data, made.notes))
        info.setdefault("vicon_lever", _from(lever, at))
        info.setdefault("vicon_mount", mount)
    asl = next((f for n in _TRUTHS if (f := mav / n / "data.csv").is_file()), None)
    tum = next((f for f in (mav / "groundtruth.tum", mav.parent / "groundtruth.tum") if f.is_file()), None)
    if asl is not None:
        width, fields, signal = _truth_of(asl, made.notes)
    elif tum is not None:
        width, fields, signal = 7, _POSE, Pose
    if (asl or tum) is None:
        made.notes.append(note("info", f"no ground truth: no {_TRUTHS[0]}/data.csv and no groundtruth.tum"))
    else:
        if any(at) and "attitude" in fields:
            made.given.setdefault("truth.lever", [-x for x in at])
        how: dict[str, Any] = {"unit": "s", "delimiter": None, "scalar_last": True}
        if asl is not None:
            how = {"scalar_last": "attitude" in fields and _scalar_last(asl, made.notes)}
        add("truth", asl or tum, fields, signal, width=width, **how)  # type: ignore[arg-type]
    measured_noise(given, "euroc", info)
    _passed_over(mav, {imu0, leica, vicon, asl and asl.parent}, made.notes)
    return made.flight()


def _find(folder: Path) -> tuple[Path, Path]:
    """The folder that holds the sensors', and the IMU's: imu0, whatever its case, or a table imu0.csv."""
    for mav in (folder / "mav0", folder):
        if (mav / "imu0").is_dir():
            return mav, mav / "imu0"
        inside = sorted(mav.iterdir()) if mav.is_dir() else []
        for name in ("imu0", "imu", "imu0.csv", "imu.csv"):
            for found in inside:
                if found.name.lower() == name and (found.is_file() or (found / "data.csv").is_file()):
                    return mav, found
    if folder.is_dir():
        inside_it = ", ".join(sorted(f.name for f in folder.iterdir())[:8])
        got = f"a folder with {inside_it or 'nothing in it'}"
    else:
        got = "no such folder"
    raise DataError(
        "this is no EuRoC sequence",
        path=str(folder),
        expected="a folder with mav0/imu0 or imu0 in it",
        got=got,
        fix="give the sequence's folder (the one that holds mav0) or mav0 itself",
    )


def _motion_capture(mav: Path, notes: list[str]) -> Path | None:
    """The folder of the stream vicon."""
    if (mav / "vicon0").is_dir():
        return mav / "vicon0"
    if (mav / "mocap0").is_dir():
        notes.append(note("assumed", "mocap0 is the stream vicon"))
        return mav / "mocap0"
    return None


def _names(file: Path) -> list[str]:
    """The names that the first row gives the columns, without their units; none where it has numbers."""
    with file.open(encoding="utf-8-sig", errors="replace") as text:
        first = next((line for line in text if line.strip()), "")
    cells = [re.sub(r"[\[(].*", "", c).strip().lower() for c in first.lstrip("#").strip().split(",")]
    return cells if not any(re.fullmatch(r"[-+\d.e]+", c) for c in cells) else []


def _scalar_last(file: Path, notes: list[str]) -> bool:
    """Whether the names of a table's columns say that its quaternions are x, y, z, w."""
    ends = [re.sub(r".*?_?q_?(?:rs_)?([wxyz])$", r"\1", n) for n in _names(file)][4:8]
    last = ends == ["x", "y", "z", "w"]
    if last:
        notes.append(note("info", f"{file.parent.name}: quaternions with the scalar last, by their names"))
    return last


def _truth_of(file: Path, notes: list[str]) -> tuple[int, Mapping[str, list[int]], Any]:
    """How many numbers follow the stamp of a truth, and what they are."""
    with file.open(encoding="utf-8-sig", errors="replace") as text:
        rows = (line.strip() for line in text)
        row = next((line for line in rows if re.match(r"[-+]?\d", line)), "")
    width = len(row.rstrip(",").split(",")) - 1
    if width in (3, 7, 10):
        what = "positions" if width == 3 else "poses"
        notes.append(note("info", f"truth: {what}, of a table of {width + 1} columns"))
    if width == 3:
        return 3, {"position": [0, 1, 2]}, Position
    if width == 10:
        notes.append(note("skipped", "truth: the velocities, for want of biases beside them"))
    if width in (7, 10):
        return width, _POSE, Pose
    if row and width != 16:
        raise DataError(
            "wrong number of columns",
            path=str(file),
            expected="17 (stamp, position, quaternion, velocity, both biases), 11 (no biases), 8 (poses) or "
            "4 (positions)",
            got=f"{width + 1}: {row[:60]!r}",
            fix="restore the file, or leave out what is beyond the pose",
        )
    return 16, _STATE, NavigationState


def _from(lever: tuple[float, ...], at: tuple[float, ...]) -> tuple[float, ...]:
    """A lever from the inertial unit in place of the body's origin."""
    return tuple(x - o for x, o in zip(lever, at, strict=True)) if any(at) else lever


def _passed_over(mav: Path, used: set[Path | None], notes: list[str]) -> None:
    """A note on the folders that are not read."""
    folders = {*mav.iterdir()} - {f for f in used if f is not None}
    rest = sorted(f.name for f in folders if f.is_dir() and (f / "data.csv").is_file())
    if rest:
        notes.append(note("skipped", f"{', '.join(rest)}: not read"))


def _need(file: Path, what: str) -> Path:
    if not file.is_file():
        raise DataError(
            f"{file.name} is missing",
            path=str(file),
            expected=f"a file with {what}",
            got="no such file",
            fix="unpack the whole sequence, or give another folder",
        )
    return file
