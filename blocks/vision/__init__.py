"""Vision: cameras, fiducial tags, and the pose of a body that sees them.

A `Camera` says where a point in the world falls in the image, a `Mount` where the camera sits in the body,
and a `TagMap` where the tags lie. `pnp` finds the pose that explains the corners seen, with its covariance;
`mapping` finds a map that nobody surveyed, from many images at once; `motion` relates the velocity of a
camera to that of its body. Finding a pose in an image runs on the host (OpenCV); what it gives is an ordinary
stream that a lowered filter reads. `mapping` is imported by its own name, since the solver it needs is slow
to import.
"""

from __future__ import annotations

from flowgraph.blocks.signals import PoseMeasurement, Tags
from flowgraph.blocks.vision.camera import COURSE_CAMERA, COURSE_MOUNT, Camera, Mount
from flowgraph.blocks.vision.motion import (
    adjoint,
    camera_motion_of,
    camera_velocity,
    find_delay,
    velocity_error,
)
from flowgraph.blocks.vision.pnp import Solution, find_pose, quaternion_of, rotation_of, solve
from flowgraph.blocks.vision.tags import TagMap, course_map, grid_map, tags_series

__all__ = [
    "COURSE_CAMERA",
    "COURSE_MOUNT",
    "Camera",
    "Mount",
    "adjoint",
    "camera_motion_of",
    "camera_velocity",
    "find_delay",
    "velocity_error",
    "Solution",
    "find_pose",
    "quaternion_of",
    "rotation_of",
    "solve",
    "TagMap",
    "course_map",
    "grid_map",
    "tags_series",
    "mapping",
    "PoseMeasurement",
    "Tags",
]
