"""Rao-Blackwellized particles: a part of the state is drawn, the rest is a Gaussian at each particle.

Where a motion and a measurement are linear in some parts l of a state once the others, n, are known, only
those need particles; each has a Kalman filter for the rest. With the derivatives of the model by l and by its
noise at particle i, J = [dx'/dl, dx'/dw], what comes of a step is a Gaussian over all of x',

    x' ~ N(move(n_i, l_i), Sigma)      Sigma = J diag(P_i, W) J^T = L L^T, n before l

    n_i' = n + L_nn e      l_i' = l + L_ln e      P_i' = L_ll L_ll^T      e ~ N(0, I)

of which the first is drawn and the rest is what it tells of l: the last two are a Kalman correction of l with
n' - n. A measurement weighs a particle by N(z minus h; H P H^T + R) and corrects its Gaussian. In parts in
which the model is linear nothing is approximated; in others each particle has an extended filter.

Source: T. Schon, F. Gustafsson, P.-J. Nordlund, "Marginalized particle filters for mixed linear/nonlinear
state-space models", IEEE Trans. on Signal Processing 53(7), 2005; A. Doucet, N. de Freitas, K. Murphy, S.
Russell, "Rao-Blackwellised particle filtering for dynamic Bayesian networks", UAI 2000.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array, Scalar, block, when
from flowgraph.blocks.filtering.gaussian import innovation_log_likelihood
from flowgraph.blocks.filtering.methods import Advanced, Method, Seen
from flowgraph.blocks.filtering.particles import Tick, Weighted, particles
from flowgraph.blocks.filtering.weighing import chosen, weighed
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import correct, passes
from flowgraph.blocks.kalman.triangles import semidefinite_root
from flowgraph.blocks.signals import ConditionalCloud, Gaussian, KalmanInnovation
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.errors import DeclarationError
from flowgraph.recorder.derivatives import jacobian

__all__ = ["Marginal", "carry_conditional", "rao_blackwellized", "weigh_conditional"]


@dataclass(frozen=True)
class Split:
    """Which numbers of a tangent vector are drawn, and which are Gaussian."""

    drawn: tuple[int, ...]
    linear: tuple[int, ...]

    @property
    def order(self) -> np.ndarray:
        """(t, t): puts what is drawn before what is linear."""
        return np.eye(len(self.drawn) + len(self.linear))[list(self.drawn + self.linear)]

    def lift(self, kind: Any, xp: Any) -> Array:
        """(l, t): a tangent vector of the whole from one of the linear part."""
        return xp.asarray(self.order[len(self.drawn) :], dtype=kind)


def _divided(L: Array, split: Split, e: Array, xp: Any) -> tuple[Array, Array]:
    """What is drawn of a root L (p, t, t), in the order of the split: a tangent vector (p, t) of the space,
    and the covariance (p, l, l) that is left."""
    k = len(split.drawn)
    d = (L[:, :, :k] @ e[..., None])[..., 0] @ xp.asarray(split.order, dtype=e.dtype)
    left = L[:, k:, k:]
    return d, left @ left.mT


@block
def carry_conditional(
    cloud: ConditionalCloud,
    control: Any | None,
    *,
    motion: Motion,
    split: Split,
    dt: float,
    draw: Any,
    xp: Any,
) -> ConditionalCloud:
    """Each particle after `dt` seconds: what is drawn, and the Gaussian of the rest given that.

    With dt = 0, as at the first firing, this is the identity. Draws `noise` (particles, numbers drawn).
    """
    x, kind, space = cloud.state, cloud.state.dtype, motion.space
    n, linear = x.shape[0], len(split.linear)
    shaken = motion.noise_root(control, dt, kind, xp)
    n_w = 0 if shaken is None else shaken.shape[-1]
    lift = split.lift(kind, xp)
    still = xp.zeros((n, linear + n_w), dtype=kind)
    after = motion.carry(x, control, still[:, linear:] if n_w else None, dt, xp)

    def moved(c: Array, xp: Any) -> Array:
        start = space.plus(x, c[:, :linear] @ lift, xp)
        return space.minus(motion.carry(start, control, c[:, linear:] if n_w else None, dt, xp), after, xp)

    _, J = jacobian(moved, still, xp)
    J = xp.asarray(split.order, dtype=kind) @ J
    F = J[:, :, :linear]
    S = F @ cloud.covariance @ F.mT
    if n_w:
        G = J[:, :, linear:] @ shaken
        S = S + G @ G.mT
    e = xp.asarray(draw.normal("noise", (n, len(split.drawn))), dtype=kind)
    d, P = _divided(semidefinite_root(0.5 * (S + S.mT), xp=xp), split, e, xp)
    return cloud.replace(state=space.plus(after, d, xp), covariance=P)


@block
def weigh_conditional(
    cloud: ConditionalCloud, message: Any | None, *,
    measurement: Measurement, split: Split, gate: float | None = None, xp: Any,
) -> tuple[ConditionalCloud, KalmanInnovation | None, Scalar | None]:  # fmt: skip
    """Correct the Gaussian of each particle, and weigh the particle by what it had expected.

    Returns:
        As `weigh_cloud`.
    """
    if message is None:
        return cloud, None, None
    x, kind, space, linear = cloud.state, cloud.state.dtype, measurement.space, len(split.linear)
    n, measured, lift = x.shape[0], measurement.vector(message, xp), split.lift(kind, xp)
    inside = measurement.covariance(message, 0, kind, xp) if measurement.inside else None
    n_v = 0 if inside is None else inside.shape[-1]
    still = xp.zeros((n, linear + n_v), dtype=kind)
    z = measurement.seen(x, still[:, linear:] if n_v else None, message, xp)

    def apart(c: Array, xp: Any) -> Array:
        at = space.plus(x, c[:, :linear] @ lift, xp)
        seen = measurement.seen(at, c[:, linear:] if n_v else None, message, xp)
        return measurement.apart(seen, z, xp)

    _, both = jacobian(apart, still, xp)
    H, V = both[:, :, :linear], both[:, :, linear:]
    residual = measurement.apart(measured, z, xp)
    R = measurement.covariance(message, residual.shape[-1], kind, xp) if inside is None else V @ inside @ V.mT
    present = ~xp.isnan(residual[0, :])
    residual = xp.where(present, residual, 0.0)
    found = correct(cloud.covariance, residual, H, R, present=present, xp=xp)
    state = space.plus(x, found.shift @ lift, xp)
    corrected = cloud.replace(state=state, covariance=found.covariance)
    corrected, whole = weighed(corrected, innovation_log_likelihood(found.innovation, xp=xp), xp)
    weight = xp.exp(cloud.log_weight)
    middle = weight @ residual
    off = residual - middle
    S = (off * weight[:, None]).mT @ off + xp.sum(found.innovation.covariance * weight[:, None, None], axis=0)
    nis, parts = middle @ xp.linalg.solve(S, middle[:, None])[:, 0], xp.sum(xp.astype(present, kind))
    accepted = passes(nis, gate, parts, residual.shape[-1], xp)
    innovation = KalmanInnovation(residual=middle, covariance=S, nis=nis, parts=parts, accepted=accepted)
    here = xp.any(present)
    return chosen(corrected, cloud, innovation, gate, xp), when(here, innovation), when(here, whole)


@dataclass(frozen=True)
class Marginal(Weighted):
    """Rao-Blackwellized particles; see `rao_blackwellized`."""

    count: int
    linear: tuple[str, ...]
    resample_below: float
    scheme: str
    draws: str
    seed: int

    def split(self, space: StateSpace) -> Split:
        """Which numbers are drawn.

        Raises:
            UnknownNameError, DeclarationError: where the parts are not those of the space, or are no vectors.
        """
        linear = [i for name in self.linear for i in range(space.tangent)[space.covers(name)]]
        parts = [part for name, part in zip(space.names, space.parts, strict=True) if name in self.linear]
        drawn = [i for i in range(space.tangent) if i not in linear]
        if not linear or not drawn or any(not StateSpace(part).flat for part in parts):
            raise DeclarationError(
                "these parts cannot be Gaussian at each particle",
                path="rao_blackwellized.linear",
                expected=f"some parts that are vectors, and not all, of {space}",
                got=", ".join(self.linear) or "none",
                fix='write rao_blackwellized(200, linear=("velocity",)); with no part to draw, extended()',
            )
        return Split(tuple(drawn), tuple(linear))

    def begin(self, start: Gaussian, motion: Motion, draw: Any, xp: Any) -> ConditionalCloud:
        n, kind, split = self.count, start.mean.dtype, self.split(motion.space)
        order = xp.asarray(split.order, dtype=kind)
        root = semidefinite_root(order @ start.covariance @ order.mT, xp=xp)
        e = xp.asarray(draw.normal("start", (n, len(split.drawn))), dtype=kind)
        d, P = _divided(xp.broadcast_to(root, (n, *root.shape)), split, e, xp)
        return ConditionalCloud(
            log_weight=xp.zeros((n,), dtype=kind) - math.log(n),
            state=motion.space.plus(start.mean[None, :], d, xp),
            covariance=P,
        )

    def believed(self, kept: ConditionalCloud, motion: Motion, xp: Any) -> Gaussian:
        """The mean and covariance of the mixture."""
        weight, space = xp.exp(kept.log_weight), motion.space
        mean = space.mean(kept.state, weight, xp)
        apart = space.minus(kept.state, mean[None, :], xp)
        lift = self.split(space).lift(kept.state.dtype, xp)
        P = (apart * weight[:, None]).mT @ apart
        P = P + lift.mT @ xp.sum(kept.covariance * weight[:, None, None], axis=0) @ lift
        return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))

    def advance(
        self, kept: Any, control: Any, motion: Motion, seen: Sequence[Seen], *,
        at: Any, gate: float | None, patience: int,
    ) -> Advanced:  # fmt: skip
        split = self.split(motion.space)
        cloud = carry_conditional(
            kept, control, motion=motion, split=split, at=at, draws=f"{self.draws}.move", name="carry"
        )
        return self.weighed(
            Tick(cloud, cloud, {}, {}), motion, seen, seen, weigh_conditional, gate, patience, split=split
        )


def rao_blackwellized(
    count: int,
    *,
    linear: tuple[str, ...] | str,
    resample_below: float = 0.5,
    scheme: str = "systematic",
    seed: int = 0,
    draws: str = "particles",
) -> Method:
    """Particles for some parts of a state, and for the others a Kalman filter at each particle.

    Args:
        count: of particles.
        linear: the names of the parts that are Gaussian given the others: vectors, in which motion and
            measurement are linear. Where they are not, they are linearised at each particle.
        resample_below, scheme, seed, draws: as in `particles`.

    Raises:
        DeclarationError, UnknownNameError: for what is out of range; for the parts when it is wired.
    """
    particles(count, resample_below=resample_below, scheme=scheme)  # which knows what is in range
    names = (linear,) if isinstance(linear, str) else tuple(linear)
    return Marginal(count, names, resample_below, scheme, draws, seed)
