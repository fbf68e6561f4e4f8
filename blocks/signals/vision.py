"""What a camera sees: tags in an image, the pose of the body that follows, and the camera's own motion."""

from __future__ import annotations

from flowgraph import Array, Signal, boolean, integer, real

__all__ = [
    "Tags",
    "PoseMeasurement",
    "CameraMotion",
]


class Tags(Signal):
    """The tags in one image, padded to a fixed number; only those `seen` mean anything.

    ids: of each tag. corners: px, four a tag, (u right, v down) from the centre of the first pixel.
    """

    ids: Array = integer("tags")
    corners: Array = real("tags", 4, 2, unit="px", frame="image")
    seen: Array = boolean("tags")


class PoseMeasurement(Signal):
    """A measured pose of the body with its own covariance.

    covariance: of (position, m, world; attitude, right rotation vector, rad, body); zero where the
    measurement does not say. error: root mean square of the reprojection, px. tags: how many it rests on.
    """

    position: Array = real(3, unit="m", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    covariance: Array = real(6, 6)
    error: Array = real(unit="px")
    tags: Array = integer()


class CameraMotion(Signal):
    """A camera's linear (m/s) and angular (rad/s) velocity relative to the world, in camera coordinates."""

    velocity: Array = real(3, unit="m/s", frame="camera")
    rate: Array = real(3, unit="rad/s", frame="camera")
