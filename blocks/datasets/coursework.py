"""What the course asks of its students, on its files: `estimate_pose` and `estimate_covariances`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.blocks.datasets.parameters import Parameters
from flowgraph.blocks.datasets.studentdata import load, packet_tags
from flowgraph.blocks.geometry.euler import (
    angles_from_matrix,
    angles_from_quaternion,
    matrix_from_angles,
    wrapped,
)
from flowgraph.blocks.metrics.truth import interpolate_pose, known
from flowgraph.blocks.signals import PoseMeasurement
from flowgraph.blocks.vision.camera import Camera
from flowgraph.blocks.vision.mapping import frames_of
from flowgraph.blocks.vision.pnp import measure, rotation_of
from flowgraph.errors import DataError

__all__ = ["estimate_covariances", "estimate_pose"]

_COURSE = Parameters.of_the_course()
_DOUBTFUL = 2.0  # px


def estimate_pose(
    packet: Mapping[str, Any],
    *,
    parameters: Parameters = _COURSE,
    camera: Camera | None = None,
    near: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Position and attitude of the body from the tags of one packet.

    Args:
        packet: with `id` and `p1` to `p4` (2 x n px), as in studentdataN.mat; one tag may come without axes.
        parameters: map, camera and mount.
        camera: of the image. If left out, its corners are taken as those of a raw or of a rectified image,
            whichever reprojects better. Two tags or more tell; one alone does not, and its camera should be
            named, or `near`.
        near: the (position (3, 1), angles (3, 1)) of the packet before, which decides between two poses that
            explain few tags about equally well.

    Returns:
        position (3, 1), m, world; and angles (3, 1), rad: roll, pitch, yaw with R = Rz(yaw) Rx(roll)
        Ry(pitch).

    Raises:
        DataError: when the packet shows no tag of the map.
    """
    ids, corners = packet_tags(packet, "packet")
    before = None
    if near is not None:
        before = np.ravel(near[0]), matrix_from_angles(np.ravel(near[1]), order="zxy", xp=np)
    cameras = [camera] if camera is not None else [parameters.camera, parameters.camera.rectified()]

    def seen_by(cameras: list[Camera], *, reject: bool) -> list[tuple[PoseMeasurement, Camera]]:
        found = [
            measure(
                ids, corners, tag_map=parameters.tag_map, camera=c, mount=parameters.mount, near=before,
                reject=reject,
            )
            for c in cameras
        ]  # fmt: skip
        return [(pose, c) for pose, c in zip(found, cameras, strict=True) if pose is not None]

    found = seen_by(cameras, reject=False)
    if not found:
        raise DataError(
            "no pose: no tag of the map is seen",
            path="packet.id",
            expected=f"ids of the map, such as {parameters.tag_map.ids[:3].tolist()}",
            got=str(ids.tolist()),
            fix="pass over packets without tags",
        )
    if min(float(pose.error) for pose, _ in found) > _DOUBTFUL:  # of neither: a tag may be taken for another
        found = seen_by(cameras, reject=True)
    fit = lambda one: (-int(one[0].tags), float(one[0].error))
    if before is not None and int(found[0][0].tags) == 1:
        fit = lambda one: (-1, float(np.linalg.norm(one[0].position - before[0])))
    ((pose, _),) = seen_by([min(found, key=fit)[1]], reject=True)
    angles = angles_from_matrix(rotation_of(pose.attitude), order="zxy", xp=np)
    return pose.position.reshape(3, 1), np.asarray(angles).reshape(3, 1)


def estimate_covariances(filename: str | Path, *, parameters: str | Path | None = None) -> np.ndarray:
    """R (6, 6): the covariance of measured minus true (x, y, z, roll, pitch, yaw) over a flight, m and rad.

    R = sum of r r^T / (n - 1), about zero and not about the mean: what the measurement is off by always
    belongs to its error. The motion capture is interpolated at the stamps; packets outside it or in its gaps,
    and those without tags, are left out. Angles are Z-X-Y, their differences wrapped.

    Raises:
        DataError: when fewer than two packets can be compared.
    """
    flight = load(str(filename) + (f":{parameters}" if parameters else ""))
    truth = flight.truth
    residuals = []
    near = None
    for tags_time, tags in zip(*_frames(flight), strict=True):
        pose = measure(
            tags[0], tags[1], tag_map=flight.info["tag_map"], camera=flight.info["camera"],
            mount=flight.info["mount"], near=near,
        )  # fmt: skip
        if pose is None:
            continue
        near = pose.position, rotation_of(pose.attitude)
        if truth is None or not known(truth, np.array([tags_time]))[0]:
            continue
        p, q = interpolate_pose(truth, np.array([tags_time]))
        a, b = (np.asarray(angles_from_quaternion(x, order="zxy", xp=np)) for x in (pose.attitude, q[0]))
        residuals.append(np.concatenate([pose.position - p[0], wrapped(a - b)]))
    if len(residuals) < 2:
        raise DataError(
            "too few packets can be compared with the motion capture",
            path=str(filename),
            expected="at least two with tags, within the motion capture's time",
            got=str(len(residuals)),
            fix="choose another file",
        )
    r = np.array(residuals)
    return np.asarray(r.T @ r / (len(r) - 1))


def _frames(flight: Any) -> tuple[list[int], list[Any]]:
    if "tags" not in flight.streams:
        return [], []
    return flight.streams["tags"].time.tolist(), list(frames_of(flight.streams["tags"]))
