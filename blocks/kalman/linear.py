"""Linear motion in continuous time, and its exact discretisation over any step.

Filters that are fired by events step over whatever time has passed; so a model is kept in continuous time and
made discrete for each step, as a polynomial in dt whose coefficients are constants of the graph. Where no
power of A vanishes the polynomial is taken over a part of the step that is short enough for it, and doubled
until it is the whole: the scaling and squaring of the matrix exponential.

Source: C. Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23(3), 1978; Y.
Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, secs. 4.2
and 6.2.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean
from flowgraph.blocks.kalman.triangles import semidefinite_root
from flowgraph.blocks.signals import vector_of
from flowgraph.errors import DeclarationError

__all__ = ["LinearModel"]

_PART, _LONGEST = 0.25, 3600.0
"""How long a part may be for the sums to be exact, in units of 1/|A|; the longest step, in seconds."""


class LinearModel:
    """dx = (A x + B u) dt + dw with E[dw dw^T] = D dt, and u held over a step. Immutable.

    Over dt:

        F = sum A^k dt^k / k!        G = sum A^k B dt^(k+1) / (k+1)!
        Q = sum A^j D (A^k)^T dt^(j+k+1) / (j! k! (j+k+1))

    These end where a power of A vanishes, as for positions, velocities and accelerations. For any other A
    they are cut off at `order` powers and taken over h = dt / 2^s with |A| h at most 1/4, and then s times

        F(2h) = F F        G(2h) = F G + G        Q(2h) = F Q F^T + Q

    which is exact to the rounding for steps of up to an hour.

    Args:
        A: (n, n), 1/s.
        B: (n, m): what a control does; None where there is none.
        density: (n, n) D, the spectral density of the driving noise; (n) is its diagonal.
        order: of the sums.
        space: of the state; n numbers without names if left out.

    Raises:
        DeclarationError: where the shapes do not fit together.
    """

    def __init__(
        self,
        A: npt.ArrayLike,
        B: npt.ArrayLike | None,
        density: npt.ArrayLike,
        *,
        order: int = 12,
        space: StateSpace | None = None,
    ) -> None:
        A, D = np.array(A, dtype=float), np.array(density, dtype=float)
        n = len(A)
        self.driven = B is not None
        B = np.zeros((n, 1)) if B is None else np.array(B, dtype=float)
        D = np.diag(D) if D.shape == (n,) else D
        self.space = StateSpace(euclidean(n)) if space is None else space
        if (
            self.space.size != n
            or self.space.tangent != n
            or A.shape != (n, n)
            or D.shape != (n, n)
            or B.ndim != 2
            or len(B) != n
        ):
            raise DeclarationError(
                "the matrices of a linear model do not fit together",
                path="LinearModel",
                expected="A (n, n), B (n, m) and density (n, n)",
                got=f"A {A.shape}, B {B.shape}, density {D.shape}, {self.space}",
                fix="give each one row for each state",
            )
        self.size = n
        power = [np.eye(n)]
        while len(power) <= order and power[-1].any():
            power.append(power[-1] @ A)
        power = [p / math.factorial(k) for k, p in enumerate(power) if p.any()]
        self._F = dict(enumerate(power))
        self._G = {k + 1: p @ B / (k + 1) for k, p in enumerate(power)}
        self._doublings = 0
        endless = len(power) > order  # no power of A vanished
        if endless:
            self._norm = float(np.linalg.norm(A, 2))
            self._doublings = max(math.ceil(math.log2(self._norm * _LONGEST / _PART)), 0)
        self._Q = {k: np.zeros((n, n)) for k in range(1, 2 * len(power))}
        for j, left in enumerate(power):
            for k, right in enumerate(power):
                self._Q[j + k + 1] += left @ D @ right.T / (j + k + 1)
        if endless:
            self._Q = {k: matrix for k, matrix in self._Q.items() if k <= order + 1}
        for matrix in (*self._F.values(), *self._G.values(), *self._Q.values()):
            matrix.flags.writeable = False

    def discrete(self, dt: Any, xp: Any, kind: Any) -> tuple[Array, Array, Array]:
        """(F, G, Q) over dt seconds, in the precision `kind`; for dt (k, 1, 1) a stack of each."""
        if not self._doublings:
            F, G, Q = (_polynomial(p, dt, xp, kind) for p in (self._F, self._G, self._Q))
            return F, G, Q
        dt = xp.asarray(dt, dtype=kind)
        goes = [dt * self._norm > _PART * 2.0**s for s in range(self._doublings)]
        part = dt
        for go in goes:
            part = xp.where(go, 0.5 * part, part)
        one = xp.eye(self.size, dtype=kind)
        # F - I is doubled, not F: over a short part F is so close to I that its digits would be lost
        E = _polynomial({k: p for k, p in self._F.items() if k}, part, xp, kind)
        G, Q = (_polynomial(p, part, xp, kind) for p in (self._G, self._Q))
        for go in goes:
            F = E + one
            G = xp.where(go, F @ G + G, G)
            Q = xp.where(go, F @ Q @ F.mT + Q, Q)
            E = xp.where(go, E @ E + 2.0 * E, E)
        return E + one, G, Q

    # -- what every method asks of a motion; see `statespace` ------------------------------------------

    @property
    def linear(self) -> bool:
        """That it is."""
        return True

    def carry(self, x: Array, control: Any, w: Array | None, dt: Any, xp: Any) -> Array:
        """The states (..., n), one a row, after dt seconds with noises w (..., n) of covariance Q."""
        F, G, _ = self.discrete(dt, xp, x.dtype)
        d = x @ F.mT - x
        d = d + (G @ vector_of(control, xp)[..., None])[..., 0] if self.driven else d
        return self.space.plus(x, d if w is None else d + w, xp)

    def noise_root(self, control: Any, dt: Any, kind: Any, xp: Any) -> Array:
        """A triangular root of Q."""
        return semidefinite_root(self.discrete(dt, xp, kind)[2], xp=xp)

    def linearised(self, x: Array, control: Any, dt: Any, xp: Any) -> tuple[Array, Array, Array]:
        """(F x + G u, F, Q) at the state x (n)."""
        F, G, Q = self.discrete(dt, xp, x.dtype)
        after = (F @ x[..., None])[..., 0]
        if self.driven:
            after = (F @ x[..., None] + G @ vector_of(control, xp)[..., None])[..., 0]
        return after if self.space.flat else self.space.plus(x, after - x, xp), F, Q

    def transitions(self, time: np.ndarray) -> np.ndarray:
        """F (k - 1, n, n) from each of the times (k,) int64 ns to the next, as the smoothers ask for it."""
        dt = np.diff(time)[:, None, None] * 1e-9
        return np.asarray(self.discrete(dt, np, np.float64)[0] + np.zeros_like(dt))


def _polynomial(terms: dict[int, np.ndarray], dt: Any, xp: Any, kind: Any) -> Array:
    """The sum of matrices times powers of dt; matrices of zeros left out."""
    total, power = None, None
    for k in range(max(terms) + 1):
        if k > 0:
            power = dt if power is None else power * dt
        matrix = terms.get(k)
        if matrix is None or (not matrix.any() and total is not None):
            continue
        term = xp.asarray(matrix, dtype=kind)
        term = term if power is None else term * power
        total = term if total is None else total + term
    return total
