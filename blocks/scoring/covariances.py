"""A covariance as a setting: in code an array, in words numbers with commas between them, or a file of them.

R=0.0001                           one variance, of each number
R=1e-4,1e-4,4e-4,1e-3,1e-3,1e-3    the diagonal
R=R.txt                            rows of numbers, as numpy.savetxt writes a matrix
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.blocks.kalman.matrices import noise_matrix
from flowgraph.data.files import text_of
from flowgraph.errors import DataError, DeclarationError

__all__ = ["Covariance", "six_by_six"]


class Covariance:
    """What was given as a covariance, and the matrix that it is.

    Args:
        given: numbers with commas between them, a file of numbers, or an array.

    Raises:
        ValueError: for words that are no numbers. DataError: for a file that holds none.
    """

    def __init__(self, given: Any) -> None:
        self.given = _read(given) if isinstance(given, str | Path) else np.asarray(given, dtype=float)

    @classmethod
    def of(cls, given: Any) -> Covariance:
        """A covariance as it is, or what makes one."""
        return given if isinstance(given, cls) else cls(given)

    def matrix(self, n: int) -> np.ndarray:
        """The matrix (n, n), which has an inverse.

        Raises:
            DeclarationError: where it is none.
        """
        x = self.given
        square = math.isqrt(x.size)
        whole = x.reshape(square, square) if x.ndim == 1 and square == n and square**2 == x.size else x
        found = np.asarray(noise_matrix(whole, n, "R", kind=np.float64, xp=np))
        if not np.isfinite(found).all() or not np.linalg.eigvalsh(found)[0] > 0.0:
            raise DeclarationError(
                "this is no covariance of noise",
                path="R",
                expected="finite numbers, and all eigenvalues positive",
                got=np.array2string(found, precision=6, separator=", ").replace("\n", ""),
                fix="give variances, not deviations, or add a little to the diagonal",
            )
        return found

    def __repr__(self) -> str:
        return f"Covariance({self.given.tolist()})"


def six_by_six(graph: str, name: str, value: object) -> None:
    """Refuse what is no covariance of six numbers; None passes."""
    if value is None:
        return
    try:
        Covariance.of(value).matrix(6)
    except (DeclarationError, TypeError, ValueError) as error:
        known = isinstance(error, DeclarationError)
        raise DeclarationError(
            f"setting {name!r} is no covariance",
            path=f"{graph}.{name}",
            expected=error.expected if known else "1, 6 or 36 numbers",  # type: ignore[union-attr]
            got=error.got if known else repr(value)[:80],  # type: ignore[union-attr]
            fix="give one variance, six, or a symmetric matrix (6, 6)",
        ) from error


def _read(given: str | Path) -> np.ndarray:
    parts = str(given).split(",")
    try:
        if "_" in str(given):
            raise ValueError
        return np.array([float(part) for part in parts]) if len(parts) > 1 else np.asarray(float(parts[0]))
    except ValueError:
        if len(parts) > 1 or not Path(given).suffix:
            raise ValueError(f"no covariance is made of {str(given)[:60]!r}") from None
    try:
        rows = [line.partition("#")[0].replace(",", " ").split() for line in text_of(given).splitlines()]
        return np.array([[float(cell) for cell in row] for row in rows if row])
    except (OSError, ValueError) as error:
        raise DataError(
            "this file holds no covariance",
            path=str(given),
            expected="rows of numbers, all of one length",
            got=f"{type(error).__name__}: {error}"[:120],
            fix="write one with numpy.savetxt",
        ) from error
