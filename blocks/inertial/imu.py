"""Inertial navigation: carry a belief about pose, velocity and biases forward on what an IMU reads.

The error-state form keeps the attitude on its sphere: the state itself moves by exact increments, and only
the small error, 15 numbers, is treated as Gaussian.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-6.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry.rotations import (
    from_rotation_vector,
    normalize,
    right_product,
    skew,
    to_matrix,
)
from flowgraph.blocks.signals import GRAVITY, Belief, Imu

__all__ = ["GRAVITY", "ImuNoise", "carried", "error_jacobian", "predict"]


@dataclass(frozen=True)
class ImuNoise:
    """Noise of an inertial unit as continuous densities, each the same on its three axes.

    Args:
        gyro: white noise of the rate, rad/s/sqrt(Hz).
        accelerometer: white noise of the specific force, m/s^2/sqrt(Hz).
        gyro_bias: random walk of the gyro bias, rad/s^2/sqrt(Hz).
        accelerometer_bias: random walk of the accelerometer bias, m/s^3/sqrt(Hz).
    """

    gyro: float
    accelerometer: float
    gyro_bias: float
    accelerometer_bias: float

    @classmethod
    def per_sample(
        cls,
        rate: float,
        *,
        gyro: float,
        accelerometer: float,
        gyro_bias: float = 0.0,
        accelerometer_bias: float = 0.0,
    ) -> Self:
        """From variances per sample at `rate` Hz, as discrete-time papers and theses give them.

        `gyro` and `accelerometer` are variances of one reading, (rad/s)^2 and (m/s^2)^2; density^2 is
        variance / rate. The bias variances are of the step from one sample to the next; density^2 is
        variance * rate.

        Raises:
            ValueError: when the rate is not positive or a variance is negative.
        """
        if not rate > 0.0 or min(gyro, accelerometer, gyro_bias, accelerometer_bias) < 0.0:
            raise ValueError("per_sample needs rate > 0 (Hz) and variances that are not negative")
        white, walk = 1.0 / rate, rate
        return cls(
            math.sqrt(gyro * white),
            math.sqrt(accelerometer * white),
            math.sqrt(gyro_bias * walk),
            math.sqrt(accelerometer_bias * walk),
        )

    def scaled(
        self,
        *,
        gyro: float = 1.0,
        accelerometer: float = 1.0,
        gyro_bias: float = 1.0,
        accelerometer_bias: float = 1.0,
    ) -> Self:
        """The densities times factors: a data sheet knows nothing of vibration, aliasing and held samples."""
        return replace(
            self,
            gyro=self.gyro * gyro,
            accelerometer=self.accelerometer * accelerometer,
            gyro_bias=self.gyro_bias * gyro_bias,
            accelerometer_bias=self.accelerometer_bias * accelerometer_bias,
        )

    def power(self) -> tuple[float, ...]:
        """The diagonal (15) of the driving noise's spectral density, in the order of `Belief`."""
        parts = (0.0, self.accelerometer, self.gyro, self.gyro_bias, self.accelerometer_bias)
        return tuple(density**2 for density in parts for _ in range(3))


# What is constant in the Jacobian, in the order of `Belief`: all stay, the position drifts by the velocity.
_STAYS, _DRIFTS, _BIASES_STAY = np.eye(15, 6), np.eye(15, 6, 3), np.eye(6, 9, 3)


@functools.lru_cache
def _density(noise: ImuNoise) -> np.ndarray:
    """The spectral density (15, 15) of the driving noise."""
    return np.diag(noise.power())


def _like(table: Array, x: Array, xp: Any) -> Array:
    """A constant matrix with the leading axes of x, in its precision."""
    table = xp.asarray(table, dtype=x.dtype)
    return xp.broadcast_to(table, (*x.shape[:-2], *table.shape)) if x.ndim > 2 else table


@block
def predict(
    belief: Belief,
    imu: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    xp: Any,
) -> Belief:
    """Predict a belief over `dt` seconds with one IMU reading, held over the step.

    With w = gyro - gyro_bias and f = specific_force - accelerometer_bias (Solà eqs. 236, 260), and the force
    turned by the attitude half-way through the step:

        a = R(q) Exp(w dt/2) f + gravity        p' = p + v dt + a dt^2/2
        q' = q * Exp(w dt)                      v' = v + a dt
        P' = F (P + Q dt/2) F^T + Q dt/2        biases stay

    F is the Jacobian of this very step (Solà eqs. 269-270, to second order in w dt); Q is the spectral
    density, brought in by the trapezoidal rule, so that velocity noise reaches the position and rate noise
    the velocity. With dt = 0, as at the first firing, this is the identity.

    Fires when its inputs do. No state of its own.
    """
    pull = xp.asarray(gravity, dtype=belief.position.dtype)
    values, F = carried(belief, imu, pull, dt, xp)
    Q = xp.asarray(_density(noise), dtype=pull.dtype) * (0.5 * dt)
    P = F @ (belief.covariance + Q) @ F.mT + Q
    return Belief(
        **values,
        gyro_bias=belief.gyro_bias,
        accelerometer_bias=belief.accelerometer_bias,
        covariance=0.5 * (P + P.mT),
    )


def carried(belief: Any, imu: Imu, gravity: Array, dt: Any, xp: Any) -> tuple[dict[str, Array], Array]:
    """Position, velocity and attitude of `predict`, by name, and F (15, 15)."""
    by_half, middle, R, back, force = _turned(belief, imu, dt, xp)
    acceleration = (R @ force[..., None])[..., 0] + gravity
    step = acceleration * dt
    values = {
        "position": belief.position + (belief.velocity + 0.5 * step) * dt,
        "velocity": belief.velocity + step,
        "attitude": normalize((by_half @ middle)[..., 0], xp=xp),
    }
    return values, _jacobian(R, back, force, dt, xp)


def error_jacobian(belief: Belief, imu: Imu, dt: Any, xp: Any) -> Array:
    """F (15, 15) of `predict`: how the error of a belief goes on over dt seconds."""
    _, _, R, back, force = _turned(belief, imu, dt, xp)
    return _jacobian(R, back, force, dt, xp)


def _turned(belief: Belief, imu: Imu, dt: Any, xp: Any) -> tuple[Array, Array, Array, Array, Array]:
    """Half the step's turn, as a product; the attitude half-way, as a column, and as a matrix; half the turn
    back; and the force."""
    rate = imu.gyro - belief.gyro_bias
    force = imu.specific_force - belief.accelerometer_bias
    half = from_rotation_vector(rate * (0.5 * dt), xp=xp)
    by_half = right_product(half, xp=xp)
    middle = by_half @ belief.attitude[..., None]
    both = to_matrix(xp.concat([middle.mT, half[..., None, :]], axis=-2), xp=xp)
    return by_half, middle, both[..., 0, :, :], both[..., 1, :, :].mT, force


def _jacobian(R: Array, back: Array, force: Array, dt: Any, xp: Any) -> Array:
    """F, of what `_turned` gives."""
    kind = R.dtype
    # d(velocity')/d(attitude, gyro bias, accelerometer bias); the position's are dt/2 times these
    turned = R @ skew(force * -dt, xp=xp) @ back
    pull = xp.concat([turned, turned * (-0.5 * dt), R * -dt], axis=-1)
    turn = xp.concat([back @ back, back * -dt, 0.0 * back], axis=-1)
    biases = _like(_BIASES_STAY, R, xp)
    moved = _like(xp.asarray(_STAYS, dtype=kind) + xp.asarray(_DRIFTS, dtype=kind) * dt, R, xp)
    return xp.concat([moved, xp.concat([pull * (0.5 * dt), pull, turn, biases], axis=-2)], axis=-1)
