"""Calibration of an inertial unit: what a count of its converters is worth, by what a motion capture saw.

The unit turns with the body, so over a window of the motion capture's samples

    mean rate = log(R_0^T R_1) / (t_1 - t_0)            in the body; log(R_1 R_0^T) would be the world's
    mean force = R_m^T (0, 0, g)                        in the middle, when the body hardly accelerates

and each is taken as linear in the mean counts c over the same window, y = [c, 1] beta. Least squares gives
beta = (A^T A)^-1 A^T y. A window of several samples, because the stamps of both sides jitter; counts are
averaged by their integral over time, so the two sides need no common clock, only a known offset.

A motion capture loses markers and a hand accelerates: such windows do not fit, and a few bend the result. So
the fit over recordings, `fit_counts`, weights each window by how well it fits (iteratively, with Tukey's
function), and the blocks take a prior calibration and a gate.

Sources: J. Beaton and J. Tukey, "The fitting of power series, meaning polynomials, illustrated on
band-spectroscopic data", Technometrics 16(2), 1974 (the weights); J. Solà, "Quaternion kinematics for the
error-state Kalman filter", arXiv:1711.02508, 2017, eq. 105 (the logarithm).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, block, when
from flowgraph.blocks.geometry.rotations import conjugate, multiply, rotate, to_rotation_vector
from flowgraph.blocks.signals import Attitude, CountsSum, Imu, ImuCounts, NormalEquations, Window
from flowgraph.errors import DataError

__all__ = [
    "CountsCalibration",
    "calibrated",
    "collect_equations",
    "fit_counts",
    "solve_equations",
    "sum_counts",
    "window_means",
    "windows_of",
]

G = 9.81
LONGEST = 0.3
"""The longest window, s: one in which the motion capture lost the body does not count."""

RIDGE = 1e-4
CENTRE, SPAN = 512.0, 100.0
"""Counts are shifted and scaled by these before they are squared, so that the equations stay well
conditioned."""

LEAST = 50
"""The fewest windows that a fit is made of."""

SAMPLES = 5
"""Motion capture samples on either side of a window's middle; at 100 Hz the window lasts 0.1 s."""


@dataclass(frozen=True)
class CountsCalibration:
    """reading = scale @ counts + constant, for gyroscope and accelerometer.

    Args:
        gyro: 3 x 3, rad/s per count. gyro_constant: 3, rad/s.
        force: 3 x 3, m/s^2 per count. force_constant: 3, m/s^2.
    """

    gyro: tuple[tuple[float, float, float], ...]
    gyro_constant: tuple[float, float, float]
    force: tuple[tuple[float, float, float], ...]
    force_constant: tuple[float, float, float]

    @classmethod
    def of(cls, gyro: npt.ArrayLike, force: npt.ArrayLike) -> CountsCalibration:
        """From beta (4, 3) of each: three rows per count, and the constant."""
        g, f = np.asarray(gyro, dtype=float), np.asarray(force, dtype=float)
        return cls(_rows(g[:3].T), _three(g[3]), _rows(f[:3].T), _three(f[3]))

    @property
    def gyro_zero(self) -> np.ndarray:
        """The counts (3) of no rate."""
        return np.linalg.solve(np.array(self.gyro), -np.array(self.gyro_constant))

    @property
    def force_zero(self) -> np.ndarray:
        """The counts (3) of no force."""
        return np.linalg.solve(np.array(self.force), -np.array(self.force_constant))


def _three(v: Any) -> tuple[float, float, float]:
    a, b, c = np.asarray(v, dtype=float).tolist()
    return a, b, c


def _rows(m: Any) -> tuple[tuple[float, float, float], ...]:
    return tuple(_three(row) for row in m)


@block
def calibrated(counts: ImuCounts, *, calibration: CountsCalibration, xp: Any) -> Imu:
    """The reading in SI units: scale @ counts + constant, for gyroscope and accelerometer."""
    kind = counts.gyro.dtype
    c = calibration

    def of(x: Array, scale: Any, constant: Any) -> Array:
        return x @ xp.asarray(np.array(scale).T, dtype=kind) + xp.asarray(constant, dtype=kind)

    return Imu(
        gyro=of(counts.gyro, c.gyro, c.gyro_constant),
        specific_force=of(counts.force, c.force, c.force_constant),
    )


@block
def sum_counts(  # type: ignore[no-untyped-def]
    state, counts: ImuCounts | None, attitude: Attitude | None, *, dt: float, xp: Any
) -> tuple[Any, CountsSum]:
    """The integral of the counts, each reading held until the next, at every reading and every attitude.

    State: the integral, and the last reading.
    """
    total = state["total"] + state["last"] * dt
    if counts is None:
        now = CountsSum(total=total, running=state["running"])
        return {"total": total, "last": state["last"], "running": state["running"]}, now
    reading = xp.concat([counts.gyro, counts.force], axis=-1)
    one = state["running"] * 0.0 + 1.0
    return {"total": total, "last": reading, "running": one}, CountsSum(total=total, running=one)


@sum_counts.init
def _(*_: Any, **__: Any) -> dict[str, Any]:
    return {"total": np.zeros(6), "last": np.zeros(6), "running": np.float64(0.0)}


@block
def window_means(  # type: ignore[no-untyped-def]
    state,
    sums: CountsSum,
    attitude: Attitude,
    *,
    samples: int = SAMPLES,
    longest: float = LONGEST,
    dt: float,
    xp: Any,
) -> tuple[Any, Window | None]:
    """Mean counts, rate and gravity over the window of the last 2 `samples` + 1 attitudes.

        counts = (S(t_1) - S(t_0)) / (t_1 - t_0)      rate = log(R_0^T R_1) / (t_1 - t_0)
        force  = R_m^T (0, 0, 9.81)

    Present once there are so many attitudes and the unit ran through all of them, and where they lie within
    `longest` seconds (the motion capture may have lost the body in between).

    Args:
        sums: the integral of the counts.
        attitude: body to world, from a motion capture.
        samples: on either side of the middle.
        longest: s.

    State: the attitudes, their times and the integral at each, the newest last, and how many there were.
    """
    elapsed = state["elapsed"] + dt
    q = xp.concat([state["q"][1:, :], attitude.attitude[None, :]], axis=0)
    t = xp.concat([state["t"][1:], xp.reshape(elapsed, (1,))], axis=0)
    s = xp.concat([state["s"][1:, :], sums.total[None, :]], axis=0)
    count = (state["count"] + 1.0) * sums.running
    span = xp.maximum(t[-1] - t[0], 1e-9)
    turn = multiply(conjugate(q[0, :], xp=xp), q[-1, :], xp=xp)
    up = xp.asarray((0.0, 0.0, G), dtype=q.dtype)
    found = Window(
        counts=(s[-1, :] - s[0, :]) / span,
        rate=to_rotation_vector(turn, xp=xp) / span,
        force=rotate(conjugate(q[samples, :], xp=xp), up, xp=xp),
    )
    after = {"q": q, "t": t, "s": s, "count": count, "elapsed": elapsed}
    return after, when((count > 2.0 * samples) & (span <= longest), found)


@window_means.init
def _(*_: Any, samples: int, **__: Any) -> dict[str, Any]:
    n = 2 * samples + 1
    none = {"t": np.zeros(n), "s": np.zeros((n, 6)), "count": np.float64(0.0), "elapsed": np.float64(0.0)}
    return {"q": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), **none}


@block
def collect_equations(
    so_far: NormalEquations,
    window: Window | None,
    *,
    prior: CountsCalibration | None = None,
    gate: tuple[float, float] | None = None,
    xp: Any,
) -> NormalEquations:
    """Add a window to A^T A and A^T y, with a = [(c - CENTRE) / SPAN, 1]: a a^T and a y^T.

    Args:
        prior, gate: when both are given, a window whose rate or force differs by more than `gate` (rad/s,
            m/s^2) from what `prior` makes of its counts does not count in that fit.
    """
    if window is None:
        return so_far
    kind = window.counts.dtype
    one = xp.ones((1,), dtype=kind)
    added = []
    for part, y, k in ((window.counts[:3], window.rate, 0), (window.counts[3:], window.force, 1)):
        weight = one[0]
        if prior is not None and gate is not None:
            scale, constant = (
                (prior.gyro, prior.gyro_constant) if k == 0 else (prior.force, prior.force_constant)
            )
            expected = part @ xp.asarray(np.array(scale).T, dtype=kind) + xp.asarray(constant, dtype=kind)
            off = xp.linalg.vecdot(y - expected, y - expected)
            weight = xp.astype(off <= gate[k] ** 2, kind)
        a = xp.concat([(part - CENTRE) / SPAN, one], axis=0)
        added.append((a[:, None] * a[None, :] * weight, a[:, None] * y[None, :] * weight, weight))
    (gg, gy, gw), (ff, fy, fw) = added
    return NormalEquations(
        gyro_square=so_far.gyro_square + gg,
        gyro_right=so_far.gyro_right + gy,
        force_square=so_far.force_square + ff,
        force_right=so_far.force_right + fy,
        used=so_far.used + xp.stack([gw, fw]),
    )


@block
def solve_equations(equations: NormalEquations, *, xp: Any) -> tuple[Array | None, Array | None]:
    """beta = (A^T A)^-1 A^T y of gyroscope and accelerometer, (4, 3) each: three rows per count, a constant.

    Each is present once `LEAST` windows counted in it. A small multiple of the unit matrix (`RIDGE`) stands
    in for what has not been seen; it is lost in the rounding once the body has turned about all axes.
    """
    kind = equations.gyro_square.dtype
    small = xp.eye(4, dtype=kind) * RIDGE
    back = np.vstack([np.hstack([np.eye(3) / SPAN, np.zeros((3, 1))]), [[-CENTRE / SPAN] * 3 + [1.0]]])
    per_count = xp.asarray(back, dtype=kind)
    gyro = per_count @ xp.linalg.solve(equations.gyro_square + small, equations.gyro_right)
    force = per_count @ xp.linalg.solve(equations.force_square + small, equations.force_right)
    enough = equations.used >= float(LEAST)
    return when(enough[0], gyro), when(enough[1], force)


def windows_of(
    time: np.ndarray,
    counts: np.ndarray,
    truth_time: np.ndarray,
    attitudes: np.ndarray,
    *,
    samples: int = SAMPLES,
    longest: float = LONGEST,
) -> Window:
    """All windows of a recording at once, as `window_means` finds them one by one.

    Args:
        time: (n,) int64 ns of the counts (n, 6): gyro, force.
        truth_time: (m,) int64 ns, on the clock of the counts, of the attitudes (m, 4).

    Raises:
        DataError: where the two share no window.
    """
    dt = np.diff(time) * 1e-9
    total = np.concatenate([np.zeros((1, 6)), np.cumsum(counts[:-1] * dt[:, None], axis=0)])
    inside = (truth_time >= time[0]) & (truth_time <= time[-1])
    t, q = truth_time[inside], attitudes[inside]
    k = np.searchsorted(time, t, side="right") - 1
    s = total[k] + counts[k] * ((t - time[k]) * 1e-9)[:, None]
    n = 2 * samples
    span = (t[n:] - t[:-n]) * 1e-9
    kept = span <= longest
    if not kept.any():
        raise DataError(
            "counts and motion capture share no window",
            path="windows_of",
            expected=f"{n + 1} attitudes within {longest:g} s, while counts are read",
            got=f"{len(t)} attitudes of {len(truth_time)} between the first and the last reading",
            fix="check the time offset of the two sides",
        )
    turn = multiply(conjugate(q[:-n], xp=np), q[n:], xp=np)
    middle = conjugate(q[samples : len(q) - samples], xp=np)
    return Window(
        counts=((s[n:] - s[:-n]) / span[:, None])[kept],
        rate=(to_rotation_vector(turn, xp=np) / span[:, None])[kept],
        force=rotate(middle, np.array([0.0, 0.0, G]), xp=np)[kept],
    )


def fit_counts(
    windows: Sequence[Window], *, robust: bool = True, rounds: int = 30, aligned: bool = False
) -> CountsCalibration:
    """Least squares over the windows of one or more recordings.

    With `aligned` the accelerometer is fitted the other way round, each axis by itself, and solved for f:

        c_k = f_k / s_k + z_k

    What is uncertain is then on the left: a window's counts hold all that accelerates the body, its force is
    nearly exact. Regressed the usual way, y on c, uncertain counts draw the scale towards zero, the more so
    the less the body tilts, and what crosses axes is made of the same motions; far from the tilts that were
    seen, both show as degrees of roll and pitch.

    Args:
        windows: from `windows_of`.
        robust: weight each window by Tukey's function of its residual over 4.685 robust deviations, found
            axis by axis; otherwise all count alike.
        rounds: of weighting.
        aligned: whether the accelerometer's axes are those of the body, with a scale and a zero each.

    Raises:
        DataError: without windows, or when they do not determine the fit (a body that never turned).
    """
    parts = [np.concatenate([getattr(w, n) for w in windows]) for n in ("counts", "rate", "force")] if (
        windows
    ) else [np.zeros((0, 6)), np.zeros((0, 3)), np.zeros((0, 3))]  # fmt: skip
    counts, rate, force = parts
    betas = []
    for name, x, y in (("gyroscope", counts[:, :3], rate), ("accelerometer", counts[:, 3:], force)):
        A = np.column_stack([x, np.ones(len(x))])
        if len(A) < 8 or np.linalg.cond(A) > 1e9:
            raise DataError(
                f"these recordings do not determine the {name}'s calibration",
                path="fit_counts",
                expected="motion about all three axes",
                got=f"{len(A)} windows",
                fix="record motion about each axis, or give other recordings",
            )
        again = rounds if robust else 0
        if aligned and name == "accelerometer":
            betas.append(_by_axis(x, y, again))
        else:
            betas.append(np.column_stack([_weighted(A, y[:, k], again) for k in range(3)]))
    return CountsCalibration.of(*betas)


def _by_axis(counts: np.ndarray, force: np.ndarray, rounds: int) -> np.ndarray:
    """beta (4, 3) of c_k = f_k / s_k + z_k, an axis at a time."""
    beta = np.zeros((4, 3))
    for k in range(3):
        A = np.column_stack([force[:, k], np.ones(len(force))])
        per_force, zero = _weighted(A, counts[:, k], rounds).tolist()
        beta[k, k], beta[3, k] = 1.0 / per_force, -zero / per_force
    return beta


def _weighted(A: np.ndarray, y: np.ndarray, rounds: int) -> np.ndarray:
    beta: np.ndarray = np.linalg.solve(A.T @ A, A.T @ y)
    for _ in range(rounds):
        off = y - A @ beta
        far = off / (4.685 * 1.4826 * max(float(np.median(np.abs(off))), 1e-12))
        weight = np.where(np.abs(far) < 1.0, (1.0 - far**2) ** 2, 0.0)[:, None]
        beta = np.linalg.solve(A.T @ (A * weight), (A * weight).T @ y)
    return beta
