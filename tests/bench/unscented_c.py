"""The unscented step in generated C beside Eigen: 15 states, 6 measurements, predict and update each tick.

The state is position, velocity, Euler angles (Z-Y-X) and the biases of gyroscope and accelerometer; the model
is strapdown navigation with an IMU as control, the measurement position and angles. Both filters are made of
what `blocks/unscented/filters.py` offers; the peer, `floor/ukf.cpp`, has the same equations in the same form.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from flowgraph import Array, Graph, Signal, Stream, block, delay, graph, real, simulate
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.unscented.filters import predict_unscented, update_unscented
from flowgraph.data.series import Series
from tests.bench.generated_c import floor, loop
from tests.bench.rows import Row, interleaved, missing, seconds

STEP_NS = 10_000_000


class Reading(Signal):
    gyro: Array = real(3)
    force: Array = real(3)
    seen: Array = real(6)


@block
def seen(reading: Reading) -> real(6):  # type: ignore[valid-type]
    return reading.seen


def strapdown(x: Array, reading: Reading, w: Any, dt: Any, xp: Any) -> Array:
    """Rows of states (..., 15), one Euler step of `dt` seconds on."""
    part = lambda k: x[..., k : k + 1]
    sr, sp, sy = (xp.sin(part(k)) for k in (6, 7, 8))
    cr, cp, cy = (xp.cos(part(k)) for k in (6, 7, 8))
    wx, wy, wz = (reading.gyro[k] - part(9 + k) for k in range(3))
    fx, fy, fz = (reading.force[k] - part(12 + k) for k in range(3))
    level, side, left = sr * wy + cr * wz, sr * fy + cr * fz, cr * fy - sr * fz
    ahead = cp * fx + sp * side
    rates = [
        x[..., 3:6],
        cy * ahead - sy * left,
        sy * ahead + cy * left,
        cp * side - sp * fx - 9.81,
        wx + level * sp / cp,
        cr * wy - sr * wz,
        level / cp,
    ]
    return xp.concat([x[..., :9] + xp.concat(rates, axis=-1) * dt, x[..., 9:]], axis=-1)


def position_and_angles(x: Array, xp: Any) -> Array:
    return xp.concat([x[..., 0:3], x[..., 6:9]], axis=-1)


Q = np.repeat([1e-6, 1e-3, 1e-4, 1e-8, 1e-6], 3)
R = np.repeat([1e-4, 1e-5], 3)
START = np.repeat([1e-2, 1e-2, 1e-3, 1e-6, 1e-4], 3)


def case(ticks: int) -> tuple[Graph, dict[str, Series], np.ndarray, np.ndarray]:
    """The filter, its inputs, and the readings (ticks, 6) and measurements (ticks, 6) of these."""
    generator = np.random.default_rng(0)
    imu = generator.normal(scale=0.1, size=(ticks, 6)) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])
    measured = generator.normal(scale=0.01, size=(ticks, 6))
    start = Gaussian(mean=np.zeros(15), covariance=np.diag(START))

    @graph
    def g(imu: Stream[Reading]):
        belief = delay(start, name="belief")
        prior = predict_unscented(belief, imu, move=strapdown, Q=np.diag(Q))
        posterior, _ = update_unscented(prior, seen(imu), observe=position_and_angles, R=np.diag(R))
        belief.feed(posterior)
        return posterior

    readings = Series(
        np.arange(ticks) * STEP_NS, Reading(gyro=imu[:, :3], force=imu[:, 3:], seen=measured), name="imu"
    )
    return g.build(), {"imu": readings}, imu, measured


def rows(*, ticks: int = 200, repeats: int = 151) -> list[Row]:
    """Microseconds of a predict and an update."""
    built, inputs, imu, measured = case(ticks)
    ours, scale = loop(built, inputs), 1e6 / ticks
    name = "UKF step 15/6, C"
    try:
        peer = floor("ukf").floor_ukf
    except ImportError as error:
        return [missing(name, ours() * scale, "us", "Eigen", error)]
    model = np.concatenate([Q, R, np.zeros(15), np.diag(START).ravel()])
    mean, covariance = np.empty((ticks, 15)), np.empty((ticks, 15, 15))
    peer.argtypes = [ctypes.c_int64, ctypes.c_double, *[ctypes.c_void_p] * 5]
    pointers = [a.ctypes.data for a in (model, imu, measured, mean, covariance)]
    peer(ticks, STEP_NS * 1e-9, *pointers)
    found = simulate(built, inputs, engine="c").output
    np.testing.assert_allclose(found.mean, mean, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=0.0, atol=1e-9)
    a, b, ratio = interleaved(
        lambda: ours() * scale,
        lambda: seconds(lambda: peer(ticks, STEP_NS * 1e-9, *pointers)) * scale,
        repeats,
    )
    return [Row(name, a, b, "us", "Eigen -O3", ratio, "ratio <= 1", ratio <= 1.0)]
