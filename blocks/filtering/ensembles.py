"""The ensemble Kalman filter: the belief as states of equal weight, which a measurement moves.

Each member moves with a noise of its own. What the members are and what would be seen of them have a sample
covariance, and by the gain of that each is moved towards a measurement that has a noise of its own as well:

    x_i' = x_i plus C_xz (C_zz + R)^-1 (z minus h(x_i) - v_i)      v_i ~ N(0, R)

So no derivative is taken and no covariance kept: for states that are large. With more and more members the
filter of a linear model is the Kalman filter; with n the mean is off by about 1/sqrt(n) of a deviation.

It is smoothed by the sample covariance of the members before and after a step, in place of P F^T; so the
ensemble Kalman smoother and that of Rauch, Tung and Striebel are one (Raanes 2016).

Source: G. Burgers, P. van Leeuwen and G. Evensen, "Analysis scheme in the ensemble Kalman filter", Monthly
Weather Review 126(6), 1998; G. Evensen, "The ensemble Kalman filter: theoretical formulation and practical
implementation", Ocean Dynamics 53, 2003, sec. 4; P. Raanes, "On the ensemble Rauch-Tung-Striebel smoother and
its equivalence to the ensemble Kalman smoother", Q. J. Royal Meteorological Society 142, 2016.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flowgraph import Scalar, block, when
from flowgraph.blocks.filtering.gaussian import innovation_log_likelihood
from flowgraph.blocks.filtering.methods import Advanced, Method, Seen, believed
from flowgraph.blocks.filtering.particles import found_back
from flowgraph.blocks.filtering.proposals import drawn, shaken
from flowgraph.blocks.filtering.towards import deviations, moved_towards
from flowgraph.blocks.kalman.triangles import semidefinite_root
from flowgraph.blocks.particles.resampling import MOST_PARTICLES
from flowgraph.blocks.signals import CrossCovariance, Gaussian, KalmanInnovation, StateEnsemble
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.errors import DeclarationError

__all__ = ["Ensemble", "carry_ensemble", "correct_ensemble", "ensemble", "ensemble_cross"]


@block
def carry_ensemble(
    members: StateEnsemble, control: Any | None, *, motion: Motion, dt: float, draw: Any, xp: Any
) -> StateEnsemble:
    """Each member after `dt` seconds of the motion with a noise of its own.

    With dt = 0, as at the first firing, this is the identity. Draws `noise` (members, n_w).
    """
    x = members.state
    e = drawn(motion, control, x.shape[0], dt, draw, x.dtype, xp)
    w = shaken(motion, control, e, dt, x.dtype, xp)
    return members.replace(state=motion.carry(x, control, w, dt, xp))


@block
def correct_ensemble(
    members: StateEnsemble, message: Any | None, *,
    measurement: Measurement, gate: float | None = None, draw: Any, xp: Any,
) -> tuple[StateEnsemble, KalmanInnovation | None, Scalar | None]:  # fmt: skip
    """Move the members towards what was measured; without it nothing changes.

    Draws `seen` (members, m), the noise of the measurement. An entry that is NaN counts as not measured.

    Args:
        members: of the ensemble.
        message: what was measured; or absent.
        measurement: what is seen of a state.
        gate: as in `update_linear`.

    Returns:
        The members, and where there was a measurement the innovation of their mean and the log-likelihood.
    """
    if message is None:
        return members, None, None
    found = moved_towards(members.state, message, measurement, gate, draw, xp)
    likely, here = innovation_log_likelihood(found.innovation, xp=xp), xp.any(found.present)
    return members.replace(state=found.state), when(here, found.innovation), when(here, likely)


@block
def ensemble_cross(
    members: StateEnsemble, moved: StateEnsemble, *, motion: Motion, xp: Any
) -> CrossCovariance:
    """The sample covariance of members and of what became of each, which a smoother goes back by.

    Args:
        members: of the tick before.
        moved: the same, after the step and before measurements.
        motion: of the filter.
    """
    before, after = (deviations(one.state, motion.space, xp)[0] for one in (members, moved))
    return CrossCovariance(covariance=before.mT @ after / (before.shape[-2] - 1.0))


@dataclass(frozen=True)
class Ensemble(Method):
    """The ensemble Kalman filter; see `ensemble`."""

    count: int
    draws: str
    seed: int

    def begin(self, start: Gaussian, motion: Motion, draw: Any, xp: Any) -> StateEnsemble:
        kind, root = start.mean.dtype, semidefinite_root(start.covariance, xp=xp)
        e = xp.asarray(draw.normal("start", (self.count, root.shape[-1])), dtype=kind)
        return StateEnsemble(state=motion.space.plus(start.mean[None, :], e @ root.mT, xp))

    def believed(self, kept: StateEnsemble, motion: Motion, xp: Any) -> Gaussian:
        """The mean and the sample covariance of the members."""
        X, mean = deviations(kept.state, motion.space, xp)
        P = X.mT @ X / (self.count - 1.0)
        return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))

    def advance(
        self, kept: Any, control: Any, motion: Motion, seen: Sequence[Seen], *,
        at: Any, gate: float | None, patience: int,
    ) -> Advanced:  # fmt: skip
        members = moved = carry_ensemble(
            kept, control, motion=motion, at=at, draws=f"{self.draws}.move", name="carry"
        )
        prior = believed(members, method=self, motion=motion, name="prior")
        innovations, likelihoods = {}, {}
        for one in seen:
            suffix = f"_{one.name}" if len(seen) > 1 else ""
            before = members
            members, innovations[one.name], likelihoods[one.name] = correct_ensemble(
                members, one.stream, measurement=one.model, gate=gate,
                draws=f"{self.draws}.seen{suffix}", name=f"correct{suffix}",
            )  # fmt: skip
            if gate is not None:
                members = found_back(
                    before, members, innovations[one.name], one, patience, f"{self.draws}.find", seen
                )
        belief = believed(members, method=self, motion=motion, name="posterior")
        return Advanced(members, prior, belief, innovations, likelihoods, {}, moved)

    def smoothable(
        self, kept: Any, control: Any, motion: Motion, found: Advanced, *, at: Any
    ) -> Mapping[str, Any]:
        return {"cross": ensemble_cross(kept, found.moved, motion=motion, name="cross")}


def ensemble(count: int, *, seed: int = 0, draws: str = "ensemble") -> Method:
    """The ensemble Kalman filter: Kalman's gain from the sample covariance of so many members.

    Args:
        count: of members; more than the numbers of the state, or the sample is blind in some direction.
        seed: of the draws of the start; that of a run is given to `simulate`.
        draws: what its random streams are called; two filters in one graph need two names.

    Raises:
        DeclarationError: for what is out of range.
    """
    if not isinstance(count, int) or isinstance(count, bool) or not 2 <= count <= MOST_PARTICLES:
        raise DeclarationError(
            "this is no number of members",
            path="ensemble.count",
            expected=f"a whole number from 2 to {MOST_PARTICLES:,}",
            got=repr(count),
            fix="write ensemble(100)",
        )
    return Ensemble(count, draws, seed)
