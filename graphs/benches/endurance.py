"""A day of flight in one run: whether memory stays flat, time exact and the covariance one.

A filter that flies for long must not grow, drift in its count of time, or lose the symmetry and the sign of
its covariance to rounding. A body circles for 24 hours with an IMU at 200 Hz and a position at 2 Hz; its
readings are made and filtered a minute at a time, each going on from the state of the one before.
"""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from flowgraph import DeclarationError, Report, Series, find_graph, periodic, simulate
from flowgraph.blocks.inertial import ImuNoise, start_belief
from flowgraph.blocks.signals import GRAVITY, Imu, Position
from flowgraph.data.notes import note

RATE, EVERY, STRETCH = 200, 100, 60
"""Hz of the IMU, its readings to each position, and s that are made and played at a time."""

RADIUS, TURN, APART = 10.0, 0.5, 0.3
"""Of the circle in m, rad/s, and the deviation of a position in m."""

NOISE = ImuNoise(gyro=1e-3, accelerometer=1e-2, gyro_bias=1e-5, accelerometer_bias=1e-4)
LOOKED_AT = 100
"""Ticks from one covariance whose eigenvalues are taken to the next."""


def endurance(*, hours: float = 24.0, engine: str = "c", seed: int = 0) -> Report:
    """`ins_eskf` over a day of flight at 200 Hz, a minute at a time: memory, time and covariance by hour.

    Args:
        hours: of flight.
        engine: that runs it.
        seed: of the noise.

    Raises:
        DeclarationError: for less than a minute.
    """
    stretches = round(hours * 3600 / STRETCH)
    if stretches < 1:
        raise DeclarationError(
            "this bench flies a minute or more",
            path="endurance",
            expected="hours of 0.02 or more",
            got=f"hours={hours:g}",
            fix="write --set hours=24",
        )
    rows = list(_hours(stretches, engine, seed))
    first, last = rows[0], rows[-1]
    grown = last["memory_bytes"] - first["memory_bytes"]
    off = f"time is off by {last['time_error_ns']} ns"
    return Report(
        rows,
        notes=(
            note("info", f"{last['ticks']} ticks; {off}; memory grew by {grown} bytes after the first hour"),
        ),
    )


def _hours(stretches: int, engine: str, seed: int) -> Iterator[dict[str, Any]]:
    start = start_belief(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), velocity=(RADIUS * TURN, 0.0, 0.0))
    graph = find_graph("ins_eskf").build(
        imu=periodic("5ms"), position=periodic("500ms"), start=start, noise=NOISE, position_noise=APART,
    )  # fmt: skip
    bias = np.random.default_rng(seed).normal(size=6) * np.repeat([1e-3, 1e-2], 3)
    state, ticks, wall, of_hour = None, 0, 0.0, 3600 // STRETCH
    errors: list[np.ndarray] = []
    nees: list[np.ndarray] = []
    least, asymmetry = np.inf, 0.0
    for n in range(stretches):
        result = simulate(graph, _readings(n, bias, seed), engine=engine, state=state)
        state, ticks, wall = result.state, ticks + result.ticks, wall + result.wall_s
        belief = result.belief
        off = belief["position"][::LOOKED_AT] - _position(belief.time[::LOOKED_AT])
        P = belief["covariance"][::LOOKED_AT]
        errors.append((off**2).sum(axis=-1))
        nees.append(np.einsum("ni,ni->n", off, np.linalg.solve(P[:, :3, :3], off[..., None])[..., 0]))
        spread = np.sqrt(np.einsum("nii->ni", P))
        scaled = P / (spread[:, :, None] * spread[:, None, :])
        least = min(least, float(np.linalg.eigvalsh(scaled).min()))
        asymmetry = max(asymmetry, float(np.abs(scaled - np.swapaxes(scaled, 1, 2)).max()))
        if (n + 1) % of_hour == 0 or n + 1 == stretches:
            time = int(belief.time[-1])
            yield {
                "hour": (n + 1) / of_hour, "ticks": ticks, "time_s": time * 1e-9,
                "time_error_ns": time - ((n + 1) * STRETCH * 10**9 - 10**9 // RATE),
                "memory_bytes": memory(), "position_rmse_m": float(np.sqrt(np.concatenate(errors).mean())),
                "nees_mean": float(np.concatenate(nees).mean()), "dimension": 3,
                "least_eigenvalue": least, "asymmetry": asymmetry, "us_per_tick": 1e6 * wall / ticks,
            }  # fmt: skip
            errors, nees, least, asymmetry = [], [], np.inf, 0.0


def _readings(stretch: int, bias: np.ndarray, seed: int) -> dict[str, Series]:
    """What the sensors read in the n-th minute."""
    rng = np.random.default_rng([seed, stretch])
    count = RATE * STRETCH
    time = (np.arange(count, dtype=np.int64) + stretch * count) * (10**9 // RATE)
    right = np.array([0.0, 0.0, TURN, 0.0, RADIUS * TURN**2, -GRAVITY[2]])
    spread = np.repeat([NOISE.gyro, NOISE.accelerometer], 3) * np.sqrt(RATE)
    read = right + bias + rng.normal(size=(count, 6)) * spread
    seen = time[::EVERY]
    return {
        "imu": Series(time, Imu(gyro=read[:, :3], specific_force=read[:, 3:])),
        "position": Series(seen, Position(_position(seen) + rng.normal(size=(len(seen), 3)) * APART)),
    }


def _position(time: np.ndarray) -> np.ndarray:
    """Where the body is (n, 3) m, at times (n,) ns."""
    angle = time * 1e-9 * TURN
    return np.stack([RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle)), np.zeros(len(time))], axis=-1)


def memory() -> int:
    """Bytes of memory that this process holds; where the system does not tell, the most that it held."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024
