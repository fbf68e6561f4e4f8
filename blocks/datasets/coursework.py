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
from flowgraph.blocks.metrics.errors import interpolate_pose
from flowgraph.blocks.vision.camera import Camera
from flowgraph.blocks.vision.mapping import frames_of
from flowgraph.blocks.vision.pnp import measure, rotation_of
from flowgraph.errors import DataError

__all__ = ["estimate_covariances", "estimate_pose"]

_COURSE = Parameters.of_the_course()


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
        camera: another camera, such as `parameters.camera.rectified()`.
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
    pose = measure(
        ids,
        corners,
        tag_map=parameters.tag_map,
        camera=parameters.camera if camera is None else camera,
        mount=parameters.mount,
        near=before,
    )
    if pose is None:
        raise DataError(
            "no pose: no tag of the map is seen",
            path="packet.id",
            expected=f"ids of the map, such as {parameters.tag_map.ids[:3].tolist()}",
            got=str(ids.tolist()),
            fix="pass over packets without tags",
        )
    angles = angles_from_matrix(rotation_of(pose.attitude), order="zxy", xp=np)
    return pose.position.reshape(3, 1), np.asarray(angles).reshape(3, 1)


def estimate_covariances(filename: str | Path, *, parameters: str | Path | None = None) -> np.ndarray:
    """R (6, 6): the covariance of measured minus true (x, y, z, roll, pitch, yaw) over a flight, m and rad.

    R = sum of r r^T / (n - 1), about zero and not about the mean: what the measurement is off by always
    belongs to its error. The motion capture is interpolated at the stamps; packets outside it, and those
    without tags, are left out. Angles are Z-X-Y, their differences wrapped.

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
        if truth is None or not truth.time[0] <= tags_time <= truth.time[-1]:
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
