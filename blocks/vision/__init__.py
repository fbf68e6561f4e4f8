"""Vision: cameras, fiducial tags, and the pose of a body that sees them.

Finding a pose in an image runs on the host (OpenCV); what it gives, a pose with its covariance, is an
ordinary stream that a lowered filter reads.
"""

from __future__ import annotations

from flowgraph.blocks.vision.camera import Camera, Mount
from flowgraph.blocks.vision.pnp import PoseMeasurement, find_pose, solve
from flowgraph.blocks.vision.tags import TagMap, Tags, course_map, grid_map

__all__ = [
    "Camera",
    "Mount",
    "PoseMeasurement",
    "TagMap",
    "Tags",
    "course_map",
    "find_pose",
    "grid_map",
    "solve",
]
