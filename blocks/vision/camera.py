"""A camera: how it maps points to pixels, and where it sits in the body.

Camera coordinates have z along the view, x right and y down in the image. `Camera` is a pinhole with the
radial and tangential distortion of five coefficients that OpenCV uses; `Mount` is the rigid transform between
camera and body.

Source: D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering 32(3), 1966.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from flowgraph.errors import DeclarationError

__all__ = ["COURSE_CAMERA", "COURSE_MOUNT", "Camera", "Mount"]

MOST_PASSES = 100
MOST_SLOPE = 4.0  # what no lens of this model sees; a pixel that none maps to would run away
CLOSE = 1e-14  # of normalised image coordinates, 1e-11 px


@dataclass(frozen=True)
class Camera:
    """Intrinsic parameters.

    Args:
        K: (3, 3) of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px.
        distortion: (k1, k2, p1, p2, k3).

    Raises:
        DeclarationError: when K is not of that form.
    """

    K: np.ndarray
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        K = np.asarray(self.K, dtype=float)
        sound = K.shape == (3, 3) and np.isfinite(K).all() and np.allclose(K[2], [0.0, 0.0, 1.0])
        if not (sound and K[0, 0] > 0.0 and K[1, 1] > 0.0 and K[1, 0] == 0.0 and K[0, 1] == 0.0):
            raise DeclarationError(
                "this is no camera matrix",
                path="Camera.K",
                expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, px",
                got=str(K.tolist()),
                fix="check the order of its entries: it may be transposed",
            )
        values = np.asarray(self.distortion, dtype=float)
        if values.shape != (5,) or not np.isfinite(values).all():
            raise DeclarationError(
                "this is no distortion",
                path="Camera.distortion",
                expected="5 finite numbers: k1, k2, p1, p2, k3",
                got=str(values.tolist()),
                fix="fill missing coefficients with zeros",
            )
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", tuple(values.tolist()))

    def rectified(self) -> Self:
        """The same camera after its images were rectified: without distortion."""
        return replace(self, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))

    def distort(self, x: np.ndarray) -> np.ndarray:
        """Where (..., 2) in normalised coordinates of the image a ideal direction (..., 2) appears."""
        k1, k2, p1, p2, k3 = self.distortion
        u, v = x[..., 0], x[..., 1]
        r = u * u + v * v
        radial = 1.0 + r * (k1 + r * (k2 + r * k3))
        du = 2.0 * p1 * u * v + p2 * (r + 2.0 * u * u)
        dv = p1 * (r + 2.0 * v * v) + 2.0 * p2 * u * v
        return np.stack([u * radial + du, v * radial + dv], axis=-1)

    def undistort(self, pixels: npt.ArrayLike) -> np.ndarray:
        """The ideal directions (..., 2) of pixels (..., 2): x/z and y/z in camera coordinates.

        Fixed-point iterations until they stand still; a strong distortion needs dozens.
        """
        z = np.asarray(pixels, dtype=float)
        seen = (z - self.K[:2, 2]) / np.array([self.K[0, 0], self.K[1, 1]])
        ideal = seen
        for _ in range(MOST_PASSES):
            step = seen - self.distort(ideal)
            ideal = np.clip(ideal + step, -MOST_SLOPE, MOST_SLOPE)
            if not np.abs(step).max(initial=0.0) > CLOSE:
                break
        return ideal

    def project(self, points: npt.ArrayLike) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) in camera coordinates, with z > 0."""
        X = np.asarray(points, dtype=float)
        return self.distort(X[..., :2] / X[..., 2:]) @ self.K[:2, :2].T + self.K[:2, 2]


@dataclass(frozen=True)
class Mount:
    """Where the body sits, seen from the camera: x_camera = rotation @ x_body + origin.

    Args:
        rotation: (3, 3), camera from body.
        origin: (3,) the body's origin in camera coordinates, m.

    Raises:
        DeclarationError: when the rotation is none.
    """

    rotation: np.ndarray
    origin: np.ndarray

    def __post_init__(self) -> None:
        R, t = np.asarray(self.rotation, dtype=float), np.asarray(self.origin, dtype=float)
        turned = R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0
        if not turned or t.shape != (3,) or not np.isfinite(t).all():
            raise DeclarationError(
                "this is no mount of a camera",
                path="Mount",
                expected="a rotation (3, 3) and an origin (3,) in m",
                got=f"rotation {R.tolist()}, origin {t.tolist()}",
                fix="give a matrix with R R^T = I and determinant 1",
            )
        object.__setattr__(self, "rotation", R)
        object.__setattr__(self, "origin", t)

    @property
    def camera_in_body(self) -> np.ndarray:
        """The position (3,) of the camera in the body, m."""
        return -self.rotation.T @ self.origin

    def body_pose(self, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The body's position (3,) and attitude (3, 3), body to world, from x_camera = R x_world + t."""
        return R.T @ (self.origin - t), R.T @ self.rotation

    def view(self, position: np.ndarray, attitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(R, t) with x_camera = R x_world + t, from the body's position and attitude (3, 3)."""
        R = self.rotation @ attitude.T
        return R, self.origin - R @ position


def _turn(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


COURSE_CAMERA = Camera(
    np.array([[314.1779, 0.0, 199.4848], [0.0, 314.2218, 113.7838], [0.0, 0.0, 1.0]]),
    (-0.438607, 0.248625, 0.00072, -0.000476, -0.0911),
)
"""The camera of the course, as its parameters.txt has it: 376 x 240 px."""


def course_mount(xyz: npt.ArrayLike = (-0.04, 0.0, -0.03), yaw: float = np.pi / 4) -> Mount:
    """The mount of the course from its two parameters: the camera looks down, turned by `yaw`.

    R_camera<-body = Rx(pi) Rz(yaw), and xyz is the body's (IMU's) origin in the camera frame, m.
    """
    return Mount(_turn(0, np.pi) @ _turn(2, yaw), np.asarray(xyz, dtype=float))


COURSE_MOUNT = course_mount()
"""The mount of the course: the camera sits at (0.0283, -0.0283, -0.03) m in the body."""
