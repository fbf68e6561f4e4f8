"""Filters that believe in a Gaussian: the methods that linearise a model, or send points through it.

Each is two functions of a belief, whatever the model: what it becomes over a step, and what a measurement
makes of it. The corrections are those of `kalman` and `unscented`.

    linear       the Kalman filter, of models that are linear
    extended     with the derivatives of the model; iterated, with those at the corrected state
    square root  the same on a triangular root of the covariance, with twice the digits
    unscented    with sigma points of state and noise
    cubature     with the 2n points of equal weight

The iterated correction of a state x0 plus d minimises |d|^2 in P^-1 plus |z minus h(x0 plus d)|^2 in R^-1 by
Gauss-Newton steps from d = 0, all in the tangent space at x0:

    d' = K (z minus h(x0 plus d) + H d)        H = dh/dd at d        K = P H^T (H P H^T + R)^-1

Sources: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, secs. 5.2, 10.3 and 10.5.2 (iterated); I. Arasaratnam and S. Haykin, "Cubature Kalman filters", IEEE TAC
54(6), 2009.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import Any

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import correct as correct_jointly
from flowgraph.blocks.kalman.filters import moved, where_any
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.kalman.roots import correct_root
from flowgraph.blocks.kalman.triangles import lower_root, semidefinite_root
from flowgraph.blocks.signals import Gaussian, GaussianRoot, KalmanInnovation
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.blocks.unscented.filters import motion_cross, through_motion, through_observation
from flowgraph.blocks.unscented.sigma_points import GAUSSIAN, SigmaPoints
from flowgraph.errors import DeclarationError
from flowgraph.language.block import Limit, When

__all__ = ["Extended", "GaussianMethod", "Linear", "SquareRoot", "Unscented", "innovation_log_likelihood"]


class GaussianMethod(abc.ABC):
    """A method whose belief is a mean and a covariance, in one form or another."""

    def begin(self, start: Gaussian, space: StateSpace, xp: Any) -> Any:
        """What is kept of the belief, at first."""
        return start

    def believed(self, kept: Any, space: StateSpace, xp: Any) -> Gaussian:
        """The mean and covariance of what is kept."""
        return kept

    @abc.abstractmethod
    def predicted(self, kept: Any, control: Any, motion: Motion, dt: Any, xp: Any) -> Any:
        """What is kept, after dt seconds with a control that is held over the step."""

    def crossed(self, kept: Any, control: Any, motion: Motion, dt: Any, xp: Any) -> Array:
        """The covariance (t, t) of what is kept and of what `predicted` makes of it, for a smoother.

        Raises:
            DeclarationError: of a method that has none.
        """
        raise DeclarationError(
            "this method has no smoother that goes back over its run",
            path=f"filtered.{type(self).__name__}",
            expected="linear(), extended(), square_root(), information(), unscented() or cubature()",
            got=repr(self),
            fix="leave smoothing out, or use another method",
        )

    @abc.abstractmethod
    def corrected(
        self, kept: Any, message: Any, measurement: Measurement, gate: float | None, xp: Any
    ) -> tuple[Any, When, Array]:
        """What is kept with a message, the innovation, present where any entry was measured, and the
        log-likelihood of the message."""

    def limits(self) -> tuple[Limit, ...]:
        """Kinds of number that it cannot be computed in."""
        return ()

    def need(self, model: Motion | Measurement) -> None:  # noqa: B027 (most methods take any)
        """Refuse a model that it cannot be used with."""


@dataclass(frozen=True)
class Extended(GaussianMethod):
    """The extended Kalman filter; see `extended`."""

    iterations: int = 1
    robust: Robust | None = None

    def predicted(self, kept: Gaussian, control: Any, motion: Motion, dt: Any, xp: Any) -> Gaussian:
        mean, F, Q = motion.linearised(kept.mean, control, dt, xp)
        P = F @ kept.covariance @ F.mT
        P = P if Q is None else P + Q
        return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))

    def crossed(self, kept: Gaussian, control: Any, motion: Motion, dt: Any, xp: Any) -> Array:
        return kept.covariance @ motion.linearised(kept.mean, control, dt, xp)[1].mT

    def corrected(
        self, kept: Gaussian, message: Any, measurement: Measurement, gate: float | None, xp: Any
    ) -> tuple[Gaussian, When, Array]:
        x, P, space = kept.mean, kept.covariance, measurement.space
        measured = measurement.vector(message, xp)
        d = None
        for _ in range(self.iterations):
            z, H, R = measurement.linearised(x, d, message, xp)
            apart = measurement.apart(measured, z, xp)
            present = ~xp.isnan(apart)
            residual = xp.where(present, apart, 0.0)
            if d is None:
                found = correct_jointly(
                    P, residual, H, R, present=present, gate=gate, space=space, robust=self.robust, xp=xp
                )
                innovation = found.innovation
            else:
                residual = residual + xp.where(present, (H @ d[..., None])[..., 0], 0.0)
                found = correct_jointly(
                    P, residual, H, R, present=present, space=space, robust=self.robust, xp=xp
                )
            d = found.shift
        covariance = found.covariance
        if self.iterations > 1:  # what was refused at first is refused
            d = xp.where(innovation.accepted, d, 0.0)
            covariance = xp.where(innovation.accepted, covariance, P)
        posterior = Gaussian(mean=moved(x, d, space, xp), covariance=covariance)
        return posterior, where_any(present, innovation, xp), innovation_log_likelihood(innovation, xp=xp)


@dataclass(frozen=True)
class Linear(Extended):
    """The Kalman filter; see `linear`."""

    def need(self, model: Motion | Measurement) -> None:
        if not model.linear:
            raise DeclarationError(
                "the Kalman filter needs a model that is linear",
                path=f"linear.{type(model).__name__}",
                expected="LinearModel or DiscreteModel, and LinearMeasurement",
                got=repr(model),
                fix="write method=extended(): it takes any model, and is the same filter for a linear one",
            )


@dataclass(frozen=True)
class SquareRoot(GaussianMethod):
    """The extended Kalman filter on a triangular root of the covariance; see `square_root`."""

    def begin(self, start: Gaussian, space: StateSpace, xp: Any) -> GaussianRoot:
        return GaussianRoot(mean=start.mean, root=semidefinite_root(start.covariance, xp=xp))

    def believed(self, kept: GaussianRoot, space: StateSpace, xp: Any) -> Gaussian:
        return Gaussian(mean=kept.mean, covariance=kept.root @ kept.root.mT)

    def predicted(self, kept: GaussianRoot, control: Any, motion: Motion, dt: Any, xp: Any) -> GaussianRoot:
        mean, F, Q = motion.linearised(kept.mean, control, dt, xp)
        wide = F @ kept.root
        wide = wide if Q is None else xp.concat([wide, semidefinite_root(Q, xp=xp)], axis=-1)
        return GaussianRoot(mean=mean, root=lower_root(wide, xp=xp))

    def crossed(self, kept: GaussianRoot, control: Any, motion: Motion, dt: Any, xp: Any) -> Array:
        F = motion.linearised(kept.mean, control, dt, xp)[1]
        return kept.root @ (F @ kept.root).mT

    def corrected(
        self, kept: GaussianRoot, message: Any, measurement: Measurement, gate: float | None, xp: Any
    ) -> tuple[GaussianRoot, When, Array]:
        z, H, R = measurement.linearised(kept.mean, None, message, xp)
        apart = measurement.apart(measurement.vector(message, xp), z, xp)
        present, space = ~xp.isnan(apart), measurement.space
        shift, root, innovation = correct_root(
            kept.root, xp.where(present, apart, 0.0), H, R, present=present, gate=gate, space=space, xp=xp
        )
        posterior = GaussianRoot(mean=moved(kept.mean, shift, space, xp), root=root)
        return posterior, where_any(present, innovation, xp), innovation_log_likelihood(innovation, xp=xp)


@dataclass(frozen=True)
class Unscented(GaussianMethod):
    """The unscented Kalman filter; see `unscented`."""

    points: SigmaPoints = GAUSSIAN

    def limits(self) -> tuple[Limit, ...]:
        return self.points.limits()

    def predicted(self, kept: Gaussian, control: Any, motion: Motion, dt: Any, xp: Any) -> Gaussian:
        shaken = motion.noise_root(control, dt, kept.mean.dtype, xp)
        carry = lambda x, w: motion.carry(x, control, w, dt, xp)
        mean, P = through_motion(
            kept.mean, kept.covariance, carry, shaken, space=motion.space, points=self.points, xp=xp
        )
        return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))

    def crossed(self, kept: Gaussian, control: Any, motion: Motion, dt: Any, xp: Any) -> Array:
        shaken = motion.noise_root(control, dt, kept.mean.dtype, xp)
        carry = lambda x, w: motion.carry(x, control, w, dt, xp)
        return motion_cross(
            kept.mean, kept.covariance, carry, shaken, space=motion.space, points=self.points, xp=xp
        )

    def corrected(
        self, kept: Gaussian, message: Any, measurement: Measurement, gate: float | None, xp: Any
    ) -> tuple[Gaussian, When, Array]:
        kind, measured = kept.mean.dtype, measurement.vector(message, xp)
        inside = measurement.covariance(message, 0, kind, xp) if measurement.inside else None
        posterior, found = through_observation(
            kept,
            measured,
            lambda x, v: measurement.seen(x, v, message, xp),
            None if measurement.inside else lambda m: measurement.covariance(message, m, kind, xp),
            None if inside is None else semidefinite_root(inside, xp=xp),
            space=measurement.space,
            measured_space=measurement.measured_space,
            points=self.points,
            gate=gate,
            xp=xp,
        )
        return posterior, found, innovation_log_likelihood(found.value, xp=xp)


def innovation_log_likelihood(innovation: KalmanInnovation, *, xp: Any) -> Array:
    """The logarithm of the density of what was measured, given all before it.

        -(nis + log det S + parts log(2 pi)) / 2

    Entries that are missing add nothing. A measurement that a gate refused counts as well: it is what the
    model says of it.
    """
    S = innovation.covariance
    root = xp.linalg.cholesky(S)
    diagonal = xp.sum(root * xp.eye(S.shape[-1], dtype=S.dtype), axis=-1)
    determinant = 2.0 * xp.sum(xp.log(diagonal), axis=-1)
    return -0.5 * (innovation.nis + determinant + math.log(2.0 * math.pi) * innovation.parts)
