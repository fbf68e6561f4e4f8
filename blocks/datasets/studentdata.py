"""Flights of the course: studentdataN.mat, IMU and AprilTag corners in packets, motion capture beside.

    studentdata:FILE[:PARAMETERS]     PARAMETERS is a parameters.txt; the course's own if left out

    data   packets: img, id, p1..p4 (2 x n px: bottom-left, bottom-right, top-right, top-left), t, rpy, omg,
    acc time   stamps of vicon, s
    vicon  rows x y z roll pitch yaw vx vy vz wx wy wz, one column a stamp, 100 Hz

Files differ, and this is what they do: a file may have `drpy` in place of `omg`; a packet with one tag has a
plain number as `id` and corners of one axis; a packet without tags has empty arrays, or no such fields; a
file of one packet holds a struct in place of an array of structs; the first packets may precede the first row
of vicon, of which some may be NaN, or there is no vicon; stamps may repeat. The angles of vicon are Z-X-Y,
its rates are taken as those of the body.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.malformed import MALFORMED, Records
from flowgraph.blocks.datasets.matfile import read_structs
from flowgraph.blocks.datasets.parameters import Parameters, parse_parameters
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
    **MALFORMED,
    **NOISE_SETTINGS,
    **stream_settings("imu", "tags", "truth", only=("time_offset", "every")),
}
"""The settings of `load` and what they mean."""

NOISE = ImuNoise(gyro=0.01, accelerometer=0.1, gyro_bias=5e-4, accelerometer_bias=5e-3)
"""Densities for the course's quadrotor, whose frame vibrates."""

_CORNERS = ("p1", "p2", "p3", "p4")
_MEND = "mend the packet, or leave it out: malformed=skip"


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a flight: the streams `imu` (`Imu`) and, where any packet has tags, `tags` (`Tags`).

    Args:
        argument: FILE[:PARAMETERS].
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight`; truth: `MotionTruth`, in which the packets before and after are not covered, and masked
        where a row of vicon is not finite; None without a motion capture. info:
        `camera` (rectified, if the images are), `mount`, `tag_map`, `imu_noise`.

    Raises:
        DataError: file or variable missing, or a packet malformed; names file and packet (counted from 1).
        DeclarationError, UnknownNameError: for settings.
    """
    file, beside = split_argument(argument, "studentdata:FILE[:PARAMETERS]")
    content = read_structs(file, "data", also=("time", "vicon"))
    parameters = Parameters.of_the_course() if beside is None else parse_parameters(beside)
    return flight_of(content, parameters, file, settings or {})


def flight_of(
    content: Mapping[str, Any],
    parameters: Parameters,
    file: Path,
    given: Mapping[str, str | float],
    noise: ImuNoise | None = None,
) -> Flight:
    """The flight of the variables `data` and, where there is one, of the motion capture, `time` and `vicon`;
    `file` is what messages call them.

    The unit's noise is `noise` where it is known.
    """
    known(given, SETTINGS, "studentdata")
    images = chosen(given, "images", ("auto", "raw", "rectified"), "studentdata")
    made = Recording(file.stem, kind="studentdata", given=given, place=str(file))
    notes = made.notes
    notes += parameters.notes
    found = packets(content["data"], file)
    room = int(number(given, "most_tags", 108, "studentdata", positive=True))
    rate_name = "omg" if any("omg" in p for p in found) else "drpy"
    if rate_name == "drpy":
        notes.append(note("assumed", f"{file.name}: drpy is taken for omg"))
    records = Records(given, "studentdata")
    times: list[float] = []
    readings: list[np.ndarray | None] = []
    frames: list[Any] = []
    for k, packet in enumerate(found, start=1):
        stamp = records.read(_numbers, packet, ("t",), 1, file, k)
        if stamp is None:
            continue
        times.append(stamp[0])
        readings.append(records.read(_numbers, packet, (rate_name, "acc"), 3, file, k))
        frames.append(records.read(_tags, packet, room, file, k))
    notes += records.said(file.name, len(found))
    seconds = np.array(times)
    keep, more = strictly_later(seconds, "data", file)
    notes += more
    rows = [k for k in np.flatnonzero(keep).tolist() if readings[k] is not None]
    read = np.array([readings[k] for k in rows]).reshape(-1, 6)
    imu = Imu(gyro=read[:, :3], specific_force=read[:, 3:])
    made.take(Series.from_seconds(seconds[rows], imu, name="imu"), f"{file}: data")
    rows = [k for k in np.flatnonzero(keep).tolist() if frames[k] is not None]
    camera = parameters.camera
    if any(len(frames[k][0]) for k in rows):
        kept = [frames[k] for k in rows]
        stamps = Series.from_seconds(seconds[rows], seconds[rows]).time
        made.take(tags_series(stamps, kept, room=room), f"{file}: data")
        camera, said = _camera(images, parameters, kept)
        notes.append(note("info" if images != "auto" else "assumed", said))
    else:
        notes.append(note("info", f"{file.name}: no packet has tags"))
    truth = _truth(content, file, made)
    if truth is None:
        notes.append(note("info", f"{file.name}: no motion capture, and no score"))
    else:
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
            fix=_MEND,
        ) from error
    return names.astype(int), corners.transpose(2, 0, 1)


def _tags(packet: Mapping[str, Any], room: int, file: Path, row: int) -> tuple[np.ndarray, np.ndarray]:
    """`packet_tags`, for which there is room."""
    where = f"{file}: data, packet {row}"
    ids, corners = packet_tags(packet, where)
    if len(ids) > room:
        raise DataError(
            "a packet has more tags than there is room for",
            path=where,
            expected=f"at most {room}",
            got=str(len(ids)),
            fix="raise most_tags",
        )
    return ids, corners


def _numbers(
    packet: Mapping[str, Any], names: tuple[str, ...], size: int, file: Path, row: int
) -> np.ndarray:
    """The numbers of these fields, `size` each, one after the other."""
    found = []
    for name in names:
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
                fix=_MEND,
            ) from None
        found.append(x)
    return np.concatenate(found)


def vicon_rows(content: Mapping[str, Any], file: Path) -> tuple[np.ndarray, np.ndarray]:
    """The stamps (n,) in s and rows (n, 12) of the motion capture, whichever way the matrix lies.

    Raises:
        DataError: when stamps and rows do not fit.
    """
    try:
        seconds = np.asarray(content.get("time", []), dtype=float).ravel()
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
            got=f"vicon {np.shape(content['vicon'])}, time {np.shape(content.get('time', []))}",
            fix="restore the file",
        )
    return seconds, x


def _truth(content: Mapping[str, Any], file: Path, made: Recording) -> Series | None:
    """The motion capture; rows that are not finite are masked. None where there is none."""
    if not np.size(content.get("vicon", [])):
        return None
    seconds, x = vicon_rows(content, file)
    known = np.isfinite(seconds)
    if not known.all():
        many = int((~known).sum())
        made.notes.append(note("skipped", f"{file.name}: {many} stamps of vicon are not finite: left out"))
    x = np.where(np.isfinite(x), x, np.nan)
    if not np.isfinite(x[known]).all(axis=1).any():
        return None
    seconds, x = seconds[known], x[known]
    keep, more = strictly_later(seconds, "vicon", file)
    made.notes += more
    time = Series.from_seconds(seconds[keep], seconds[keep]).time
    time, x = present("truth", f"{file}: vicon", time, x[keep], made.notes, made.info["absent"])
    truth = MotionTruth(
        position=x[:, :3],
        velocity=x[:, 6:9],
        attitude=np.asarray(quaternion_from_angles(x[:, 3:6], order="zxy", xp=np)),
        rate=x[:, 9:12],
    )
    return Series(time, truth, name="truth", gaps=True)


def _camera(images: str, parameters: Parameters, frames: list[Any]) -> tuple[Camera, str]:
    """The camera of the images, and a note on how well both readings of them reproject."""
    rich = sorted((f for f in frames if len(f[0])), key=lambda f: -len(f[0]))[:400]
    sample = rich[:: max(len(rich) // 40, 1)]
    cameras = {"raw": parameters.camera, "rectified": parameters.camera.rectified()}
    errors = {
        name: float(
            np.median([e for f in sample if np.isfinite(e := _reprojection(f, parameters, c))] or np.inf)
        )
        for name, c in cameras.items()
    }
    name = min(errors, key=lambda name: errors[name]) if images == "auto" else images
    figures = ", ".join(f"{name} {error:.3f} px" for name, error in errors.items())
    said = f"images taken as {name}{' (asked for)' * (images != 'auto')}; reprojection as {figures}"
    return cameras[name], said


def _reprojection(frame: Any, parameters: Parameters, camera: Camera) -> float:
    found = measure(*frame, tag_map=parameters.tag_map, camera=camera, mount=parameters.mount, reject=False)
    return np.inf if found is None else float(found.error)
