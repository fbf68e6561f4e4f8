"""Hand-held camera and IMU over a mat of AprilTags: the corners of each image, the IMU, the calibration.

    umd:FILE[:CALIBRATION]     DataMappingNew.mat; CalibParams.mat beside it if left out

    DetAll     a cell an image, rows [id, p1, p2, p3, p4]: corners, bottom-left first, counter-clockwise, px
    TLeftImgs  stamps of the images, s
    IMU        rows [q (all zero), acceleration, rate, stamp]: specific force m/s^2, rad/s, s
    CalibParams: K, qIMUToC (w, x, y, z: camera from IMU), TIMUToC (m), TagSize (m)

Nobody surveyed the tags: `blocks.vision.mapping` makes a map of the corners. There is no truth; the on-board
poses of the file are an estimate, and are not read. The IMU's readings came in bursts 0.125 ms apart and with
gaps of up to 0.8 s; their stamps are used as they are, and a row whose stamp is not after those before it is
left out and named in the flight's notes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.malformed import MALFORMED, Records
from flowgraph.blocks.datasets.matfile import columns_of, read_structs
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    imu_noise,
    known,
    number,
    split_argument,
    stream_settings,
)
from flowgraph.blocks.datasets.tables import strictly_later
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu
from flowgraph.blocks.vision.camera import Camera, Mount
from flowgraph.blocks.vision.pnp import rotation_of
from flowgraph.blocks.vision.tags import tags_series
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["SETTINGS", "load"]

SETTINGS: Mapping[str, str] = {
    **stream_settings("imu", "tags", only=("time_offset", "every")),
    **NOISE_SETTINGS,
    **MALFORMED,
    "most_tags": "room for tags in an image",
}
"""The settings of `load` and what they mean."""


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read a recording: the streams `imu` (`Imu`; the body is the IMU) and `tags` (`Tags`, raw pixels).

    Args:
        argument: FILE[:CALIBRATION].
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight` without truth. info: `camera`, `mount` (body in the camera), `tag_side` (m), `imu_noise`.

    Raises:
        DataError: a file or variable is missing, or of another form; names it.
        DeclarationError, UnknownNameError: for settings.
    """
    given = settings or {}
    known(given, SETTINGS, "umd")
    file, beside = split_argument(argument, "umd:FILE[:CALIBRATION]")
    content = read_structs(file, "DetAll", "TLeftImgs", "IMU")
    calibration = beside or file.parent / "CalibParams.mat"
    camera, mount, side = _calibration(calibration)
    records = Records(given, "umd")
    images, imu = columns_of(content, "TLeftImgs", file), _readings(content, file, records.skips)
    detections = np.atleast_1d(np.asarray(content["DetAll"], dtype=object))
    if len(detections) != len(images):
        raise DataError(
            "images and stamps differ in number",
            path=str(file),
            expected=f"{len(images)} cells in DetAll, one a stamp of TLeftImgs",
            got=str(len(detections)),
            fix="restore the file",
        )
    room = int(number(given, "most_tags", 64, "umd", positive=True))
    frames = [records.read(_detected, cell, row, file, room) for row, cell in enumerate(detections, start=1)]
    made = Recording(file.stem, kind="umd", given=given, place=str(file))
    made.notes += records.said(f"{file.name}: images", len(frames))
    whole = np.isfinite(imu).all(axis=1)
    if not whole.all():
        sentence = f"{file.name}: {int((~whole).sum())} of {len(imu)} rows of IMU are not finite: left out"
        made.notes.append(note("skipped", sentence))
    imu = imu[whole]
    keep_image, notes = strictly_later(images, "TLeftImgs", file)
    keep_imu, more = strictly_later(imu[:, 10], "IMU", file)
    keep_image &= np.array([f is not None for f in frames])
    u = imu[keep_imu]
    made.notes += [*notes, *more]
    readings = Imu(gyro=u[:, 7:10], specific_force=u[:, 4:7])
    made.take(Series.from_seconds(u[:, 10], readings, name="imu"), f"{file}: IMU")
    seen = [f for f, kept in zip(frames, keep_image, strict=True) if kept]
    stamps = Series.from_seconds(images[keep_image], images[keep_image]).time
    made.take(tags_series(stamps, seen, room=room), f"{file}: DetAll")
    unit = imu_noise(given, "umd", made.notes, NOISE)
    made.info.update(camera=camera, mount=mount, tag_side=side, imu_noise=unit, **PIXELS)
    return made.flight()


def _readings(content: Mapping[str, Any], file: Path, gaps: bool) -> np.ndarray:
    fix = "mend or delete the row, or leave it out: malformed=skip"
    return columns_of(content, "IMU", file, 11, fix=fix, gaps=gaps)


NOISE = ImuNoise(gyro=0.02, accelerometer=0.6, gyro_bias=2e-4, accelerometer_bias=2e-3)
"""Densities for a hand-held unit whose readings stand for up to 0.8 s; there is no data sheet."""

PIXELS = {"pixel_noise": 0.25, "position_noise": 1e-4, "attitude_noise": 1e-4}
"""Standard deviation of a corner's coordinate, px, and of a pose beyond what that gives, m and rad."""


def _calibration(file: Path) -> tuple[Camera, Mount, float]:
    content = read_structs(file, "K", "qIMUToC", "TIMUToC", "TagSize")
    q = columns_of(content, "qIMUToC", file)
    t, side = columns_of(content, "TIMUToC", file), columns_of(content, "TagSize", file)
    if q.shape != (4,) or abs(np.linalg.norm(q) - 1.0) > 0.01 or t.shape != (3,) or not side[0] > 0.0:
        raise DataError(
            "the calibration is malformed",
            path=str(file),
            expected="qIMUToC: a unit quaternion (w, x, y, z); TIMUToC: 3 numbers; TagSize: positive",
            got=f"qIMUToC {q.tolist()}, TIMUToC {t.tolist()}, TagSize {side.tolist()}",
            fix="restore the file",
        )
    camera = Camera(columns_of(content, "K", file, 3))
    return camera, Mount(rotation_of(q / np.linalg.norm(q)), t), float(side[0])


def _detected(cell: Any, row: int, file: Path, room: int) -> tuple[np.ndarray, np.ndarray]:
    """The ids (k,) and corners (k, 4, 2) of one image; a cell without rows is an image without tags."""
    try:
        table = np.asarray(cell, dtype=float)
    except (TypeError, ValueError):
        table = np.full((1, 1), np.nan)
    if not table.size:
        return np.zeros(0, int), np.zeros((0, 4, 2))
    table = np.atleast_2d(table)
    if table.ndim != 2 or table.shape[1] != 9 or not np.isfinite(table).all() or len(table) > room:
        raise DataError(
            "an image is malformed",
            path=f"{file}: DetAll, cell {row}",
            expected=f"at most {room} rows of an id and four corners: 9 finite numbers",
            got=f"shape {table.shape}",
            fix="mend the cell, raise most_tags, or leave it out: malformed=skip",
        )
    return table[:, 0].astype(int), table[:, 1:].reshape(-1, 4, 2)
