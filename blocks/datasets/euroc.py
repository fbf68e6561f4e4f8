"""Flights of the EuRoC MAV dataset, read from its ASL folders with integer time stamps.

    MH_01_easy/mav0/imu0/data.csv, sensor.yaml      t[ns], gyro xyz, specific force xyz
                    leica0/data.csv                 t[ns], position xyz of a prism
                    vicon0/data.csv                 t[ns], position xyz, quaternion wxyz
                    state_groundtruth_estimate0/data.csv
                                                    t[ns], p, q wxyz, v, gyro bias, accelerometer bias
    MH_01_easy/groundtruth.tum                      t[s], p, q xyzw (beside mav0 or in it)

Source: M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.shape import MOST_OFFSET, known, offset, policy, present
from flowgraph.blocks.datasets.tables import POLICIES, read_table
from flowgraph.blocks.geometry.rotations import conjugate, multiply
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu, NavigationState, Pose, Position
from flowgraph.data.files import text_of
from flowgraph.errors import DataError

__all__ = ["LEICA_LEVER", "SETTINGS", "load"]

LEICA_LEVER = (0.0749, -0.0185, -0.1201)
"""The Leica prism in the body, m, where the sequence has no leica0/sensor.yaml of its own."""

SETTINGS: Mapping[str, str] = {
    "imu.time_offset": "s, added to the stamps of imu0",
    "leica.time_offset": "s, added to the stamps of leica0 (-0.135 fits MH_01)",
    "vicon.time_offset": "s, added to the stamps of vicon0",
    "truth.time_offset": "s, added to the stamps of the ground truth",
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean. An offset is rounded to nanoseconds once."""

_RATES = (1e-3, 1e6)  # Hz

_NOISE = {
    "gyro": "gyroscope_noise_density",
    "accelerometer": "accelerometer_noise_density",
    "gyro_bias": "gyroscope_random_walk",
    "accelerometer_bias": "accelerometer_random_walk",
}


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a sequence: the streams `imu` (`Imu`) and, where their folders exist, `leica` (`Position`) and
    `vicon` (`Pose`). Aiding samples from before the first IMU sample are left out, and a note says how many.

    Args:
        argument: the sequence's folder, or its mav0.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight`. truth: `NavigationState` from state_groundtruth_estimate0, else `Pose` from
        groundtruth.tum, else None. info: `imu_noise` (`ImuNoise`), `imu_period_ns`, `leica_lever` (m, body),
        `vicon_lever` (m, body) and `vicon_mount` (quaternion, sensor to body), which is already
        taken out of the attitudes: they are the body's. `absent`: by stream, how many rows held NaN.

    Raises:
        DataError: a folder or file is missing, a row is malformed (file, line) or out of order, or no aiding
            sample is left within the IMU's span.
        DeclarationError: for a setting that is not usable.
        UnknownNameError: for a setting or policy that is not there; lists the valid ones.
    """
    given = settings or {}
    known(given, SETTINGS, "euroc")
    bad_time = policy(given, "euroc")
    offsets = {n.split(".")[0]: offset(given, n, "euroc") for n in SETTINGS if n.endswith(".time_offset")}
    mav = _find(Path(argument).expanduser())
    notes: list[str] = []

    def table(name: str, file: Path, columns: int, **more: Any) -> tuple[np.ndarray, np.ndarray]:
        time, numbers, said = read_table(file, columns=columns, bad_time=bad_time, gaps=True, **more)
        notes.extend(said)
        time, numbers = present(name, str(file), time, numbers, notes, absent)
        if offsets[name]:
            notes.append(f"{name}: stamps shifted by {offsets[name]} ns")
            reach = 2**63 - 1 - MOST_OFFSET * 10**9
            if not -reach <= time[0] <= time[-1] <= reach:
                raise DataError(
                    "shifted stamps do not fit 64 bits",
                    path=str(file),
                    expected=f"stamps between {-reach} and {reach} ns",
                    got=f"{time[0]} to {time[-1]} ns, shifted by {offsets[name]} ns",
                    fix=f"leave {name}.time_offset out, and mend the stamps",
                )
        return time + offsets[name], numbers

    absent: dict[str, int] = {}
    info: dict[str, Any] = {"absent": absent}
    time, u = table("imu", _need(mav / "imu0" / "data.csv", "the IMU's data"), 6)
    streams = {"imu": Series(time, Imu(gyro=u[:, :3], specific_force=u[:, 3:]), name="imu")}
    info["imu_noise"], info["imu_period_ns"] = _imu_info(mav / "imu0" / "sensor.yaml")
    first, last = time[0], time[-1]

    def aid(name: str, stamps: np.ndarray, values: Any) -> None:
        series = Series(stamps, values, name=name)
        kept = series[stamps >= first]
        if not len(kept) or kept.time[0] > last:
            raise DataError(
                f"no sample of {name} lies within the span of the imu",
                path=f"{mav}: {name}",
                expected=f"stamps from {first} to {last} ns",
                got=f"{stamps[0]} to {stamps[-1]} ns, with {name}.time_offset={offsets[name] / 1e9:g}"
                f" and imu.time_offset={offsets['imu'] / 1e9:g}",
                fix=f"check {name}.time_offset and imu.time_offset, which are in seconds",
            )
        early = len(series) - len(kept)
        if early:
            notes.append(f"{name}: {early} samples from before the first imu sample left out")
        streams[name] = kept

    if (mav / "leica0").is_dir():
        time, z = table("leica", _need(mav / "leica0" / "data.csv", "the prism's positions"), 3)
        aid("leica", time, Position(position=z))
        extrinsics = _extrinsics(mav / "leica0" / "sensor.yaml")
        info["leica_lever"] = extrinsics[0] if extrinsics else LEICA_LEVER
    if (mav / "vicon0").is_dir():
        time, z = table("vicon", _need(mav / "vicon0" / "data.csv", "the motion capture"), 7, quaternion=3)
        unmounted = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        info["vicon_lever"], info["vicon_mount"] = _extrinsics(mav / "vicon0" / "sensor.yaml") or unmounted
        to_sensor = conjugate(np.asarray(info["vicon_mount"]), xp=np)
        aid("vicon", time, Pose(position=z[:, :3], attitude=multiply(z[:, 3:], to_sensor, xp=np)))
    truth = None
    asl = mav / "state_groundtruth_estimate0" / "data.csv"
    tum = next((f for f in (mav / "groundtruth.tum", mav.parent / "groundtruth.tum") if f.is_file()), None)
    if asl.is_file():
        time, x = table("truth", asl, 16, quaternion=3)
        state = NavigationState(
            position=x[:, :3],
            attitude=x[:, 3:7],
            velocity=x[:, 7:10],
            gyro_bias=x[:, 10:13],
            accelerometer_bias=x[:, 13:16],
        )
        truth = Series(time, state, name="truth", gaps=True)
    elif tum is not None:
        time, x = table("truth", tum, 7, delimiter=None, seconds=True, quaternion=3)
        truth = Series(time, Pose(position=x[:, :3], attitude=x[:, [6, 3, 4, 5]]), name="truth", gaps=True)
    else:
        notes.append("no ground truth: no state_groundtruth_estimate0/data.csv and no groundtruth.tum")
    name = mav.parent.name if mav.name == "mav0" else mav.name
    return Flight(name=name, streams=streams, truth=truth, info=info, notes=tuple(notes))


def _find(folder: Path) -> Path:
    """The folder that holds imu0."""
    for mav in (folder / "mav0", folder):
        if (mav / "imu0").is_dir():
            return mav
    if folder.is_dir():
        inside = ", ".join(sorted(f.name for f in folder.iterdir())[:8])
        got = f"a folder with {inside or 'nothing in it'}"
    else:
        got = "no such folder"
    raise DataError(
        "this is no EuRoC sequence",
        path=str(folder),
        expected="a folder with mav0/imu0 or imu0 in it",
        got=got,
        fix="give the sequence's folder (the one that holds mav0) or mav0 itself",
    )


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


_MOST_YAML = 2**20
"""Bytes of the description of a sensor."""


class _Loader(yaml.SafeLoader):
    """The safe loader, which takes OpenCV's matrices for the mappings that they are.

    It has no aliases, which a few lines could make stand for gigabytes.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it holds an alias")
        return super().compose_node(parent, index)


def _matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _yaml(file: Path) -> dict[str, Any]:
    try:
        text = text_of(file, most=_MOST_YAML)
        if text.startswith("%YAML:"):  # as OpenCV writes it; YAML itself has a space there
            text = text.partition("\n")[2]
        content = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise DataError(
            "this is not readable as YAML",
            path=str(file),
            expected="a mapping, as EuRoC's sensor.yaml",
            got=(str(error).splitlines() or [type(error).__name__])[0][:300],
            fix="restore the file of the sequence",
        ) from error
    if not isinstance(content, dict):
        raise DataError(
            "this is no sensor description",
            path=str(file),
            expected="a mapping, as EuRoC's sensor.yaml",
            got=type(content).__name__,
            fix="restore the file of the sequence",
        )
    return content


def _number(content: Mapping[str, Any], name: str, file: Path) -> float:
    value = content.get(name)
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # type: ignore[arg-type]  # YAML 1.1 reads 1e-4 as a string
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number) or number <= 0.0:
        raise DataError(
            f"{name!r} is missing or not a positive number",
            path=str(file),
            expected=f"{name}: a positive number; of " + ", ".join([*_NOISE.values(), "rate_hz"]),
            got=reprlib.repr(value),
            fix="restore the file of the sequence",
        )
    return number


def _imu_info(file: Path) -> tuple[ImuNoise, int]:
    content = _yaml(_need(file, "the IMU's noise densities"))
    noise = ImuNoise(**{ours: _number(content, theirs, file) for ours, theirs in _NOISE.items()})
    rate = _number(content, "rate_hz", file)
    if not _RATES[0] <= rate <= _RATES[1]:
        raise DataError(
            "'rate_hz' is no rate of an IMU",
            path=str(file),
            expected=f"from {_RATES[0]:g} to {_RATES[1]:g} Hz",
            got=f"{rate:g}",
            fix="restore the file of the sequence",
        )
    return noise, round(1e9 / rate)


def _extrinsics(file: Path) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Where and how a sensor sits in the body, from T_BS: (position in m, quaternion sensor to body)."""
    if not file.is_file():
        return None
    content = _yaml(file)
    try:
        T = np.array(content["T_BS"]["data"], dtype=float).reshape(4, 4)
        if not (np.isfinite(T).all() and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3)):
            raise ValueError("its 3 x 3 part is no rotation")
        w, x, y, z = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)[[3, 0, 1, 2]].tolist()
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise DataError(
            "T_BS is missing or malformed",
            path=str(file),
            expected="T_BS: data: 16 numbers, a rigid transform, row by row",
            got=str(error),
            fix="restore the file of the sequence",
        ) from error
    return tuple(T[:3, 3].tolist()), (w, x, y, z)
