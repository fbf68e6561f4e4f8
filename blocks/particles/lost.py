"""Clouds that have lost track: how that is seen, what a cloud then believes, and how it is said.

A cloud is judged as a Kalman filter is, by its mean and its covariance: a measurement far beyond what they
expect is an outlier, or the cloud is not where it should be. Weights alone do not tell: some particle is
always the nearest, and takes all the weight. A cloud whose effective sample size is below the number of
particles that a covariance takes is depleted; that happens to a healthy one too, at a sharp measurement after
a vague start, but not again and again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, Scalar, Series, block
from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.kalman.filters import accepts
from flowgraph.blocks.kalman.lost import FARTHEST, in_doubt
from flowgraph.blocks.signals import Cloud, Depletion, KalmanInnovation, Pose
from flowgraph.data.notes import note
from flowgraph.recorder.namespaces import solve_positive

__all__ = [
    "BELIEVED",
    "believe_pose",
    "depletion",
    "depletion_remarks",
    "judge_pose",
    "judged",
    "mixture",
    "pose_within_reach",
    "verdict",
    "within_reach",
]

BELIEVED = 1.0 - 1e-6
"""The probability with which a measurement is as near as an honest cloud expects; beyond, a cloud is lost."""

_REACH = 1e12

_ORIGIN = (0.0, 0.0, 0.0)


def mixture(weight: Array, residuals: Array, *, xp: Any) -> tuple[Array, Array]:
    """The mean (m) and covariance (m, m) of residuals (m, n) over a cloud with these weights (n)."""
    mean = residuals @ weight
    apart = residuals - mean[:, None]
    return mean, (apart * weight) @ apart.mT


def within_reach(x: Array, *, xp: Any) -> Array:
    """Numbers within +-1e12, that their squares be finite; beyond, in any unit here, no measurement lies."""
    return xp.maximum(xp.minimum(x, 0.0 * x + _REACH), 0.0 * x - _REACH)


@block
def pose_within_reach(pose: Pose, *, xp: Any) -> Pose:
    """A pose whose position is `within_reach`; NaN stays."""
    return Pose(position=within_reach(pose.position, xp=xp), attitude=pose.attitude)


def verdict(
    state: Array,
    residual: Array,
    S: Array,
    present: Array,
    *,
    gate: float | None,
    patience: int,
    at_once: bool = False,
    xp: Any,
) -> tuple[Array, KalmanInnovation, Array]:
    """Whether a cloud, taken for the Gaussian of its mean and covariance, believes a measurement.

    Whether it has lost track is as in `kalman.lost.in_doubt`; such a cloud must grow, or start anew, before
    it is corrected. What is too far off before is refused with a gate, and believed all the same without one.

    Args:
        state: how many measurements were too far off in a row.
        residual: measured minus predicted by the cloud's mean (m), 0 where an entry is missing.
        S: the covariance of it (m, m).
        present: (m) which entries there are.
        gate: below 1 the probability with which an honest measurement passes, from 1 on the largest nis;
            `BELIEVED` if left out.
        patience: how many in a row are taken for outliers.
        at_once: whether, without a gate, already the first shows that the cloud has lost track.

    Returns:
        How many were too far off in a row; the innovation; and the factor by which the variances must grow:
        1, or where track was lost the nis over its mean, at least 16.
    """
    most = 1e10 * xp.sqrt(
        xp.sum(S * xp.eye(S.shape[-1], dtype=S.dtype), axis=-1)
    )  # its nis is beyond FARTHEST
    residual = xp.maximum(xp.minimum(residual, most), -most)
    nis = xp.sum(residual * solve_positive(S, residual[:, None], xp)[:, 0])
    parts = xp.sum(xp.astype(present, S.dtype))
    usable = nis < FARTHEST
    near = accepts(nis, BELIEVED if gate is None else gate, present, xp) & usable
    wait = 0.0 if gate is None and at_once else float(patience)
    far, lost, grow = in_doubt(state, near, nis, parts, patience=wait, xp=xp)
    far = xp.where(parts > 0.0, far, state)  # of what was not measured nothing is learned
    accepted = usable if gate is None else near | lost
    innovation = KalmanInnovation(residual=residual, covariance=S, nis=nis, parts=parts, accepted=accepted)
    return far, innovation, grow


def judged(
    state: Array, residual: Array, S: Array, *, gate: float | None, patience: int, xp: Any
) -> tuple[Array, KalmanInnovation, Array]:
    """`verdict` on the entries of a residual (m) that are not NaN."""
    present = ~xp.isnan(residual)
    S = xp.where(present[:, None] & present[None, :], S, xp.eye(S.shape[-1], dtype=S.dtype))
    residual = xp.where(present, residual, 0.0)
    return verdict(state, residual, S, present, gate=gate, patience=patience, xp=xp)


@block
def judge_pose(
    state: Any,
    cloud: Cloud,
    pose: Pose,
    *,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = _ORIGIN,
    gate: float | None = None,
    patience: int,
    xp: Any,
) -> tuple[Any, tuple[KalmanInnovation, Scalar]]:
    """The innovation (m, world; rad, body) of a whole cloud at a measured pose, and whether to believe it.

    Of a pose of which some entries are NaN, the others are judged; a NaN in the quaternion takes all of the
    attitude with it.

    Its covariance is that of the particles' innovations, the mean of their own and the noise. Whether it
    is believed is as in `verdict`.

    Args:
        cloud: at the time of the pose.
        position_noise, attitude_noise: standard deviations, m and rad.
        lever: the point whose position is measured, m, body.
        gate, patience: as in `verdict`.

    Returns:
        The innovation; and 1, or where the cloud has lost track and must start anew the factor by which its
        variances must grow.

    State: how many poses were too far off in a row.
    """
    weight = xp.exp(cloud.log_weight)
    point = cloud.position
    if lever != _ORIGIN:
        point = point + lanes.rotate(cloud.attitude, xp.asarray(lever, dtype=point.dtype), xp=xp)
    turn = lanes.rotation_vectors_to(cloud.attitude, pose.attitude, xp=xp)
    mean, S = mixture(weight, xp.concat([-point, turn], axis=0), xp=xp)
    mean = mean + xp.concat([pose.position, 0.0 * cloud.position[:, 0]])
    own = xp.sum(cloud.position_covariance * weight, axis=-1)
    wide = xp.asarray(np.eye(3, 6), dtype=S.dtype)
    noise = np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3)
    S = S + wide.mT @ own @ wide + xp.asarray(noise, dtype=S.dtype)
    count, innovation, grow = judged(state, mean, 0.5 * (S + S.mT), gate=gate, patience=patience, xp=xp)
    return count, (innovation, grow)


@judge_pose.init
def _none_refused(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)


@block
def believe_pose(
    prior: Cloud,
    posterior: Cloud,
    pose: Pose,
    innovation: KalmanInnovation,
    grow: Scalar,
    *,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = _ORIGIN,
    draw: Any,
    xp: Any,
) -> Cloud:
    """The corrected cloud where the pose is believed, the prior where it is not, and a new one where track
    was lost.

    A new cloud is equally weighted and lies about the measured pose, with its noise; the velocities stay,
    with variances `grow` times as large, and so does what was not measured of the pose (NaN), attitudes as
    they are. Draws `anew` (3, n).

    Args:
        prior, posterior: before and after the correction.
        pose: the measurement; innovation, grow: what `judge_pose` found.
        position_noise, attitude_noise, lever: as there.
    """
    believed = innovation.accepted
    posterior = _anew(prior, posterior, pose, grow, position_noise, attitude_noise, lever, draw, xp)
    chosen = {
        name: xp.where(believed, getattr(posterior, name), getattr(prior, name)) for name in prior._fields
    }
    return Cloud(**chosen)


def _anew(
    prior: Cloud, posterior: Cloud, pose: Pose, grow: Array, position_noise: float, attitude_noise: float,
    lever: tuple[float, float, float], draw: Any, xp: Any,
) -> Cloud:  # fmt: skip
    kind, n = prior.position.dtype, prior.log_weight.shape[-1]
    errors = xp.asarray(draw.normal("anew", (3, n)), dtype=kind) * attitude_noise
    measured = pose.attitude[:, None] + 0.0 * prior.attitude
    q = lanes.normalize(lanes.multiply(measured, lanes.exponential(errors, xp=xp), xp=xp), xp=xp)
    q = xp.where(xp.any(xp.isnan(pose.attitude)), prior.attitude, q)
    p = pose.position[:, None] - lanes.rotate(q, xp.asarray(lever, dtype=kind), xp=xp)
    seen = ~xp.isnan(pose.position)
    one = xp.asarray(np.eye(3)[:, :, None], dtype=kind)
    fixed = one * position_noise**2 + 0.0 * prior.position_covariance
    vague = grow * prior.position_covariance
    both = (seen[:, None] | seen[None, :])[:, :, None]
    fresh = Cloud(
        log_weight=0.0 * prior.log_weight - float(np.log(n)),
        attitude=q,
        velocity=prior.velocity,
        position=xp.where(seen[:, None], p, prior.position),
        velocity_covariance=grow * prior.velocity_covariance,
        cross_covariance=0.0 * prior.cross_covariance,
        position_covariance=xp.where(both, fixed, vague),
    )
    gone = grow > 1.0
    return Cloud(
        **{name: xp.where(gone, getattr(fresh, name), getattr(posterior, name)) for name in prior._fields}
    )


@block
def depletion(effective_sample_size: Scalar, *, numbers: int) -> Depletion:
    """Whether too few particles have the weight: fewer than numbers + 1, of which a covariance is made.

    Args:
        effective_sample_size: before resampling.
        numbers: of a particle that are drawn.
    """
    return Depletion(depleted=effective_sample_size < numbers + 1.0)


IN_A_ROW = 3
"""Depleted updates in a row from which on a cloud does not cover what it should."""

OFTEN = 0.2
"""Or this part of all updates."""


def depletion_remarks(name: str, depleted: Series) -> tuple[str, ...]:
    """A note where a cloud was depleted `IN_A_ROW` times or more in a row, or `OFTEN`.

    Args:
        name: of the cloud; empty where there is one.
        depleted: `Depletion`s.
    """
    there = depleted["depleted"]
    edges = np.diff(np.concatenate([[0], there, [0]]).astype(int))
    first = np.flatnonzero(edges > 0)
    rows = np.flatnonzero(edges < 0) - first
    if not len(rows) or (rows.max() < IN_A_ROW and rows.sum() < max(IN_A_ROW, OFTEN * len(there))):
        return ()
    k = int(rows.argmax())
    seconds = (depleted.time[first[k]] - depleted.time[0]) * 1e-9
    what = f"{name}: " if name else ""
    return (
        note(
            "warning",
            f"{what}the cloud was depleted, hardly a particle where the measurements are, {rows[k]} times in"
            f" a row from {seconds:.3g} s after the first on; {int(there.sum())} of {len(there)} in all",
        ),
    )
