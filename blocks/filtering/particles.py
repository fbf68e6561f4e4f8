"""Particles over any model: the belief as weighted states, each of which moves and is weighed by the model.

How they are drawn is a proposal (`proposals`): by the noise of the motion alone, knowing the measurement, or
as the user says. A measurement weighs them (`weighing`). A cloud is drawn anew where its effective sample
size has fallen, after its belief was taken. The log-likelihood of a measurement is that of the mixture,
log sum w_i p(z | x_i), whose exponential is unbiased.

Source: N. Gordon, D. Salmond and A. Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state
estimation", IEE Proceedings F 140(2), 1993.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from flowgraph import Scalar, block, merge
from flowgraph.blocks.filtering.methods import Advanced, Method, Seen, believed
from flowgraph.blocks.filtering.proposals import (
    PROPOSALS,
    auxiliary_cloud,
    carry_cloud,
    guide_cloud,
    propose_cloud,
)
from flowgraph.blocks.filtering.towards import find_cloud_back
from flowgraph.blocks.filtering.weighing import weigh_cloud
from flowgraph.blocks.kalman.triangles import semidefinite_root
from flowgraph.blocks.particles.resampling import MOST_PARTICLES, SCHEMES, ancestor_index
from flowgraph.blocks.signals import Gaussian, StateCloud
from flowgraph.blocks.statespace import Handed, Motion
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.clock import clock_of

__all__ = ["Particles", "cloud_size", "particles", "resample_cloud"]


@block
def cloud_size(cloud: Any, *, xp: Any) -> Scalar:
    """1 / sum(w^2): how many equally weighted particles would be as good, from 1 to n."""
    weight = xp.exp(cloud.log_weight)
    return 1.0 / (weight @ weight)


@block
def resample_cloud(  # type: ignore[no-untyped-def]
    cloud: Any, size: Scalar, *, below: float, scheme: str, draw: Any, xp: Any
):
    """The particles drawn anew, as often as their weights say, where size < below n.

    Args:
        cloud: any signal with a `log_weight`, and other fields that have a row for each particle.
        size: the effective sample size.
        below: a fraction of the number of particles; 0 never resamples, above 1 always.
        scheme: as in `resampling`.
    """
    n = cloud.log_weight.shape[-1]
    drawn = ancestor_index(xp.exp(cloud.log_weight), scheme=scheme, draw=draw, xp=xp)
    uneven = size < below * n
    index = xp.where(uneven, drawn, xp.arange(n, dtype=xp.int64))
    fields = {name: getattr(cloud, name) for name in cloud._fields}
    rows = {name: xp.where(uneven, xp.take(x, index, axis=0), x) for name, x in fields.items()}
    return cloud.replace(**(rows | {"log_weight": xp.where(uneven, -math.log(n), cloud.log_weight)}))


class Tick(NamedTuple):
    """What has become of a cloud in a tick: as it was carried, as it is now, and what measurements said."""

    plain: Any
    cloud: Any
    innovations: dict[str, Any]
    likelihoods: dict[str, Any]


class Weighted(Method):
    """What methods share whose belief is a weighted cloud."""

    resample_below: float
    scheme: str
    draws: str

    def weighed(
        self, tick: Tick, motion: Motion, seen: Sequence[Seen], rest: Sequence[Seen], weigh: Any,
        gate: float | None, patience: int, **settings: Any,
    ) -> Advanced:  # fmt: skip
        """The rest of a tick: weigh the cloud by each of the `rest`, and draw it anew where it is uneven.

        Args:
            seen: all measurements.
            weigh: the block that weighs by one of them; `settings` are its own.
        """
        plain, cloud, innovations, likelihoods = tick
        for one in rest:
            suffix = f"_{one.name}" if len(seen) > 1 else ""
            before = cloud
            cloud, innovations[one.name], likelihoods[one.name] = weigh(
                cloud, one.stream, measurement=one.model, gate=gate, name=f"weigh{suffix}", **settings
            )
            if gate is not None:
                cloud = found_back(
                    before, cloud, innovations[one.name], one, patience, f"{self.draws}.find", seen
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


@dataclass(frozen=True)
class Particles(Weighted):
    """A particle filter; see `particles`."""

    count: int
    proposal: str
    resample_below: float
    scheme: str
    draws: str
    seed: int
    propose: Handed | None = None

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
        innovations, likelihoods, rest, cloud = {}, {}, list(seen), kept
        if self.proposal == "bootstrap" and self.propose is None:
            plain = cloud = carry_cloud(
                kept, control, motion=motion, at=at, draws=f"{self.draws}.move", name="carry"
            )
        else:
            one = rest.pop(0)
            draw_with, more = self._drawn_with()
            plain, cloud, innovations[one.name], likelihoods[one.name] = draw_with(
                kept, control, one.stream, motion=motion, measurement=one.model, gate=gate,
                at=at, draws=f"{self.draws}.move", name="carry", **more,
            )  # fmt: skip
            if gate is not None:
                cloud = found_back(
                    plain, cloud, innovations[one.name], one, patience, f"{self.draws}.find", seen
                )
        return self.weighed(
            Tick(plain, cloud, innovations, likelihoods), motion, seen, rest, weigh_cloud, gate, patience
        )

    def smoothable(
        self, kept: Any, control: Any, motion: Motion, found: Advanced, *, at: Any
    ) -> dict[str, Any]:
        return {"cloud": found.kept}

    def _drawn_with(self) -> tuple[Callable[..., Any], dict[str, Any]]:
        """The block that draws knowing the first measurement, and its own settings."""
        if self.proposal == "auxiliary":
            return auxiliary_cloud, {"scheme": self.scheme, "propose": self.propose}
        return (guide_cloud, {}) if self.propose is None else (propose_cloud, {"propose": self.propose})


def found_back(
    before: Any, cloud: Any, innovation: Any, one: Seen, patience: int, draws: str, seen: Sequence[Seen]
) -> Any:
    """The cloud after `find_cloud_back`; a wire, and no block."""
    suffix = f"_{one.name}" if len(seen) > 1 else ""
    return find_cloud_back(
        before, cloud, one.stream, innovation, measurement=one.model, patience=patience,
        draws=f"{draws}{suffix}", name=f"find_back{suffix}",
    )  # fmt: skip


def particles(
    count: int,
    *,
    proposal: str = "bootstrap",
    propose: Callable[..., Any] | None = None,
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
        propose: `propose(x, u, z, dt, xp) -> (mean, covariance)`, a Gaussian from which the noise w of the
            motion is drawn where there is a measurement z, (n, n_w) and (n, n_w, n_w) or (n_w, n_w): in place
            of the noise's own with "bootstrap", and of the particles first chosen with "auxiliary". What it
            does not need it leaves out.
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
    if propose is not None and proposal == "guided":
        raise DeclarationError(
            "particles that the model guides have their proposal",
            path="particles.propose",
            expected='proposal="bootstrap" or "auxiliary" with a proposal of your own',
            got='proposal="guided"',
            fix="write particles(1000, propose=...)",
        )
    own = None if propose is None else Handed(propose, "particles.propose", ("z", "dt", "xp"), "control")
    return Particles(count, proposal, resample_below, scheme, draws, seed, own)
