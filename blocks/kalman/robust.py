"""Outliers that count for less.

A Kalman filter trusts a measurement as far as its noise is told, however far off it is. A gate takes it whole
or not at all. A robust correction weighs it: the noise of one that lies far from what is left after the
correction is made larger. The weight is found by reweighted least squares, a fixed number of rounds: the
maximum of the posterior under a noise with heavier tails.

    e = z - h(x')        d^2 = e^T R^-1 e        R <- R / w(d)
    Huber      w = min(1, c sqrt(m) / d)         (quadratic near, linear far)
    Student    w = (nu + m) / (nu + d^2)         (nu degrees of freedom)

Where nothing else tells the state, an outlier fits itself: the prior must be sharper than the outlier is far.

Sources: P. Huber, "Robust estimation of a location parameter", 1964; M. Roth, E. Özkan, F. Gustafsson, "A
Student's t filter for heavy tailed process and measurement noise", ICASSP 2013.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from flowgraph import Array
from flowgraph.errors import DeclarationError

__all__ = ["ROBUST", "Robust", "huber", "reweighted", "student_t"]


class Robust(abc.ABC):
    """How much less a measurement counts that is far off."""

    rounds: int

    @abc.abstractmethod
    def weight(self, square: Array, parts: Array, xp: Any) -> Array:
        """The weight (...) of one with this squared error (...), in deviations, of so many parts."""


@dataclass(frozen=True)
class _Huber(Robust):
    threshold: float
    rounds: int

    def weight(self, square: Array, parts: Array, xp: Any) -> Array:
        allowed = self.threshold * xp.sqrt(parts)
        far = xp.sqrt(xp.where(square > 0.0, square, 1.0))
        return xp.where((far > allowed) & (square > 0.0), allowed / far, 1.0)  # of no parts, nothing is far


@dataclass(frozen=True)
class _Student(Robust):
    freedom: float
    rounds: int

    def weight(self, square: Array, parts: Array, xp: Any) -> Array:
        return (self.freedom + parts) / (self.freedom + square)


def huber(threshold: float = 1.5, *, rounds: int = 5) -> Robust:
    """A measurement beyond `threshold` deviations a number counts by its distance, no more by its square.

    Raises:
        DeclarationError: for a threshold or a number of rounds that is not positive.
    """
    _need_positive("huber.threshold", threshold)
    _need_positive("huber.rounds", rounds)
    return _Huber(float(threshold), int(rounds))


def student_t(freedom: float = 4.0, *, rounds: int = 5) -> Robust:
    """The noise is Student's with so many degrees of freedom: few are heavy tails; very many are a Gaussian.

    Raises:
        DeclarationError: for degrees of freedom or a number of rounds that are not positive.
    """
    _need_positive("student_t.freedom", freedom)
    _need_positive("student_t.rounds", rounds)
    return _Student(float(freedom), int(rounds))


ROBUST: Mapping[str, Callable[[], Robust | None]] = {
    "none": lambda: None,
    "huber": huber,
    "student_t": student_t,
}
"""By its name, as a setting has it."""


def _need_positive(path: str, value: float) -> None:
    if not value > 0:
        raise DeclarationError(
            "this must be positive",
            path=path,
            expected="a number above 0",
            got=str(value),
            fix="leave it out",
        )


def reweighted(robust: Robust, spread: Array, residual: Array, R: Array, parts: Array, xp: Any) -> Array:
    """The noise R (..., m, m), divided by the weight of the measurement.

    Args:
        robust: how it is weighed.
        spread: H P H^T (..., m, m), of what is predicted.
        residual: (..., m), 0 where an entry is missing.
        R: of the noise as it is told (..., m, m).
        parts: how many entries there are (...).
    """
    column = residual[..., None]
    noise = R
    for _ in range(robust.rounds):
        left = noise @ xp.linalg.solve(spread + noise, column)  # z - h after the correction
        square = (left.mT @ xp.linalg.solve(R, left))[..., 0, 0]
        noise = R / robust.weight(square, parts, xp)[..., None, None]
    return noise
