"""What the unscented filters of `euler_ins` add to `unscented`: how a point moves, and a camera's velocity.

The sigma points are augmented with the noises, as in `unscented`: state and noises are independent, so a
point moves one of them at a time. They lie sqrt(3) deviations away, where they match a Gaussian's fourth
moment.

A camera's velocity corrects in regression form: H is the slope of the pairs of points, and what they leave
unexplained, of curvature and of the noises, is the noise of the Joseph form.

Sources: S. Julier and J. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92, 2004; E. Wan
and R. van der Merwe, 2001 (alpha, beta); the report's sec. on its two filters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry.euler import matrix_from_angles
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.kalman.filters import correct, scaled
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.kalman.triangles import covariance_root
from flowgraph.blocks.models.euler_ins import STATE, increments, move, moved_by
from flowgraph.blocks.signals import CameraMotion, Gaussian, Imu, KalmanInnovation
from flowgraph.blocks.unscented.sigma_points import SigmaPoints
from flowgraph.blocks.vision.camera import Mount
from flowgraph.blocks.vision.motion import camera_velocity
from flowgraph.errors import UnknownNameError
from flowgraph.language.block import Limit

__all__ = ["RATES", "carried", "far_points", "update_camera_velocity"]

RATES = ("gyro", "camera")
"""Whose rate the body's is taken for: the gyroscope's minus its bias (eq. 10), or the camera's (eq. 9)."""


def carried(order: str, gravity: tuple[float, float, float] = GRAVITY) -> Callable[..., Array]:
    """`move` of `predict_unscented`: `euler_ins.move` over the IMU's readings, each point with its own noise
    (..., 12) of (increments of angle and velocity, steps of the two biases)."""

    def moved(x: Array, imu: Imu, w: Array, dt: Any, xp: Any) -> Array:
        turn, push = increments(x, imu, dt)
        after = move(x, turn + w[..., 0:3], push + w[..., 3:6], dt, order=order, gravity=gravity, xp=xp)
        return after + xp.concat([xp.zeros_like(after[..., 0:9]), w[..., 6:12]], axis=-1)

    return moved


def far_points(
    noises: int, *, alpha: float | None = None, beta: float = 2.0, kappa: float = 0.0
) -> SigmaPoints:
    """Points sqrt(3) deviations away from the mean of a state with so many noises, where no alpha is given.

    Raises:
        DeclarationError: where the numbers make no set, as a kappa that takes all the spread away.
    """
    n = STATE.tangent + noises
    if alpha is None:
        alpha = math.sqrt(3.0 / n) if kappa == 0.0 else math.sqrt(3.0) / SigmaPoints(kappa=kappa).scale(n)
    points = SigmaPoints(alpha=alpha, beta=beta, kappa=kappa)
    points.scale(n)
    return points


@block
def update_camera_velocity(
    prior: Gaussian,
    motion: CameraMotion | None,
    imu: Imu,
    scale: Any = None,
    *,
    order: str,
    mount: Mount,
    velocity_noise: float,
    rate_noise: float,
    rate: str = "gyro",
    points: SigmaPoints | None = None,
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """Correct with a camera's velocity, where there is one; without one the prior passes through.

        v_c = R_cb (R(e)^T v + w x r) + n_v
        w = w_m - b_g - n_w   (rate="gyro", the report's eq. 10)
        w = R_cb^T w_c - n_w  (rate="camera", eq. 9)

    The noises n_v and n_w are part of the sigma points: 42 of state (15) and noises (6).

    Args:
        prior: over `euler_ins.STATE`.
        motion: the camera's velocity, and its rate, which only eq. 9 uses; or absent.
        imu: the reading of now, whose rate eq. 10 uses.
        order: "zxy" or "zyx".
        mount: of the camera in the body.
        velocity_noise: standard deviation of the camera's velocity, m/s.
        rate_noise: of the rate that is taken, rad/s.
        rate: "gyro" or "camera".
        points: the set of sigma points; sqrt(3) deviations away if left out.
        gate, robust, scale: as in `update_linear` (for three numbers a nis of 16.3 is 99.9 %).

    Raises:
        UnknownNameError: for another source of the rate.
    """
    if rate not in RATES:
        raise UnknownNameError("source of the rate", rate, RATES, path="update_camera_velocity")
    if motion is None:
        return prior, None
    x, kind = prior.mean, prior.mean.dtype
    n, points = x.shape[-1], far_points(6) if points is None else points
    reach = points.scale(n + 6)
    S = covariance_root(prior.covariance, xp=xp)
    deviations = xp.asarray(np.diag(np.repeat([velocity_noise, rate_noise], 3)), dtype=kind)
    apart, shakes = points.around(S, reach, xp), points.around(deviations, reach, xp)
    X = STATE.plus(x[None, :], xp.concat([0.0 * apart[:1], apart, 0.0 * apart[:12]], axis=0), xp)
    w = xp.concat([xp.zeros((1 + 2 * n, 6), dtype=kind), shakes], axis=0)
    if rate == "gyro":
        turning = imu.gyro - X[:, 9:12]
    else:
        turning = motion.rate @ xp.asarray(mount.rotation, dtype=kind) + 0.0 * X[:, 9:12]
    R = matrix_from_angles(X[:, 3:6], order=order, xp=xp)
    seen = camera_velocity(X[:, 6:9], R, turning - w[:, 3:6], mount=mount, xp=xp) + w[:, 0:3]
    cluster = points.cluster(seen, None, reach, xp)
    slope = (cluster.outer[:n] - cluster.outer[n : 2 * n]).mT / (2.0 * reach)  # H S
    rest = points.covariance(cluster, cluster, reach) - slope @ slope.mT
    # a direction that is known exactly has a column of zeros, and nothing to learn: any H there will do
    known = xp.eye(n, dtype=kind) * xp.astype(S == 0.0, kind)
    H = xp.linalg.solve((S + known).mT, slope.mT).mT
    residual = motion.velocity - cluster.mean
    rest = scaled(0.5 * (rest + rest.mT), scale, xp)
    found = correct(prior.covariance, residual, H, rest, gate=gate, robust=robust, xp=xp)
    return moved_by(prior, found, xp)


@update_camera_velocity.limited
def _limits(*, points: SigmaPoints | None = None, **_: Any) -> Sequence[Limit]:
    return () if points is None else points.limits()
