"""A smooth figure in space: 1 s at rest, then sums of waves that start slowly, flown as a quadrotor does.

Position and yaw are sums of sinusoids of a phase that starts slowly, so every derivative is exact. Thrust
must carry gravity and the acceleration, which fixes the body's z axis; with the yaw that fixes the attitude,
and the jerk fixes the body rate (D. Mellinger and V. Kumar, "Minimum snap trajectory generation and control
for quadrotors", ICRA 2011, eqs. 5-9 and sec. III).

`figure_shape` draws the waves of a flight, once, where it fires; `figure_motion` is where the body is at a
tick.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.signals import GRAVITY, BodyMotion, FigureShape

__all__ = ["AT_REST", "figure_motion", "figure_shape"]

AT_REST, _RAMP = 1.0, 2.0  # seconds
_FREQUENCIES = np.array([0.75, 1.5, 2.2])
_SIZES = np.array([[1.6], [1.6], [0.6]]) * np.array([1.0, 0.5, 0.25])
_YAW = np.array([0.9, 0.3]), np.array([0.35, 0.9])  # rad, rad/s


@block
def figure_shape(*, draw: Any, xp: Any) -> FigureShape:
    """Draw the figure of a flight. Give it a clock that ticks once: `figure_shape(at=start)`."""
    between = lambda name, low, high, shape: low + (high - low) * draw.uniform(name, shape)
    frequencies = _FREQUENCIES * between("frequencies", 0.85, 1.15, (3, 3))
    sizes = _SIZES * between("sizes", 0.7, 1.3, (3, 3))
    phases, yaw = between("phases", 0.0, 2.0 * np.pi, (3, 3)), between("yaw", 0.0, 2.0 * np.pi, (2,))
    return FigureShape(
        sizes=sizes,
        frequencies=frequencies,
        phases=phases,
        yaw_phases=yaw,
        origin=sizes * xp.sin(phases),
        yaw_origin=_YAW[0] * xp.sin(yaw),
    )


@block
def figure_motion(shape: FigureShape, *, t: Any, xp: Any) -> BodyMotion:
    """Where the body is at this tick, and how it moves; time counts from 0, and every derivative is exact."""
    clock = _phase(xp.astype(t, shape.sizes.dtype) * 1e-9, xp)
    waves = _waves(clock[0], shape.sizes, shape.frequencies, shape.phases, shape.origin, xp)
    position, velocity, acceleration, jerk = _through(waves, clock, xp)
    yaw, yaw_rate = _through(_waves(clock[0], *_YAW, shape.yaw_phases, shape.yaw_origin, xp), clock, xp)[:2]

    thrust = acceleration - xp.asarray(np.array(GRAVITY), dtype=acceleration.dtype)
    strength = xp.sqrt(_dot(thrust, thrust, xp))
    z = thrust / strength
    dz = (jerk - z * _dot(z, jerk, xp)) / strength
    ahead = xp.stack([xp.cos(yaw), xp.sin(yaw), 0.0 * yaw])
    turning = xp.stack([-xp.sin(yaw), xp.cos(yaw), 0.0 * yaw]) * yaw_rate
    side = xp.linalg.cross(z, ahead)
    width = xp.sqrt(_dot(side, side, xp))
    y = side / width
    d_side = xp.linalg.cross(dz, ahead) + xp.linalg.cross(z, turning)
    dy = (d_side - y * _dot(y, d_side, xp)) / width
    x = xp.linalg.cross(y, z)
    dx = xp.linalg.cross(dy, z) + xp.linalg.cross(y, dz)
    return BodyMotion(
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        attitude=_upright((x, y, z), xp),
        rate=xp.concat([_dot(z, dy, xp), _dot(x, dz, xp), _dot(y, dx, xp)]),  # R^T R' = skew(rate)
    )


def _upright(axes: tuple[Array, Array, Array], xp: Any) -> Array:
    """The quaternion (4) of a body's axes, where its scalar part is positive: turned by less than half a
    turn, as these figures are, whose yaw stays within 2.4 rad."""
    x, y, z = axes
    w = 0.5 * xp.sqrt(xp.maximum(1.0 + x[0] + y[1] + z[2], 1e-12))
    parts = xp.stack([y[2] - z[1], z[0] - x[2], x[1] - y[0]])
    return xp.concat([w[None], 0.25 / w * parts])


def _phase(t: Array, xp: Any) -> tuple[Array, ...]:
    """A time that stands still for `AT_REST`, then speeds up to 1 over `_RAMP`; with three derivatives."""
    u = xp.clip((t - AT_REST) / _RAMP, 0.0, 1.0)
    after = xp.maximum(t - AT_REST - _RAMP, 0.0)
    u2, u3, u4, u5, u6 = u * u, *(xp.pow(u, float(k)) for k in range(3, 7))
    value = _RAMP * (2.5 * u4 - 3.0 * u5 + u6) + after
    first = 10.0 * u3 - 15.0 * u4 + 6.0 * u5
    second = (30.0 * u2 - 60.0 * u3 + 30.0 * u4) / _RAMP
    third = (60.0 * u - 180.0 * u2 + 120.0 * u3) / _RAMP**2
    return value, first, second, third


def _waves(
    phase: Array, sizes: Array, frequencies: Array, phases: Array, origin: Array, xp: Any
) -> tuple[Array, ...]:
    """Sums of sinusoids (..., waves) that start at 0, and three derivatives in `phase`; each is (...)."""
    w, angle = frequencies, frequencies * phase + phases
    sine, cosine = sizes * xp.sin(angle), sizes * xp.cos(angle)
    return (
        xp.sum(sine - origin, axis=-1),
        xp.sum(cosine * w, axis=-1),
        xp.sum(-sine * (w * w), axis=-1),
        xp.sum(-cosine * xp.pow(w, 3.0), axis=-1),
    )


def _through(f: tuple[Array, ...], s: tuple[Array, ...], xp: Any) -> tuple[Array, ...]:
    """The chain rule: f and its derivatives in time, given those of f in s and of s in time."""
    return (
        f[0],
        f[1] * s[1],
        f[2] * (s[1] * s[1]) + f[1] * s[2],
        f[3] * xp.pow(s[1], 3.0) + 3.0 * f[2] * s[1] * s[2] + f[1] * s[3],
    )


def _dot(a: Array, b: Array, xp: Any) -> Array:
    return xp.sum(a * b, axis=-1, keepdims=True)
