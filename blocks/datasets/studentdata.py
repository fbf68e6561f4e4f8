"""Flights of the course: studentdataN.mat, IMU and AprilTag corners in packets, motion capture beside.

    studentdata:FILE[:PARAMETERS]     PARAMETERS is a parameters.txt; the course's own if left out

    data   packets: img, id, p1..p4 (2 x n px: bottom-left, bottom-right, top-right, top-left), t, rpy, omg,
    acc time   stamps of vicon, s
    vicon  rows x y z roll pitch yaw vx vy vz wx wy wz, one column a stamp, 100 Hz

Files differ, and this is what they do: a file may have `drpy` in place of `omg`; a packet with one tag has a
plain number as `id` and corners of one axis; a packet without tags has empty arrays, or no such fields; a
file of one packet holds a struct in place of an array of structs; the first packets may precede the first row
of vicon; stamps may repeat. The angles of vicon are Z-X-Y, its rates are taken as those of the body.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.matfile import read_structs
from flowgraph.blocks.datasets.parameters import Parameters, parse_parameters
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    chosen,
    imu_noise,
    known,
    number,
    split_argument,
    stream_settings,
)
from flowgraph.blocks.datasets.tables import strictly_later
from flowgraph.blocks.geometry.euler import quaternion_from_angles
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu, MotionTruth
from flowgraph.blocks.vision.camera import Camera
from flowgraph.blocks.vision.pnp import measure
from flowgraph.blocks.vision.tags import tags_series
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["NOISE", "SETTINGS", "load", "packet_tags", "packets", "vicon_rows"]

SETTINGS: Mapping[str, str] = {
    "images": "auto, raw or rectified: whether corners are of distorted images; auto takes what fits better",
    "most_tags": "room for tags in an image",
    **NOISE_SETTINGS,
    **stream_settings("imu", "tags", "truth", only=("time_offset", "every")),
}
"""The settings of `load` and what they mean."""

NOISE = ImuNoise(gyro=0.01, accelerometer=0.1, gyro_bias=5e-4, accelerometer_bias=5e-3)
"""Densities for the course's quadrotor, whose frame vibrates."""

_CORNERS = ("p1", "p2", "p3", "p4")


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a flight: the streams `imu` (`Imu`) and, where any packet has tags, `tags` (`Tags`).

    Args:
        argument: FILE[:PARAMETERS].
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight`; truth: `MotionTruth`, in which the packets before and after are not covered. info:
        `camera` (rectified, if the images are), `mount`, `tag_map`, `imu_noise`.

    Raises:
        DataError: file or variable missing, or a packet malformed; names file and packet (counted from 1).
        DeclarationError, UnknownNameError: for settings.
    """
    file, beside = split_argument(argument, "studentdata:FILE[:PARAMETERS]")
    content = read_structs(file, "data", "time", "vicon")
    parameters = Parameters.of_the_course() if beside is None else parse_parameters(beside)
    return flight_of(content, parameters, file, settings or {})


def flight_of(
    content: Mapping[str, Any],
    parameters: Parameters,
    file: Path,
    given: Mapping[str, str | float],
    noise: ImuNoise | None = None,
) -> Flight:
    """The flight of the variables `data`, `time` and `vicon`; `file` is what messages call them.

    The unit's noise is `noise` where it is known.
    """
    known(given, SETTINGS, "studentdata")
    images = chosen(given, "images", ("auto", "raw", "rectified"), "studentdata")
    made = Recording(file.stem, kind="studentdata", given=given, place=str(file))
    notes = made.notes
    notes += parameters.notes
    found = packets(content["data"], file)
    room = int(number(given, "most_tags", 108, "studentdata", positive=True))
    seconds = np.array([_numbers(p, "t", 1, file, k)[0] for k, p in enumerate(found, start=1)])
    rate_name = "omg" if "omg" in found[0] else "drpy"
    if rate_name == "drpy":
        notes.append(note("assumed", f"{file.name}: drpy is taken for omg"))
    gyro = np.array([_numbers(p, rate_name, 3, file, k) for k, p in enumerate(found, start=1)])
    force = np.array([_numbers(p, "acc", 3, file, k) for k, p in enumerate(found, start=1)])
    frames = [packet_tags(p, f"{file}: data, packet {k}") for k, p in enumerate(found, start=1)]
    for k, (ids, _) in enumerate(frames, start=1):
        if len(ids) > room:
            raise DataError(
                "a packet has more tags than there is room for",
                path=f"{file}: data, packet {k}",
                expected=f"at most {room}",
                got=str(len(ids)),
                fix="raise most_tags",
            )
    keep, more = strictly_later(seconds, "data", file)
    notes += more
    imu = Series.from_seconds(seconds[keep], Imu(gyro=gyro[keep], specific_force=force[keep]), name="imu")
    made.take(imu, f"{file}: data")
    kept = [f for f, k in zip(frames, keep, strict=True) if k]
    camera = parameters.camera
    if any(len(ids) for ids, _ in kept):
        made.take(tags_series(imu.time, kept, room=room), f"{file}: data")
        camera, said = _camera(images, parameters, kept)
        notes.append(note("info" if images != "auto" else "assumed", said))
    else:
        notes.append(note("info", f"{file.name}: no packet has tags"))
    truth, more = _truth(content, file)
    notes += more
    made.take(truth, f"{file}: vicon")
    early = int((made.streams["imu"].time < truth.time[0]).sum())
    if early:
        notes.append(note("info", f"{file.name}: {early} packets precede the first row of vicon"))
    made.info.update(
        camera=camera,
        mount=parameters.mount,
        tag_map=parameters.tag_map,
        imu_noise=imu_noise(given, "studentdata", notes, NOISE) if noise is None else noise,
    )
    return made.flight()


def packets(data: Any, file: Path) -> list[dict[str, Any]]:
    """The packets of a `data` variable, whether it holds one or many.

    Raises:
        DataError: when they are not structs.
    """
    listed = [data] if isinstance(data, dict) else list(np.atleast_1d(np.asarray(data, dtype=object)))
    if not listed or not all(isinstance(p, dict) for p in listed):
        raise DataError(
            "'data' holds no packets",
            path=str(file),
            expected="a struct array with the fields id, p1..p4, t, omg, acc",
            got=f"{len(listed)} elements" + (f", the first {type(listed[0]).__name__}" if listed else ""),
            fix="this may be a file of another family",
        )
    return listed


def packet_tags(packet: Mapping[str, Any], where: str) -> tuple[np.ndarray, np.ndarray]:
    """The ids (k,) and corners (k, 4, 2) of a packet, bottom-left first; none where it has no tags.

    Raises:
        DataError: when the corners do not fit the ids, or a number is not finite.
    """
    ids = np.atleast_1d(np.asarray(packet.get("id", []))).ravel()
    if not ids.size:
        return np.zeros(0, int), np.zeros((0, 4, 2))
    try:
        names = ids.astype(float)
        corners = np.stack([np.asarray(packet[n], dtype=float).reshape(2, ids.size) for n in _CORNERS])
        if not (np.isfinite(corners).all() and (names == np.round(names)).all()):
            raise ValueError("a number is not finite, or an id is not whole")
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            "the tags of a packet are malformed",
            path=where,
            expected=f"p1 to p4 of 2 x {ids.size} pixels, for {ids.size} ids",
            got=", ".join(f"{n}: {np.shape(packet[n])}" for n in _CORNERS if n in packet) + f" ({error})",
            fix="mend the packet, or leave it out",
        ) from error
    return names.astype(int), corners.transpose(2, 0, 1)


def _numbers(packet: Mapping[str, Any], name: str, size: int, file: Path, row: int) -> np.ndarray:
    try:
        x = np.asarray(packet[name], dtype=float).ravel()
        if x.size != size or not np.isfinite(x).all():
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise DataError(
            f"field {name!r} of a packet is missing or malformed",
            path=f"{file}: data, packet {row}",
            expected=f"{size} finite number{'s' * (size > 1)}",
            got=repr(packet.get(name, "no such field"))[:60],
            fix="mend the packet, or leave it out",
        ) from None
    return x


def vicon_rows(content: Mapping[str, Any], file: Path) -> tuple[np.ndarray, np.ndarray]:
    """The stamps (n,) in s and rows (n, 12) of the motion capture, whichever way the matrix lies.

    Raises:
        DataError: when stamps and rows do not fit.
    """
    try:
        seconds = np.asarray(content["time"], dtype=float).ravel()
        x = np.asarray(content["vicon"], dtype=float)
    except (TypeError, ValueError):
        seconds, x = np.zeros(0), np.zeros((0, 0))
    if x.ndim == 1:
        x = x[:, None]
    if x.ndim == 2 and x.shape[0] == 12:  # also where there are twelve stamps: a column is a stamp
        x = x.T
    if x.ndim != 2 or x.shape != (len(seconds), 12) or not len(seconds):
        raise DataError(
            "'vicon' does not fit 'time'",
            path=str(file),
            expected="12 rows, and a column for each stamp",
            got=f"vicon {np.shape(content['vicon'])}, time {np.shape(content['time'])}",
            fix="restore the file",
        )
    return seconds, x


def _truth(content: Mapping[str, Any], file: Path) -> tuple[Series, list[str]]:
    seconds, x = vicon_rows(content, file)
    finite = np.isfinite(x).all(axis=1) & np.isfinite(seconds)
    notes = (
        []
        if finite.all()
        else [note("skipped", f"{file.name}: {int((~finite).sum())} rows of vicon are not finite: left out")]
    )
    seconds, x = seconds[finite], x[finite]
    keep, more = strictly_later(seconds, "vicon", file)
    x = x[keep]
    truth = MotionTruth(
        position=x[:, :3],
        velocity=x[:, 6:9],
        attitude=np.asarray(quaternion_from_angles(x[:, 3:6], order="zxy", xp=np)),
        rate=x[:, 9:12],
    )
    return Series.from_seconds(seconds[keep], truth, name="truth"), notes + more


def _camera(images: str, parameters: Parameters, frames: list[Any]) -> tuple[Camera, str]:
    """The camera of the images, and a note on how well both readings of them reproject."""
    raw, rectified = parameters.camera, parameters.camera.rectified()
    rich = sorted((f for f in frames if len(f[0])), key=lambda f: -len(f[0]))[:400]
    sample = rich[:: max(len(rich) // 40, 1)]
    errors = {}
    for name, camera in (("raw", raw), ("rectified", rectified)):
        poses = [
            measure(i, c, tag_map=parameters.tag_map, camera=camera, mount=parameters.mount)
            for i, c in sample
        ]
        errors[name] = float(np.median([float(p.error) for p in poses if p is not None] or [np.inf]))
    chosen = min(errors, key=lambda name: errors[name]) if images == "auto" else images
    figures = ", ".join(f"{name} {error:.3f} px" for name, error in errors.items())
    said = f"images taken as {chosen}{' (asked for)' * (images != 'auto')}; reprojection as {figures}"
    return raw if chosen == "raw" else rectified, said
