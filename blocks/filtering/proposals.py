"""Proposals: how particles are drawn from those before them.

    bootstrap  each particle draws the noise of its step, and a measurement weighs it
    guided     draws the noise knowing the measurement, from the Gaussian that the model linearised about each
               particle gives; the weight makes up for it, so nothing but the variance changes
    proposed   draws it from a Gaussian of the user's
    auxiliary  first draws which particles go on, by how well each one's prediction without noise explains the
               measurement, and then moves them, by their noise or by a proposal of the user's

With a particle x, noise w = L e, e ~ N(0, I), and the measurement linearised in e, z = h(x') + G e, S = G G^T
+ R, a guided draw is

    e ~ N(K r, I - K G)      r = z minus h(move(x, u, 0))      K = G^T S^-1
    weight * p(z | x') p(e) / q(e)

Sources: N. Gordon, D. Salmond and A. Smith, IEE Proceedings F 140(2), 1993 (bootstrap); A. Doucet, S. Godsill
and C. Andrieu, "On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics and Computing
10, 2000, secs. II-B (any proposal) and II-D (guided); M. Pitt and N. Shephard, "Filtering via simulation:
auxiliary particle filters", JASA 94, 1999.
"""

from __future__ import annotations

import math
from typing import Any

from flowgraph import Array, Scalar, block, when
from flowgraph.blocks.filtering.weighing import (
    chosen,
    expected,
    likelihoods,
    residuals,
    weighed,
)
from flowgraph.blocks.particles.resampling import ancestor_index
from flowgraph.blocks.signals import KalmanInnovation, StateCloud
from flowgraph.blocks.statespace import Handed, Measurement, Motion
from flowgraph.errors import DeclarationError
from flowgraph.recorder.derivatives import jacobian
from flowgraph.recorder.namespaces import solve_positive

__all__ = ["PROPOSALS", "auxiliary_cloud", "carry_cloud", "guide_cloud", "propose_cloud"]

PROPOSALS = ("bootstrap", "guided", "auxiliary")
"""How particles are drawn, by name."""


@block
def carry_cloud(
    cloud: StateCloud, control: Any | None, *, motion: Motion, dt: float, draw: Any, xp: Any
) -> StateCloud:
    """Each particle after `dt` seconds of the motion with a noise of its own: x' = move(x, u, L e, dt).

    With dt = 0, as at the first firing, this is the identity. Draws `noise` (particles, n_w).
    """
    x = cloud.state
    e = drawn(motion, control, x.shape[0], dt, draw, x.dtype, xp)
    return cloud.replace(state=motion.carry(x, control, shaken(motion, control, e, dt, x.dtype, xp), dt, xp))


def drawn(motion: Motion, control: Any, n: int, dt: Any, draw: Any, kind: Any, xp: Any) -> Array | None:
    """Standard normal numbers (n, n_w); None without noise."""
    root = motion.noise_root(control, dt, kind, xp)
    if root is None:
        return None
    return xp.asarray(draw.normal("noise", (n, root.shape[-1])), dtype=kind)


def shaken(motion: Motion, control: Any, e: Array | None, dt: Any, kind: Any, xp: Any) -> Array | None:
    """The noises (n, n_w) of these numbers; None without noise."""
    root = motion.noise_root(control, dt, kind, xp)
    return None if root is None or e is None else (root @ e.mT).mT


@block
def guide_cloud(
    cloud: StateCloud,
    control: Any | None,
    message: Any | None,
    *,
    motion: Motion,
    measurement: Measurement,
    gate: float | None = None,
    dt: float,
    draw: Any,
    xp: Any,
) -> tuple[StateCloud, StateCloud, KalmanInnovation | None, Scalar | None]:
    """`carry_cloud`, and with a measurement the noise drawn to explain it and the weights corrected for that.

    Draws `noise` (particles, n_w).

    Returns:
        The cloud as it would be without the measurement, which has the same draws; the cloud with it; and
        where there was one the innovation and the log-likelihood.
    """
    x, kind = cloud.state, cloud.state.dtype
    e = drawn(motion, control, x.shape[0], dt, draw, kind, xp)
    carry = lambda e, xp: motion.carry(x, control, shaken(motion, control, e, dt, kind, xp), dt, xp)
    plain = cloud.replace(state=carry(e, xp))
    if message is None:
        return plain, plain, None, None
    if e is None:
        raise _unguided(motion)
    still = _still(measurement, message, x, xp)
    centre = carry(0.0 * e, xp)
    residual, R, present, _ = residuals(centre, message, measurement, xp)
    here = measurement.seen(centre, still, message, xp)
    seen = lambda e, xp: measurement.apart(measurement.seen(carry(e, xp), still, message, xp), here, xp)
    G = jacobian(seen, 0.0 * e, xp)[1] * xp.astype(present, kind)[:, None]
    gain = solve_positive(G @ G.mT + R, xp.concat([G, residual[..., None]], axis=-1), xp)
    one = xp.eye(e.shape[-1], dtype=kind)
    spread = xp.linalg.cholesky(one - G.mT @ gain[..., :-1])
    guided = (G.mT @ gain[..., -1:] + spread @ e[..., None])[..., 0]
    moved = plain.replace(state=carry(guided, xp))
    determinant = xp.sum(xp.log(xp.sum(spread * one, axis=-1)), axis=-1)
    ratio = 0.5 * xp.sum(e * e - guided * guided, axis=-1) + determinant
    found, whole = weighed(moved, likelihoods(moved.state, message, measurement, xp) + ratio, xp)
    return _with_innovation(plain, found, whole, message, measurement, gate, xp)


@block
def propose_cloud(
    cloud: StateCloud, control: Any | None, message: Any | None, *,
    motion: Motion, measurement: Measurement, propose: Handed, gate: float | None = None,
    dt: float, draw: Any, xp: Any,
) -> tuple[StateCloud, StateCloud, KalmanInnovation | None, Scalar | None]:  # fmt: skip
    """`carry_cloud`, and with a measurement the noise drawn from a Gaussian of the user's.

        w_i ~ N(mean_i, C_i), as `propose` says      weight * p(z | x_i') p(w_i) / q(w_i)

    Draws `noise` (particles, n_w).

    Args:
        propose: `propose(x, u, z, dt, xp) -> (mean, covariance)` of w, (n, n_w) and (n, n_w, n_w) or
            (n_w, n_w), the covariance positive definite.

    Returns:
        As `guide_cloud`.
    """
    x, kind = cloud.state, cloud.state.dtype
    e = drawn(motion, control, x.shape[0], dt, draw, kind, xp)
    plain = cloud.replace(state=motion.carry(x, control, shaken(motion, control, e, dt, kind, xp), dt, xp))
    if message is None:
        return plain, plain, None, None
    w, ratio = _proposed(x, control, message, e, motion, measurement, propose, dt, xp)
    moved = plain.replace(state=motion.carry(x, control, w, dt, xp))
    found, whole = weighed(moved, likelihoods(moved.state, message, measurement, xp) + ratio, xp)
    return _with_innovation(plain, found, whole, message, measurement, gate, xp)


def _proposed(
    x: Array, control: Any, message: Any, e: Array | None, motion: Motion, measurement: Measurement,
    propose: Handed, dt: Any, xp: Any,
) -> tuple[Array, Array]:  # fmt: skip
    """Noises (n, n_w) of the user's proposal, and log p(w) / q(w) (n). Over no time there is no noise."""
    if e is None:
        raise _unguided(motion)
    kind, n = x.dtype, x.shape[0]
    z = measurement.vector(message, xp)
    mean, C = propose(motion.space.view(x, xp), control, z=z, dt=dt, xp=xp)
    goes = xp.asarray(dt, dtype=kind) > 0.0
    root: Any = motion.noise_root(control, dt, kind, xp)
    one = xp.eye(e.shape[-1], dtype=kind)
    safe = xp.where(goes, root, one)
    mean, C = xp.broadcast_to(mean, (n, e.shape[-1])), xp.broadcast_to(C, (n, *one.shape))
    L = xp.linalg.cholesky(xp.where(goes, C, one))
    # in units of the noise itself: w = root e'
    middle = xp.linalg.solve(safe, mean.mT).mT
    spread = xp.linalg.solve(xp.broadcast_to(safe, (n, *one.shape)), L)
    guided = middle + (spread @ e[..., None])[..., 0]
    determinant = xp.sum(xp.log(xp.sum(spread * one, axis=-1)), axis=-1)
    ratio = 0.5 * xp.sum(e * e - guided * guided, axis=-1) + determinant
    return guided @ root.mT, xp.where(goes, ratio, 0.0)


@block
def auxiliary_cloud(
    cloud: StateCloud, control: Any | None, message: Any | None, *,
    motion: Motion, measurement: Measurement, scheme: str, propose: Handed | None = None,
    gate: float | None = None, dt: float, draw: Any, xp: Any,
) -> tuple[StateCloud, StateCloud, KalmanInnovation | None, Scalar | None]:  # fmt: skip
    """`carry_cloud`, of the particles whose prediction without noise explains the measurement.

        a_i drawn by w_j p(z | move(x_j, 0))      x_i' = move(x_a, L e_i)
        weight p(z | x_i') / p(z | move(x_a, 0))

    With `propose` the noise is drawn as in `propose_cloud`, and the weight has p(w) / q(w) as well.

    Draws `noise` (particles, n_w) and `place`, as the scheme has it.

    Returns:
        As `guide_cloud`.
    """
    x, kind, n = cloud.state, cloud.state.dtype, cloud.state.shape[0]
    e = drawn(motion, control, n, dt, draw, kind, xp)
    w = shaken(motion, control, e, dt, kind, xp)
    plain = cloud.replace(state=motion.carry(x, control, w, dt, xp))
    if message is None:
        return plain, plain, None, None
    without = None if w is None else 0.0 * w
    pilot = likelihoods(motion.carry(x, control, without, dt, xp), message, measurement, xp)
    fitting, ahead = weighed(cloud, pilot, xp)
    index = ancestor_index(xp.exp(fitting.log_weight), scheme=scheme, draw=draw, xp=xp)
    before = xp.take(x, index, axis=0)
    if propose is not None:
        w, drawn_for = _proposed(before, control, message, e, motion, measurement, propose, dt, xp)
    moved = motion.carry(before, control, w, dt, xp)
    even = StateCloud(log_weight=xp.zeros((n,), dtype=kind) - math.log(n), state=moved)
    ratio = likelihoods(moved, message, measurement, xp) - xp.take(pilot, index, axis=0)
    ratio = ratio if propose is None else ratio + drawn_for
    found, whole = weighed(even, ratio, xp)
    return _with_innovation(plain, found, ahead + whole, message, measurement, gate, xp)


def _still(measurement: Measurement, message: Any, x: Array, xp: Any) -> Array | None:
    """No noise (n, n_v), of a measurement into which it goes; else None."""
    if not measurement.inside:
        return None
    size = measurement.covariance(message, 0, x.dtype, xp).shape[-1]
    return xp.zeros((x.shape[0], size), dtype=x.dtype)


def _unguided(motion: Motion) -> DeclarationError:
    return DeclarationError(
        "particles of a motion without noise cannot be guided",
        path="particles.proposal",
        expected="a motion with noise to draw",
        got=repr(motion),
        fix='write particles(n, proposal="bootstrap")',
    )


def _with_innovation(
    plain: StateCloud, found: StateCloud, whole: Array, message: Any, measurement: Measurement,
    gate: float | None, xp: Any,
) -> tuple[Any, Any, Any, Any]:  # fmt: skip
    residual, R, present, _ = residuals(plain.state, message, measurement, xp)
    here = xp.any(present)
    innovation = expected(plain, residual, R, present, gate, xp)
    kept = chosen(found, plain, innovation, gate, xp)
    return plain, kept, when(here, innovation), when(here, whole)
