"""The settings that loaders share: how they are read, and what is said of one that cannot be meant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowgraph.blocks.datasets.stamps import POLICIES, nanoseconds
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

__all__ = [
    "MEASURED_NOISE",
    "MOST_OFFSET",
    "NOISE_SETTINGS",
    "chosen",
    "imu_noise",
    "known",
    "measured_noise",
    "number",
    "offset",
    "policy",
    "split_argument",
    "the_file",
]

MOST_OFFSET = 1_000_000
"""The largest time offset in s, 11 days: clocks of one recording are not farther apart."""


def known(given: Mapping[str, Any], valid: Mapping[str, str], path: str) -> None:
    """Refuse a setting that a loader does not have; "STREAM.x" is the setting x of a stream of any name.

    Raises:
        UnknownNameError: listing the valid ones.
    """
    for name in given:
        if name not in valid and "STREAM." + str(name).rpartition(".")[2] not in valid:
            raise UnknownNameError("setting", name, valid, path=path)


def chosen(given: Mapping[str, Any], name: str, valid: Sequence[str], path: str) -> str:
    """The setting `name`, one of `valid`; the first where it is left out.

    Raises:
        UnknownNameError: listing the valid ones.
    """
    value = str(given.get(name, valid[0]))
    if value not in valid:
        raise UnknownNameError(name, value, valid, path=path)
    return value


def policy(given: Mapping[str, Any], path: str) -> str:
    """The setting `bad_time`."""
    return chosen(given, "bad_time", POLICIES, path)


def offset(given: Mapping[str, Any], name: str, path: str) -> int:
    """The setting `name`, seconds to add to stamps, in nanoseconds; 0 where it is left out.

    Raises:
        DeclarationError: when it is not a number, or beyond `MOST_OFFSET`.
    """
    value = given.get(name, 0)
    try:
        found = nanoseconds(str(value))
        if abs(found) > MOST_OFFSET * 10**9:
            raise ValueError
    except ValueError:
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path=path,
            expected=f"a number of seconds, at most {MOST_OFFSET} either way",
            got=repr(value),
            fix=f"for example {name}=-0.135",
        ) from None
    return found


def number(
    given: Mapping[str, Any],
    name: str,
    otherwise: float,
    path: str,
    *,
    positive: bool = False,
    signed: bool = False,
) -> float:
    """The setting `name`, a number below 1e9; `otherwise` where it is left out.

    Not below zero; with `positive` above it, and with `signed` as far either way.

    Raises:
        DeclarationError: when it is not one.
    """
    value = given.get(name, otherwise)
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = float("nan")
    if not (abs(found) < 1e9 and (signed or found > 0.0 or (found == 0.0 and not positive))):
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path=path,
            expected="a positive number" if positive else "a number" + ("" if signed else " not below zero"),
            got=repr(value),
            fix=f"for example {name}={otherwise:g}",
        )
    return found


def split_argument(argument: str, form: str) -> tuple[Path, Path | None]:
    """FILE and perhaps SECOND of "FILE[:SECOND]".

    Raises:
        DeclarationError: without a FILE.
    """
    first, _, second = argument.partition(":")
    if not first:
        raise DeclarationError(
            "which file?",
            path=form.partition(":")[0],
            expected=form,
            got=repr(argument),
            fix="name the file after the colon",
        )
    return Path(first).expanduser(), Path(second).expanduser() if second else None


NOISE_SETTINGS: Mapping[str, str] = {
    "gyro.noise": "white noise density of the gyroscope, rad/s/sqrt(Hz)",
    "accelerometer.noise": "white noise density of the accelerometer, m/s^2/sqrt(Hz)",
    "gyro.walk": "random walk of its bias, rad/s^2/sqrt(Hz)",
    "accelerometer.walk": "random walk of its bias, m/s^3/sqrt(Hz)",
}
"""For recordings that say nothing of their unit's noise."""

_TYPICAL = ImuNoise(gyro=2e-4, accelerometer=2e-3, gyro_bias=2e-5, accelerometer_bias=3e-3)


def imu_noise(
    given: Mapping[str, Any], path: str, notes: list[str], otherwise: ImuNoise = _TYPICAL
) -> ImuNoise:
    """The unit's noise from `NOISE_SETTINGS`; what is left out is that of `otherwise`, and a note says so."""
    usual = vars(otherwise)
    names = dict(
        zip(NOISE_SETTINGS, ("gyro", "accelerometer", "gyro_bias", "accelerometer_bias"), strict=True)
    )
    assumed = [f"{s}={usual[f]:g}" for s, f in names.items() if s not in given]
    if assumed:
        whose = "a typical unit" if otherwise is _TYPICAL else "the unit of such recordings"
        notes.append(note("assumed", f"imu: noise of {whose}: " + ", ".join(assumed)))
    return ImuNoise(**{f: number(given, s, usual[f], path) for s, f in names.items()})


MEASURED_NOISE: Mapping[str, str] = {
    "position.noise": "standard deviation of measured positions, m",
    "attitude.noise": "standard deviation of measured attitudes, rad",
}
"""For recordings that say nothing of what they measure with."""


def measured_noise(given: Mapping[str, Any], path: str, info: dict[str, Any]) -> None:
    """Put those of `MEASURED_NOISE` that are given into `info`."""
    for name in ("position", "attitude"):
        if f"{name}.noise" in given:
            info[f"{name}_noise"] = number(given, f"{name}.noise", 0.01, path)


def the_file(argument: str, *, kind: str, what: str, endings: tuple[str, ...] = ()) -> Path:
    """The file that a flight's argument names.

    Raises:
        DataError: when there is no such file, or its name ends otherwise.
    """
    file = Path(argument).expanduser()
    if not argument or not file.is_file() or (endings and file.suffix.lower() not in endings):
        got = (
            "a folder" if file.is_dir() and argument else "no such file" if not file.is_file() else file.name
        )
        raise DataError(
            f"this is no {what}",
            path=str(file) if argument else kind,
            expected=f"{kind}:FILE with a {what}" + (f" ({', '.join(endings)})" if endings else ""),
            got=got,
            fix="check the path",
        )
    return file
