"""Particles over any model: the belief as weighted states, each of which moves and is weighed by the model.

    bootstrap  each particle draws the noise of its step, and a measurement weighs it
    guided     draws the noise knowing the measurement, from the Gaussian that the model linearised about each
               particle gives; the weight makes up for it, so nothing but the variance changes
    auxiliary  first draws which particles go on, by how well each one's prediction without noise explains the
               measurement, and then moves them

With a particle x, noise w = L e, e ~ N(0, I), and the measurement linearised in e, z = h(x') + G e, S = G G^T
+ R, a guided draw is

    e ~ N(K r, I - K G)      r = z minus h(move(x, u, 0))      K = G^T S^-1
    weight * p(z | x') p(e) / q(e)

A cloud is drawn anew where its effective sample size has fallen, after its belief was taken. The
log-likelihood of a measurement is that of the mixture, log sum w_i p(z | x_i), whose exponential is unbiased.

Sources: N. Gordon, D. Salmond and A. Smith, IEE Proceedings F 140(2), 1993 (bootstrap); A. Doucet, S. Godsill
and C. Andrieu, "On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics and Computing
10, 2000, sec. II-D (guided); M. Pitt and N. Shephard, "Filtering via simulation: auxiliary particle filters",
JASA 94, 1999.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from flowgraph import Array, Scalar, block, merge, when
from flowgraph.blocks.filtering.methods import Advanced, Method, Seen, believed
from flowgraph.blocks.kalman.filters import masked
from flowgraph.blocks.kalman.triangles import semidefinite_root
from flowgraph.blocks.particles.cloud import log_sum_exp
from flowgraph.blocks.particles.resampling import MOST_PARTICLES, SCHEMES, ancestor_index
from flowgraph.blocks.signals import Gaussian, KalmanInnovation, StateCloud
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.clock import clock_of
from flowgraph.recorder.derivatives import jacobian

__all__ = [
    "PROPOSALS",
    "Particles",
    "auxiliary_cloud",
    "carry_cloud",
    "cloud_size",
    "guide_cloud",
    "particles",
    "resample_cloud",
    "weigh_cloud",
]

PROPOSALS = ("bootstrap", "guided", "auxiliary")
"""How particles are drawn."""


@block
def carry_cloud(
    cloud: StateCloud, control: Any | None, *, motion: Motion, dt: float, draw: Any, xp: Any
) -> StateCloud:
    """Each particle after `dt` seconds of the motion with a noise of its own: x' = move(x, u, L e, dt).

    With dt = 0, as at the first firing, this is the identity. Draws `noise` (particles, n_w).
    """
    x = cloud.state
    e = _drawn(motion, control, x.shape[0], dt, draw, x.dtype, xp)
    return cloud.replace(state=motion.carry(x, control, _shaken(motion, control, e, dt, x.dtype, xp), dt, xp))


def _drawn(motion: Motion, control: Any, n: int, dt: Any, draw: Any, kind: Any, xp: Any) -> Array | None:
    """Standard normal numbers (n, n_w); None without noise."""
    root = motion.noise_root(control, dt, kind, xp)
    if root is None:
        return None
    return xp.asarray(draw.normal("noise", (n, root.shape[-1])), dtype=kind)


def _shaken(motion: Motion, control: Any, e: Array | None, dt: Any, kind: Any, xp: Any) -> Array | None:
    root = motion.noise_root(control, dt, kind, xp)
    return None if root is None or e is None else e @ root.mT


@block
def weigh_cloud(
    cloud: StateCloud, message: Any | None, *, measurement: Measurement, xp: Any
) -> tuple[StateCloud, KalmanInnovation | None, Scalar | None]:
    """Multiply the weights by the likelihood of what was measured, and normalise; without it nothing changes.

        log p(z | x_i) = -(r_i^T R_i^-1 r_i + log det R_i + parts log(2 pi)) / 2      r_i = z minus h(x_i)

    R is the covariance of noise that is added; of noise that goes in, (dz/dv) noise (dz/dv)^T at each
    particle. An entry that is NaN counts as not measured.

    Returns:
        The cloud; and where there was a measurement the innovation, with the mean and covariance of what the
        cloud expected, and the log-likelihood.
    """
    if message is None:
        return cloud, None, None
    residual, R, present = _residuals(cloud.state, message, measurement, xp)
    likely = _log_density(residual, R, present, xp)
    found, whole = _weighed(cloud, likely, xp)
    here = xp.any(present)
    innovation = _innovation(cloud, residual, R, present, xp)
    return found, when(here, innovation), when(here, whole)


def _weighed(cloud: StateCloud, likely: Array, xp: Any) -> tuple[StateCloud, Array]:
    log_weight = cloud.log_weight + likely
    whole = log_sum_exp(log_weight, xp=xp)
    return cloud.replace(log_weight=log_weight - whole), whole


def _residuals(x: Array, message: Any, measurement: Measurement, xp: Any) -> tuple[Array, Array, Array]:
    """z minus what each particle expects (n, m), 0 where missing; R (m, m) or (n, m, m); present (m)."""
    measured, kind = measurement.vector(message, xp), x.dtype
    if measurement.inside:
        noise = measurement.covariance(message, 0, kind, xp)
        still = xp.zeros((x.shape[0], noise.shape[-1]), dtype=kind)
        z = measurement.seen(x, still, message, xp)
        apart = lambda v, xp: measurement.apart(measurement.seen(x, v, message, xp), z, xp)
        _, V = jacobian(apart, still, xp)
        R = V @ noise @ V.mT
    else:
        z = measurement.seen(x, None, message, xp)
        R = None
    residual = measurement.apart(measured, z, xp)
    R = measurement.covariance(message, residual.shape[-1], kind, xp) if R is None else R
    present = ~xp.isnan(residual[0, :])
    residual = xp.where(present, residual, 0.0)
    return residual, masked(R, R, present, xp)[1], present


def _log_density(residual: Array, R: Array, present: Array, xp: Any) -> Array:
    """The logarithm (n) of the density of N(0, R) at each residual (n, m), of the entries present."""
    L = xp.linalg.cholesky(R)
    white = xp.linalg.solve(L, residual[..., None])[..., 0] if len(R.shape) == 3 else None
    white = xp.linalg.solve(L, residual.mT).mT if white is None else white
    determinant = 2.0 * xp.sum(xp.log(xp.sum(L * xp.eye(R.shape[-1], dtype=R.dtype), axis=-1)), axis=-1)
    parts = xp.sum(xp.astype(present, residual.dtype))
    return -0.5 * (xp.sum(white * white, axis=-1) + determinant + math.log(2.0 * math.pi) * parts)


def _innovation(cloud: StateCloud, residual: Array, R: Array, present: Array, xp: Any) -> KalmanInnovation:
    """What the cloud before the measurement expected, as one Gaussian."""
    weight = xp.exp(cloud.log_weight)
    mean = weight @ residual
    apart = residual - mean
    S = (apart * weight[:, None]).mT @ apart
    noise = R if len(R.shape) == 2 else xp.sum(R * weight[:, None, None], axis=0)
    S = S + noise
    solved = xp.linalg.solve(S, mean[:, None])[:, 0]
    return KalmanInnovation(
        residual=mean,
        covariance=S,
        nis=mean @ solved,
        parts=xp.sum(xp.astype(present, mean.dtype)),
        accepted=xp.any(present) | ~xp.any(present),
    )


@block
def guide_cloud(
    cloud: StateCloud,
    control: Any | None,
    message: Any | None,
    *,
    motion: Motion,
    measurement: Measurement,
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
    e = _drawn(motion, control, x.shape[0], dt, draw, kind, xp)
    carry = lambda e, xp: motion.carry(x, control, _shaken(motion, control, e, dt, kind, xp), dt, xp)
    plain = cloud.replace(state=carry(e, xp))
    if message is None:
        return plain, plain, None, None
    if e is None:
        raise DeclarationError(
            "particles of a motion without noise cannot be guided",
            path="particles.proposal",
            expected="a motion with noise to draw",
            got=repr(motion),
            fix='write particles(n, proposal="bootstrap")',
        )
    still = _still(measurement, message, x, xp)
    centre = carry(0.0 * e, xp)
    residual, R, present = _residuals(centre, message, measurement, xp)
    here = measurement.seen(centre, still, message, xp)
    seen = lambda e, xp: measurement.apart(measurement.seen(carry(e, xp), still, message, xp), here, xp)
    G = jacobian(seen, 0.0 * e, xp)[1] * xp.astype(present, kind)[:, None]
    gain = xp.linalg.solve(G @ G.mT + R, xp.concat([G, residual[..., None]], axis=-1))
    one = xp.eye(e.shape[-1], dtype=kind)
    spread = xp.linalg.cholesky(one - G.mT @ gain[..., :-1])
    guided = (G.mT @ gain[..., -1:] + spread @ e[..., None])[..., 0]
    moved = plain.replace(state=carry(guided, xp))
    determinant = xp.sum(xp.log(xp.sum(spread * one, axis=-1)), axis=-1)
    ratio = 0.5 * xp.sum(e * e - guided * guided, axis=-1) + determinant
    found, whole = _weighed(moved, _likely(moved.state, message, measurement, xp) + ratio, xp)
    return _with_innovation(plain, found, whole, message, measurement, xp)


@block
def auxiliary_cloud(
    cloud: StateCloud, control: Any | None, message: Any | None, *,
    motion: Motion, measurement: Measurement, scheme: str, dt: float, draw: Any, xp: Any,
) -> tuple[StateCloud, StateCloud, KalmanInnovation | None, Scalar | None]:  # fmt: skip
    """`carry_cloud`, of the particles whose prediction without noise explains the measurement.

        a_i drawn by w_j p(z | move(x_j, 0))      x_i' = move(x_a, L e_i)
        weight p(z | x_i') / p(z | move(x_a, 0))

    Draws `noise` (particles, n_w) and `place`, as the scheme has it.

    Returns:
        As `guide_cloud`.
    """
    x, kind, n = cloud.state, cloud.state.dtype, cloud.state.shape[0]
    e = _drawn(motion, control, n, dt, draw, kind, xp)
    w = _shaken(motion, control, e, dt, kind, xp)
    plain = cloud.replace(state=motion.carry(x, control, w, dt, xp))
    if message is None:
        return plain, plain, None, None
    without = None if w is None else 0.0 * w
    pilot = _likely(motion.carry(x, control, without, dt, xp), message, measurement, xp)
    chosen, ahead = _weighed(cloud, pilot, xp)
    index = ancestor_index(xp.exp(chosen.log_weight), scheme=scheme, draw=draw, xp=xp)
    moved = motion.carry(xp.take(x, index, axis=0), control, w, dt, xp)
    even = StateCloud(log_weight=xp.zeros((n,), dtype=kind) - math.log(n), state=moved)
    ratio = _likely(moved, message, measurement, xp) - xp.take(pilot, index, axis=0)
    found, whole = _weighed(even, ratio, xp)
    return _with_innovation(plain, found, ahead + whole, message, measurement, xp)


def _still(measurement: Measurement, message: Any, x: Array, xp: Any) -> Array | None:
    """No noise (n, n_v), of a measurement into which it goes; else None."""
    if not measurement.inside:
        return None
    size = measurement.covariance(message, 0, x.dtype, xp).shape[-1]
    return xp.zeros((x.shape[0], size), dtype=x.dtype)


def _likely(x: Array, message: Any, measurement: Measurement, xp: Any) -> Array:
    """The log-likelihood (n) of each state."""
    return _log_density(*_residuals(x, message, measurement, xp), xp)


def _with_innovation(
    plain: StateCloud, found: StateCloud, whole: Array, message: Any, measurement: Measurement, xp: Any
) -> tuple[Any, Any, Any, Any]:
    residual, R, present = _residuals(plain.state, message, measurement, xp)
    here = xp.any(present)
    return plain, found, when(here, _innovation(plain, residual, R, present, xp)), when(here, whole)


@block
def cloud_size(cloud: StateCloud, *, xp: Any) -> Scalar:
    """1 / sum(w^2): how many equally weighted particles would be as good, from 1 to n."""
    weight = xp.exp(cloud.log_weight)
    return 1.0 / (weight @ weight)


@block
def resample_cloud(
    cloud: StateCloud, size: Scalar, *, below: float, scheme: str, draw: Any, xp: Any
) -> StateCloud:
    """The particles drawn anew, as often as their weights say, where size < below n.

    Args:
        size: the effective sample size.
        below: a fraction of the number of particles; 0 never resamples, above 1 always.
        scheme: as in `resampling`.
    """
    n = cloud.log_weight.shape[-1]
    drawn = ancestor_index(xp.exp(cloud.log_weight), scheme=scheme, draw=draw, xp=xp)
    uneven = size < below * n
    index = xp.where(uneven, drawn, xp.arange(n, dtype=xp.int64))
    return StateCloud(
        log_weight=xp.where(uneven, -math.log(n), cloud.log_weight), state=xp.take(cloud.state, index, axis=0)
    )


@dataclass(frozen=True)
class Particles(Method):
    """A particle filter; see `particles`."""

    count: int
    proposal: str
    resample_below: float
    scheme: str
    draws: str
    seed: int

    def begin(self, start: Gaussian, motion: Motion, draw: Any, xp: Any) -> StateCloud:
        n, kind = self.count, start.mean.dtype
        root = semidefinite_root(start.covariance, xp=xp)
        e = xp.asarray(draw.normal("start", (n, root.shape[-1])), dtype=kind)
        state = motion.space.plus(start.mean[None, :], e @ root.mT, xp)
        return StateCloud(log_weight=xp.zeros((n,), dtype=kind) - math.log(n), state=state)

    def believed(self, kept: StateCloud, motion: Motion, xp: Any) -> Gaussian:
        """The weighted mean and covariance of the particles."""
        weight, space = xp.exp(kept.log_weight), motion.space
        mean = space.mean(kept.state, weight, xp)
        apart = space.minus(kept.state, mean[None, :], xp)
        P = (apart * weight[:, None]).mT @ apart
        return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))

    def advance(
        self, kept: Any, control: Any, motion: Motion, seen: Sequence[Seen], *,
        at: Any, gate: float | None, patience: int,
    ) -> Advanced:  # fmt: skip
        if gate is not None:
            raise DeclarationError(
                "particles have no gate",
                path="filtered.gate",
                expected="gate=None: a particle that does not explain a measurement loses its weight",
                got=f"gate={gate!r}",
                fix="leave gate out, or give the measurement a wider noise",
            )
        innovations, likelihoods, rest = {}, {}, list(seen)
        if self.proposal == "bootstrap":
            plain = cloud = carry_cloud(
                kept, control, motion=motion, at=at, draws=f"{self.draws}.move", name="carry"
            )
        else:
            one = rest.pop(0)
            more = {} if self.proposal == "guided" else {"scheme": self.scheme}
            draw_with = guide_cloud if self.proposal == "guided" else auxiliary_cloud
            plain, cloud, innovations[one.name], likelihoods[one.name] = draw_with(
                kept, control, one.stream, motion=motion, measurement=one.model,
                at=at, draws=f"{self.draws}.move", name="carry", **more,
            )  # fmt: skip
        for one in rest:
            suffix = f"_{one.name}" if len(seen) > 1 else ""
            cloud, innovations[one.name], likelihoods[one.name] = weigh_cloud(
                cloud, one.stream, measurement=one.model, name=f"weigh{suffix}"
            )
        measured = functools.reduce(operator.or_, (clock_of(one.stream) for one in seen))
        size = cloud_size(cloud, at=measured, name="size")
        fresh = resample_cloud(
            cloud, size, below=self.resample_below, scheme=self.scheme,
            at=measured, draws=f"{self.draws}.resample", name="resample",
        )  # fmt: skip
        return Advanced(
            merge(fresh, cloud, tie="left", name="next"),
            believed(plain, method=self, motion=motion, name="prior"),
            believed(cloud, method=self, motion=motion, name="average"),
            innovations,
            likelihoods,
            {"effective_sample_size": size},
        )

    def smoothable(
        self, kept: Any, control: Any, motion: Motion, found: Advanced, *, at: Any
    ) -> dict[str, Any]:
        return {"cloud": found.kept}


def particles(
    count: int,
    *,
    proposal: str = "bootstrap",
    resample_below: float = 0.5,
    scheme: str = "systematic",
    seed: int = 0,
    draws: str = "particles",
) -> Method:
    """A particle filter, of any model and any number of particles.

    Args:
        count: of particles.
        proposal: "bootstrap", "guided" or "auxiliary": how they are drawn; the last two look at the first
            measurement that `filtered` is given.
        resample_below: drawn anew when the effective sample size is below this fraction of them.
        scheme: "systematic", "stratified", "residual" or "multinomial".
        seed: of the draws of the start; that of a run is given to `simulate`.
        draws: what its random streams are called; two filters in one graph need two names.

    Raises:
        DeclarationError, UnknownNameError: for what is out of range.
    """
    if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MOST_PARTICLES:
        raise DeclarationError(
            "this is no number of particles",
            path="particles.count",
            expected=f"a whole number from 1 to {MOST_PARTICLES:,}",
            got=repr(count),
            fix="write particles(1000)",
        )
    for value, known, what in ((proposal, PROPOSALS, "proposal"), (scheme, tuple(SCHEMES), "scheme")):
        if value not in known:
            raise UnknownNameError(what, value, known, path=f"particles.{what}")
    return Particles(count, proposal, resample_below, scheme, draws, seed)
