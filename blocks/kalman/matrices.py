"""The matrices that a filter is given as settings, checked for their shapes before anything is computed.

An array of the wrong shape often still multiplies: a vector of variances added to a covariance counts for
every row. So what is no matrix is made one where its meaning is plain, and refused where it is not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array
from flowgraph.errors import DeclarationError

__all__ = ["noise_matrix", "observation_matrix"]


def noise_matrix(given: npt.ArrayLike, n: int, path: str, *, kind: Any, xp: Any) -> Array:
    """The covariance, or spectral density (..., n, n) of noise.

    A vector (n) is its diagonal, and one number is the variance of each entry.

    Raises:
        DeclarationError: where it has another shape, is not symmetric, or has a negative variance.
    """
    shape = np.shape(given)
    if shape[-2:] == (n, n):
        _need_covariance(given, path)
        return xp.asarray(given, dtype=kind)
    if shape in ((), (n,)):
        given = np.diag(np.broadcast_to(np.asarray(given, dtype=float), (n,)))
        _need_covariance(given, path)
        return xp.asarray(given, dtype=kind)
    raise DeclarationError(
        "the noise does not fit",
        path=path,
        expected=f"a matrix ({n}, {n}), its diagonal ({n},) or one variance",
        got=f"shape {shape}",
        fix="give it one row and one column for each number that is noisy",
    )


def observation_matrix(given: npt.ArrayLike, m: int, n: int, path: str, *, kind: Any, xp: Any) -> Array:
    """H (..., m, n): what each of m numbers reads of n.

    Raises:
        DeclarationError: where it has another shape.
    """
    if np.shape(given)[-2:] != (m, n):
        raise DeclarationError(
            "the matrix of a measurement does not fit",
            path=path,
            expected=f"shape ({m}, {n}): a row for each measured number, a column for each of the state",
            got=f"shape {np.shape(given)}",
            fix="write H=np.eye(m, n), for example, where the first m are measured",
        )
    return xp.asarray(given, dtype=kind)


def _need_covariance(given: Any, path: str) -> None:
    if not isinstance(given, np.ndarray | list | tuple):
        return  # computed by the graph: its numbers are not known here
    matrix = np.asarray(given, dtype=float)
    variances = np.diagonal(matrix, axis1=-2, axis2=-1)
    size = np.abs(matrix).max(initial=0.0)
    if (np.abs(matrix - matrix.mT) <= 1e-9 * size).all() and (variances >= 0.0).all():
        return
    raise DeclarationError(
        "this is no covariance of noise",
        path=path,
        expected="finite numbers, symmetric, and no negative variance",
        got=np.array2string(matrix, precision=6, separator=", ").replace("\n", ""),
        fix="give variances, not deviations, and covariances the same both ways",
    )
