"""What a recorder writes of its sensors: sensor.yaml of the ASL folders, and Kalibr's file of an IMU.

T_BS: {rows: 4, cols: 4, data: [...]}       sensor to body; data, a flat list or four rows
rate_hz: 200                                update_rate in Kalibr's
gyroscope_noise_density: 1.7e-4             and gyroscope_random_walk, accelerometer_...
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are used
import yaml

from flowgraph.blocks.datasets.settings import NOISE_SETTINGS, imu_noise, number
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.data.files import text_of
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["UNMOUNTED", "described", "extrinsics", "period_of", "rigid", "unit_noise"]

UNMOUNTED: tuple[tuple[float, ...], tuple[float, ...]] = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
"""A sensor whose frame is the body's: position, and quaternion to the body."""

_RATES = (1e-3, 1e6)  # Hz
_RATE_NAMES = ("rate_hz", "update_rate")

_NOISE = {
    "gyro": "gyroscope_noise_density",
    "accelerometer": "accelerometer_noise_density",
    "gyro_bias": "gyroscope_random_walk",
    "accelerometer_bias": "accelerometer_random_walk",
}


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


def described(folder: Path, imu: Path) -> tuple[Path, dict[str, Any]] | None:
    """What is said of the inertial unit: by its sensor.yaml, or by a file of Kalibr beside; None for nothing.

    Args:
        folder: that holds the sensors' folders.
        imu: the unit's folder, or its table.

    Raises:
        DataError: for a file that is not readable.
    """
    names = ("imu0.yaml", "imu.yaml", "kalibr_imu.yaml", "imu_config.yaml")
    files = [imu / "sensor.yaml", *(at / n for at in (imu, folder, folder.parent) for n in names)]
    file = next((f for f in files if f.is_file()), None)
    if file is None:
        return None
    content = _yaml(file)
    inside = content.get("imu0", content)
    return file, inside if isinstance(inside, dict) else content


def _number(content: Mapping[str, Any], name: str, file: Path) -> float:
    value = content.get(name)
    try:
        number = math.nan if isinstance(value, bool) else float(value)  # type: ignore[arg-type]  # YAML 1.1 reads 1e-4 as a string
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number) or number <= 0.0:
        raise DataError(
            f"{name!r} is missing or not a positive number",
            path=str(file),
            expected=f"{name}: a positive number; of " + ", ".join([*_NOISE.values(), "rate_hz"]),
            got=repr(value),
            fix="restore the file of the sequence"
            + (f", or say it with {_setting(name)}" * (name in _NOISE.values())),
        )
    return number


def _setting(name: str) -> str:
    """The setting that says what the file calls `name`."""
    return dict(zip(_NOISE.values(), NOISE_SETTINGS, strict=True)).get(name, "")


def unit_noise(
    found: tuple[Path, dict[str, Any]] | None, given: Mapping[str, Any], notes: list[str]
) -> ImuNoise:
    """The unit's noise: from the settings, else from its file, else a typical unit's, and a note says so.

    Raises:
        DataError: where the file lacks a density that no setting gives.
    """
    densities = () if found is None else [n for n in _NOISE.values() if n in found[1]]
    if found is None or (not densities and found[0].name != "sensor.yaml"):
        return imu_noise(given, "euroc", notes)
    file, content = found
    said = [s for s in NOISE_SETTINGS if s in given]
    if said:
        notes.append(note("info", f"imu: {', '.join(said)} as set, in place of what {file.name} says"))
    by_name = dict(zip(_NOISE, NOISE_SETTINGS, strict=True))
    return ImuNoise(
        **{
            ours: number(given, by_name[ours], 0.0, "euroc")
            if by_name[ours] in given
            else _number(content, theirs, file)
            for ours, theirs in _NOISE.items()
        }
    )


def period_of(found: tuple[Path, dict[str, Any]] | None, time: np.ndarray, notes: list[str]) -> int:
    """The unit's period in ns: by its file, else the median step of its stamps (n,).

    Raises:
        DataError: for a rate that is none.
    """
    step = int(np.median(np.diff(time))) if len(time) > 1 else 0
    name = next((n for n in _RATE_NAMES if found is not None and n in found[1]), None)
    if found is None or (name is None and found[0].name != "sensor.yaml"):
        return step
    file, content = found
    rate = _number(content, name or "rate_hz", file)
    if not _RATES[0] <= rate <= _RATES[1]:
        raise DataError(
            f"{name!r} is no rate of an IMU",
            path=str(file),
            expected=f"from {_RATES[0]:g} to {_RATES[1]:g} Hz",
            got=f"{rate:g}",
            fix="restore the file of the sequence",
        )
    if step and len(time) > 10 and not 0.9 < step * rate / 1e9 < 1.1:
        sentence = f"imu: {file.name} says {rate:g} Hz, and its stamps come at {1e9 / step:.4g} Hz"
        notes.append(note("warning", sentence))
    return round(1e9 / rate)


def extrinsics(file: Path) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Where and how a sensor sits in the body, from T_BS: (position in m, quaternion sensor to body).

    Raises:
        DataError: where the file has no such transform.
    """
    return rigid(_yaml(file).get("T_BS"), file) if file.is_file() else None


def rigid(transform: Any, file: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Position (m) and quaternion of a transform that a file gives: a mapping with `data`, or the numbers.

    Raises:
        DataError: where it is no rigid transform.
    """
    try:
        numbers = transform["data"] if isinstance(transform, Mapping) else transform
        T = np.array(numbers, dtype=float).reshape(4, 4)
        R = T[:3, :3]
        if not (np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-3)):
            raise ValueError("its 3 x 3 part is no rotation")
        if np.linalg.det(R) < 0.0:
            raise ValueError("its 3 x 3 part mirrors, and is no rotation")
        if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0], atol=1e-6):
            raise ValueError("its last row is not 0, 0, 0, 1")
        w, x, y, z = (
            scipy.spatial.transform.Rotation.from_matrix(R).as_quat(canonical=True)[[3, 0, 1, 2]].tolist()
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            "T_BS is missing or malformed",
            path=str(file),
            expected="T_BS: data: 16 numbers, a rigid transform, row by row",
            got=str(error),
            fix="restore the file of the sequence",
        ) from error
    return tuple(T[:3, 3].tolist()), (w, x, y, z)
