"""Data of NaveGo, `.mat`: structs of an inertial unit, of satellites and of a reference.

    unit        t (s), wb (n, 3, rad/s), fb (n, 3, m/s^2) of forward, right, down; perhaps arw, vrw, the
                densities of its noise
    satellites  t, lat, lon (rad), h (m), stdm (m, of north, east, down); perhaps vel (n, 3, m/s, of north,
                east, down), stdv, and larm, where the antenna sits (m, forward, right, down)
    reference   t, lat, lon (rad), h (m), roll, pitch, yaw (rad)

    navego:PATH[:IMU]

Structs are told by their fields, whatever their names, in a file or in all files of a folder; of several
units IMU names one. Axes are turned into forward, left, up, and east, north, up about the first fix. The
reference is the truth.

Source: R. Gonzalez, J. Giribet, H. Patino, "NaveGo: a simulation framework for low-cost integrated navigation
systems", CEAI 17(2), 2015, and its functions.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.matfile import columns_of, read_structs
from flowgraph.blocks.datasets.places import (
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

_TOLD: Mapping[str, tuple[str, ...]] = {
    "unit": ("t", "wb", "fb"),
    "reference": ("t", "lat", "lon", "h", "roll", "pitch", "yaw"),
    "satellites": ("t", "lat", "lon", "h"),
}
"""The fields by which a struct is told, the first that fits."""

_Part = tuple[str, Path, Mapping[str, Any]]


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read `imu`, and what there is of `gps` (`GnssFix`) and `gps_velocity`; truth: `Pose`.

    Args:
        argument: PATH[:IMU], a file or a folder of them, and the name of the unit's struct.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: the file is missing or broken, there is no unit or there are several, or a field has
            another shape; values cannot be of their unit. UnknownNameError: for a setting.
    """
    given: dict[str, Any] = dict(settings or {})
    known(given, SETTINGS, "navego")
    path, unit = split_argument(argument, "navego:PATH[:IMU]")
    found = _structs(path)
    made = Recording(path.stem, policy(given, "navego"), kind="navego", given=given, place=str(path))
    name, file, imu = _unit(found["unit"], path, None if unit is None else str(unit))
    time = _time(imu, file)
    gyro, force = (from_frd(columns_of(imu, n, file, 3)) for n in ("wb", "fb"))
    made.add("imu", f"{file}: {name}", time, {"gyro": gyro, "specific_force": force}, Imu)
    origin = None
    if found["satellites"]:
        name, file, gps = _only(found["satellites"], path, "struct of satellites")
        origin = _satellites(made, given, f"{file}: {name}", file, gps)
    if found["reference"]:
        name, file, truth = _only(found["reference"], path, "reference")
        places = _places(truth, file)
        angles = np.stack([columns_of(truth, n, file) for n in ("roll", "pitch", "yaw")], axis=1)
        origin = origin or tuple(places[0].tolist())
        add_solution(made, f"{file}: {name}", _time(truth, file), places, angles, origin, None)
    _densities(given, imu, made.notes)
    made.info["imu_noise"] = imu_noise(given, "navego", made.notes)
    return made.flight()


def _structs(path: Path) -> dict[str, list[_Part]]:
    """What there is of each kind, in all files."""
    files = sorted(path.glob("*.mat")) if path.is_dir() else [path]
    found: dict[str, list[_Part]] = {kind: [] for kind in _TOLD}
    for file in files:
        for name, value in read_structs(file).items():
            if isinstance(value, Mapping):
                kind = next((k for k, fields in _TOLD.items() if set(fields) <= set(value)), None)
                if kind is not None:
                    found[kind].append((name, file, value))
    return found


def _unit(units: list[_Part], path: Path, wanted: str | None) -> _Part:
    """The unit that is wanted."""
    chosen = [u for u in units if wanted in (None, u[0])]
    return _only(chosen if units else [], path, "unit", ", ".join(u[0] for u in units))


def _only(parts: list[_Part], path: Path, what: str, there: str = "") -> _Part:
    """The one that there is.

    Raises:
        DataError: where there is none, or are several.
    """
    if len(parts) == 1:
        return parts[0]
    raise DataError(
        f"there is no one {what}" if parts or there else "these are no data of NaveGo",
        path=str(path),
        expected=f"one {what}" if parts else "a struct with " + ", ".join(_TOLD["unit"]),
        got=", ".join(p[0] for p in parts) or there or "none in " + (path.name or "it"),
        fix="name the unit, navego:PATH:IMU" if there else "choose the file that holds it",
    )


def _time(part: Mapping[str, Any], file: Path) -> np.ndarray:
    return np.round(columns_of(part, "t", file) * 1e9).astype(np.int64)


def _places(part: Mapping[str, Any], file: Path) -> np.ndarray:
    return np.stack([columns_of(part, n, file) for n in ("lat", "lon", "h")], axis=1)


def _satellites(
    made: Recording, given: Mapping[str, Any], place: str, file: Path, gps: Mapping[str, Any]
) -> tuple[float, ...]:
    """Fixes, velocities and the antenna; returns the first fix."""
    time, places = _time(gps, file), _places(gps, file)
    degrees = np.concatenate([np.degrees(places[:, :2]), places[:, 2:]], axis=1)
    add_fixes(made, place, time, degrees, _worth(gps, "stdm", len(time), file), radians=places[:, :2])
    if "vel" in gps:
        velocity = from_ned(columns_of(gps, "vel", file, 3))
        add_velocities(made, place, time, velocity, _worth(gps, "stdv", len(time), file))
    if "larm" in gps and "gps.lever" not in given:
        lever = from_frd(np.ravel(columns_of(gps, "larm", file)))
        made.info["gps_lever"] = tuple(lever.tolist())
        made.notes.append(
            note("info", "gps: the antenna sits at (" + ", ".join(f"{x:g}" for x in lever) + ") m")
        )
    return tuple(places[0].tolist())


def _worth(gps: Mapping[str, Any], name: str, count: int, file: Path) -> np.ndarray:
    """Covariances (n, 3, 3), east, north, up, of deviations north, east, down, one for all or a row each;
    zeros where none are told."""
    if name not in gps:
        return np.zeros((count, 3, 3))
    told = columns_of(gps, name, file, 3)
    return np.broadcast_to(diagonal(told[:, [1, 0, 2]]), (count, 3, 3))


def _densities(given: dict[str, Any], imu: Mapping[str, Any], notes: list[str]) -> None:
    """White noise as the unit's struct tells it, where no setting does."""
    for setting, name in (("gyro.noise", "arw"), ("accelerometer.noise", "vrw")):
        told = float(np.mean(np.asarray(imu.get(name, 0.0), dtype=float)))
        if setting not in given and np.isfinite(told) and told > 0.0:
            given[setting] = told
            notes.append(note("info", f"imu: {setting}={told:.3g}, as its {name} says"))
