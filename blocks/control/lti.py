"""Linear systems in continuous time, in series and in loops, until they are one and become a plant.

A loop of continuous systems has no clock to close it at. Its parts are joined on paper, matrix by matrix, and
what comes out is one `LinearModel`, exact however seldom it is looked at.

Source: K. Astrom and R. Murray, "Feedback Systems", 2008, secs. 5.3, 8.3 and 10.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.kalman import LinearModel
from flowgraph.errors import DeclarationError

__all__ = ["Lti", "pid_action", "transfer"]


@dataclass(frozen=True, eq=False)
class Lti:
    """dx/dt = A x + B u, y = C x + D u.

    Args:
        A, B, C, D: (n, n), (n, m), (p, n), (p, m).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    @property
    def model(self) -> LinearModel:
        """Its motion, for a `plant`; without noise."""
        return LinearModel(self.A, self.B, np.zeros(len(self.A)))

    def then(self, other: Lti) -> Lti:
        """`other` behind this one: its input is y."""
        zero = np.zeros((len(self.A), len(other.A)))
        return Lti(
            np.block([[self.A, zero], [other.B @ self.C, other.A]]),
            np.vstack([self.B, other.B @ self.D]),
            np.hstack([other.D @ self.C, other.C]),
            other.D @ self.D,
        )

    def fed_back(self) -> Lti:
        """The loop u = r - y, with r for its input.

        Raises:
            DeclarationError: where y follows u at once, so that u would follow itself.
        """
        if self.D.any():
            raise DeclarationError(
                "this loop has no state in it",
                path="Lti.fed_back",
                expected="D = 0: an output that follows the input with some inertia",
                got=f"D = {self.D.tolist()}",
                fix="put the plant, or a filter, into the loop",
            )
        return Lti(self.A - self.B @ self.C, self.B, self.C, self.D)


def transfer(numerator: Sequence[float], denominator: Sequence[float]) -> Lti:
    """The system of a transfer function of s, highest powers first, in its controllable form.

    Raises:
        DeclarationError: where the numerator is of the higher degree: no system differentiates.
    """
    a, b = np.atleast_1d(np.trim_zeros(np.asarray(denominator, float), "f")), np.asarray(numerator, float)
    n = len(a) - 1
    b = np.trim_zeros(np.atleast_1d(b), "f")
    if not len(a) or len(b) > n + 1:
        raise DeclarationError(
            "this transfer function is no system",
            path="transfer",
            expected="a denominator of at least the numerator's degree",
            got=f"{list(numerator)} / {list(denominator)}",
            fix="filter what is differentiated: s / (T s + 1)",
        )
    b, a = np.r_[np.zeros(n + 1 - len(b)), b] / a[0], a / a[0]
    A = np.vstack([-a[1:], np.eye(n)[:-1]]) if n else np.zeros((0, 0))
    return Lti(A, np.eye(n, 1), (b[1:] - a[1:] * b[0])[None, :], np.array([[b[0]]]))


def pid_action(gain: float, integral: float, derivative: float, *, filter: float) -> Lti:
    """gain + integral / s + derivative s / (filter s + 1), in continuous time; `filter` in s, above 0."""
    numerator = np.polyadd(np.polymul([gain, integral], [filter, 1.0]), np.array([derivative, 0.0, 0.0]))
    return transfer(list(numerator), [filter, 1.0, 0.0])
