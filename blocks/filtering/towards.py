"""States that are moved towards a measurement, each by the gain of their sample covariance.

    x_i' = x_i plus C_xz (C_zz + R)^-1 (z minus h(x_i) - v_i)      v_i ~ N(0, R)

That is the correction of an ensemble. It is also the way back of a cloud whose gate refuses one measurement
after the other: its weights cannot help, since no particle is where it should be.

Source: G. Burgers, P. van Leeuwen and G. Evensen, "Analysis scheme in the ensemble Kalman filter", Monthly
Weather Review 126(6), 1998, eqs. 13-20.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import accepts, masked
from flowgraph.blocks.kalman.triangles import semidefinite_root
from flowgraph.blocks.signals import KalmanInnovation
from flowgraph.blocks.statespace import Measurement

__all__ = ["Moved", "deviations", "find_cloud_back", "moved_towards"]


class Moved(NamedTuple):
    """The states (n, size), the innovation of their mean, and which entries were measured (m)."""

    state: Array
    innovation: KalmanInnovation
    present: Array


def moved_towards(
    x: Array, message: Any, measurement: Measurement, gate: float | None, draw: Any, xp: Any
) -> Moved:
    """States (n, size) of equal weight after a measurement. Draws `seen` (n, m), its noise at each."""
    n, kind, space = x.shape[0], x.dtype, measurement.space
    measured = measurement.vector(message, xp)
    if measurement.inside:
        root = semidefinite_root(measurement.covariance(message, 0, kind, xp), xp=xp)
        v = xp.asarray(draw.normal("seen", (n, root.shape[-1])), dtype=kind) @ root.mT
        z = measurement.seen(x, v, message, xp)
        apart = measurement.apart(measured, z, xp)
        R = xp.zeros((apart.shape[-1], apart.shape[-1]), dtype=kind)  # it is in z already
    else:
        z = measurement.seen(x, None, message, xp)
        apart = measurement.apart(measured, z, xp)
        R = measurement.covariance(message, apart.shape[-1], kind, xp)
    present = ~xp.isnan(apart[0, :])
    away, middle = deviations(z, measurement.measured_space, xp)
    X, _ = deviations(x, space, xp)
    away, R = xp.where(present, away, 0.0), masked(R, R, present, xp)[1]
    S = away.mT @ away / (n - 1.0) + R
    residual = xp.where(present, measurement.apart(measured, middle, xp), 0.0)
    solved = xp.linalg.solve(S, xp.concat([away.mT @ X / (n - 1.0), residual[:, None]], axis=-1))
    nis = residual @ solved[:, -1]
    accepted = accepts(nis, gate, present, xp)
    apart = xp.where(present, apart, 0.0)
    if not measurement.inside:
        v = xp.asarray(draw.normal("seen", (n, R.shape[-1])), dtype=kind) @ semidefinite_root(R, xp=xp).mT
        apart = apart - xp.where(present, v, 0.0)
    shift = (apart @ solved[:, :-1]) * xp.astype(accepted, kind)
    innovation = KalmanInnovation(
        residual=residual,
        covariance=S,
        nis=nis,
        parts=xp.sum(xp.astype(present, kind)),
        accepted=accepted,
    )
    return Moved(space.plus(x, shift, xp), innovation, present)


def deviations(x: Array, space: StateSpace | None, xp: Any) -> tuple[Array, Array]:
    """How far each (n, t) of some states or measurements is from their mean, and the mean (size)."""
    n = x.shape[0]
    if space is None:
        mean = xp.sum(x, axis=0) / n
        return x - mean, mean
    mean = space.mean(x, xp.zeros((n,), dtype=x.dtype) + 1.0 / n, xp)
    return space.minus(x, mean[None, :], xp), mean


@block
def find_cloud_back(  # type: ignore[no-untyped-def]
    state, before: Any, cloud: Any, message: Any | None, innovation: Any | None, *,
    measurement: Measurement, patience: int, draw: Any, xp: Any,
):  # fmt: skip
    """Bring particles back whose gate refuses one measurement after the other.

    The first `patience` refusals in a row change nothing: they may be outliers. From then on each takes all
    particles four times as far from their mean and gives them the same weight. The first measurements that
    pass then, one more than `patience`, move them in place of weighing them, since so wide a cloud has few
    particles near what is measured. Draws `seen` (particles, m).

    Args:
        before, cloud: particles with or without weights, before and after the correction; a `covariance` of
            theirs is made sixteen times as large by each refusal.
        message: what was measured; or absent.
        innovation: of that correction, where there was one.
        measurement: what is seen of a state.
        patience: how many refusals in a row are taken for outliers.

    State: how many measurements were refused in a row; below zero, how many are still to move them.
    """
    if message is None or innovation is None:
        return state, cloud
    x, space = before.state, measurement.space
    passed, most = innovation.accepted, float(patience)
    settling = xp.where(state > most, -most, xp.minimum(state + 1.0, 0.0))
    count = xp.where(passed, settling, xp.maximum(state, 0.0) + 1.0)
    lost, back = count > most, passed & ((state > most) | (state < 0.0))
    apart, mean = deviations(x, space, xp)
    wide = space.plus(mean[None, :], 4.0 * apart, xp)
    moved = moved_towards(x, message, measurement, None, draw, xp).state
    found = {"state": xp.where(lost, wide, moved)}
    if "log_weight" in cloud._fields:
        found["log_weight"] = xp.zeros((x.shape[0],), dtype=x.dtype) - math.log(x.shape[0])
    if "covariance" in cloud._fields:
        found["covariance"] = xp.where(lost, 16.0 * before.covariance, cloud.covariance)
    kept = {name: xp.where(lost | back, new, getattr(cloud, name)) for name, new in found.items()}
    return count, cloud.replace(**kept)


@find_cloud_back.init
def _none(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)
