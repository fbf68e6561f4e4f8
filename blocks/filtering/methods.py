"""The methods by name, as a user writes them: `method=extended()`.

A method says how a filter of a model is wired: what it keeps between ticks, how a step and a measurement
change that, and what of it is the belief. Those with a Gaussian belief share two blocks, `predict` and
`correct`, which ask the method for its maths; particles have blocks of their own.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Scalar, Stream, block, when
from flowgraph.blocks.filtering.gaussian import (
    Extended,
    GaussianMethod,
    Linear,
    SquareRoot,
    Unscented,
)
from flowgraph.blocks.kalman.lost import find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.signals import CrossCovariance, Gaussian, KalmanInnovation
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.blocks.unscented.sigma_points import GAUSSIAN, SigmaPoints
from flowgraph.errors import DeclarationError
from flowgraph.language.block import Limit

__all__ = [
    "Advanced",
    "Method",
    "Seen",
    "correct",
    "crossed",
    "cubature",
    "extended",
    "linear",
    "predict",
    "square_root",
    "unscented",
]


class Seen(NamedTuple):
    """A measurement that is wired: its name, its model, and the stream of its messages."""

    name: str
    model: Measurement
    stream: Stream[Any]


class Advanced(NamedTuple):
    """What a tick makes of what a filter keeps.

    kept: to be kept for the next tick. prior, belief: `Gaussian` before and after the measurements.
    innovations, log_likelihoods: by the name of the measurement. more: other streams, by name. moved: what is
    kept before measurements, where a smoother asks for it.
    """

    kept: Stream[Any]
    prior: Stream[Gaussian]
    belief: Stream[Gaussian]
    innovations: Mapping[str, Stream[KalmanInnovation]]
    log_likelihoods: Mapping[str, Stream[Any]]
    more: Mapping[str, Stream[Any]]
    moved: Stream[Any] | None = None


class Method(abc.ABC):
    """How a filter of a model is wired."""

    seed = 0
    """Of the draws of the start."""

    @abc.abstractmethod
    def begin(self, start: Gaussian, motion: Motion, draw: Any, xp: Any) -> Any:
        """What is kept of a belief at first; draws are named `start`."""

    @abc.abstractmethod
    def believed(self, kept: Any, motion: Motion, xp: Any) -> Gaussian:
        """The mean and covariance of what is kept."""

    @abc.abstractmethod
    def advance(
        self,
        kept: Any,
        control: Any,
        motion: Motion,
        seen: Sequence[Seen],
        *,
        at: Any,
        gate: float | None,
        patience: int,
    ) -> Advanced:
        """Wire one tick, at the clock `at`, of what was kept at the tick before."""

    def smoothable(
        self, kept: Any, control: Any, motion: Motion, found: Advanced, *, at: Any
    ) -> Mapping[str, Stream[Any]]:
        """What a smoother needs of a tick beside prior and belief, by name.

        Args:
            kept, control, motion, at: as for `advance`.
            found: what that wired.

        Raises:
            DeclarationError: of a method that cannot be smoothed.
        """
        raise DeclarationError(
            "this method has no smoother",
            path=f"filtered.{type(self).__name__}",
            expected="a method with a Gaussian belief, a bank of such, an ensemble or particles",
            got=repr(self),
            fix="leave smoothing out, or use another method",
        )


@block
def predict(belief: Any, control: Any | None, *, motion: Motion, method: GaussianMethod, dt: float, xp: Any):
    """The belief after `dt` seconds of the motion, with a control that is held over the step.

    With dt = 0, as at the first firing, this is the identity.

    Args:
        belief: as the method keeps it.
        control: as the motion takes it; none where it takes none.
        motion: how the state moves.
        method: linear, extended, unscented ...
    """
    return method.predicted(belief, control, motion, dt, xp)


@block
def correct(
    prior: Any, message: Any | None, *, measurement: Measurement, method: GaussianMethod,
    gate: float | None = None, xp: Any,
) -> tuple[Any, KalmanInnovation | None, Scalar | None]:  # fmt: skip
    """The belief with what was measured; without a measurement the prior passes through.

    An entry of the measurement that is NaN counts as not measured. If all are, the prior passes through.

    Args:
        prior: as the method keeps it.
        message: what was measured; or absent.
        measurement: what is seen of a state.
        method: linear, extended, unscented ...
        gate: as in `update_linear`.

    Returns:
        The posterior, and where there was a measurement its innovation and its log-likelihood.
    """
    if message is None:
        return prior, None, None
    posterior, found, likely = method.corrected(prior, message, measurement, gate, xp)
    return posterior, when(*found), when(found.present, likely)


@block
def crossed(
    kept: Any, control: Any | None, *, motion: Motion, method: GaussianMethod, dt: float, xp: Any
) -> CrossCovariance:
    """The covariance of a belief and of what `predict` makes of it, which a smoother goes back by.

    Args:
        kept, control, motion, method: as for `predict`.
    """
    return CrossCovariance(covariance=method.crossed(kept, control, motion, dt, xp))


@predict.limited
@correct.limited
@crossed.limited
def _limits(*, method: GaussianMethod, **_: Any) -> Sequence[Limit]:
    return method.limits()


@block
def believed(kept: Any, *, method: Any, motion: Motion, xp: Any) -> Gaussian:
    """The mean and covariance of what a method keeps."""
    return method.believed(kept, motion, xp)


@dataclass(frozen=True)
class GaussianFilter(Method):
    """A filter with a Gaussian belief, by any of the methods of `gaussian`."""

    maths: GaussianMethod

    def begin(self, start: Gaussian, motion: Motion, draw: Any, xp: Any) -> Any:
        return self.maths.begin(start, motion.space, xp)

    def believed(self, kept: Any, motion: Motion, xp: Any) -> Gaussian:
        return self.maths.believed(kept, motion.space, xp)

    def advance(
        self, kept: Any, control: Any, motion: Motion, seen: Sequence[Seen], *,
        at: Any, gate: float | None, patience: int,
    ) -> Advanced:  # fmt: skip
        self.maths.need(motion)
        for one in seen:
            self.maths.need(one.model)
        kept = predict(kept, control, motion=motion, method=self.maths, at=at, name="predict")
        prior, innovations, likelihoods = self._belief(kept, motion, "prior"), {}, {}
        for one in seen:
            suffix = f"_{one.name}" if len(seen) > 1 else ""
            kept, innovations[one.name], likelihoods[one.name] = correct(
                kept, one.stream, measurement=one.model, method=self.maths, gate=gate, name=f"correct{suffix}"
            )
            if gate is not None:
                kept = find_back(
                    kept, innovations[one.name], patience=patience, moving=motion.space.tangent,
                    name=f"find_back{suffix}",
                )  # fmt: skip
        return Advanced(kept, prior, self._belief(kept, motion, "posterior"), innovations, likelihoods, {})

    def smoothable(
        self, kept: Any, control: Any, motion: Motion, found: Advanced, *, at: Any
    ) -> Mapping[str, Stream[Any]]:
        still = motion.space.resting()
        if type(self.maths).crossed is GaussianMethod.crossed:  # refuses, before anything is wired
            self.maths.crossed(still, None, motion, 0.0, np)
        return {"cross": crossed(kept, control, motion=motion, method=self.maths, at=at, name="cross")}

    def _belief(self, kept: Any, motion: Motion, name: str) -> Stream[Gaussian]:
        if type(self.maths).believed is GaussianMethod.believed:
            return kept
        return believed(kept, method=self, motion=motion, name=name)


def linear() -> Method:
    """The Kalman filter, of a motion and measurements that are linear.

    Raises:
        DeclarationError: when it is wired, for others.
    """
    return GaussianFilter(Linear())


def extended(*, iterations: int = 1, robust: Robust | None = None) -> Method:
    """The extended Kalman filter: the model linearised where the belief is, by its own derivatives.

    Args:
        iterations: how often a measurement is linearised: once, at the prediction; or again at the state
            that came of it, which helps where a measurement is sharp and curved.
        robust: `huber()` or `student_t()`: a measurement counts for less that is far off.
    """
    return GaussianFilter(Extended(_at_least_one(iterations), robust))


def square_root() -> Method:
    """The extended Kalman filter on a triangular root of the covariance: it has twice the digits, and its
    square cannot become negative."""
    return GaussianFilter(SquareRoot())


def unscented(points: SigmaPoints = GAUSSIAN) -> Method:
    """The unscented Kalman filter: sigma points of the state and of the noise through the model itself."""
    return GaussianFilter(Unscented(points))


def cubature() -> Method:
    """The cubature Kalman filter: of 2n points, all of the same weight, none at the centre."""
    return GaussianFilter(Unscented(SigmaPoints(alpha=1.0, beta=0.0, kappa=0.0)))


def _at_least_one(iterations: int) -> int:
    if not isinstance(iterations, int) or isinstance(iterations, bool) or not 1 <= iterations <= 100:
        raise DeclarationError(
            "a measurement is linearised a whole number of times",
            path="extended.iterations",
            expected="1 to 100",
            got=repr(iterations),
            fix="write extended(iterations=3)",
        )
    return iterations
