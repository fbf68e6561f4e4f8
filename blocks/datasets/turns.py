"""Attitudes that tables hold in other forms: angles about three axes, and rotation matrices."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph.blocks.geometry.rotations import multiply
from flowgraph.errors import DataError

__all__ = ["ORDERS", "from_angles", "from_matrices", "from_ned_attitude"]

ORDERS = ("zyx", "zxy", "xyz", "xzy", "yxz", "yzx")
"""In which order the body turns about its own axes; the first is that of yaw, pitch, roll."""


def from_angles(angles: np.ndarray, order: str) -> np.ndarray:
    """Quaternions (n, 4), w first, body to world, of the angles (n, 3) in rad about x, y and z (roll, pitch,
    yaw), taken in one of `ORDERS`; rows with a NaN are NaN."""
    whole = np.isfinite(angles).all(axis=1)
    found = np.full((len(angles), 4), np.nan)
    if whole.any():
        picked = angles[whole][:, ["xyz".index(axis) for axis in order]]
        turned = scipy.spatial.transform.Rotation.from_euler(order.upper(), picked)
        found[whole] = turned.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return found


_ENU, _FLU = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0]), np.array([0.0, 1.0, 0.0, 0.0])
"""North, east, down to east, north, up; forward, left, up to forward, right, down."""


def from_ned_attitude(q: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4), w first, of forward, left, up in east, north, up, of those of forward, right, down
    in north, east, down; rows with a NaN are NaN."""
    return np.asarray(multiply(_ENU, multiply(q, _FLU, xp=np), xp=np))


def from_matrices(values: np.ndarray, where: Callable[[int], str], *, by_rows: bool) -> np.ndarray:
    """Quaternions (n, 4), w first, body to world, of rotation matrices (n, 9), by rows or by columns;
    rows with a NaN are NaN, and rows of zeros, which say that the body was lost, are zeros.

    Raises:
        DataError: for a matrix that is no rotation, to 1 %.
    """
    matrices = values.reshape(-1, 3, 3)
    matrices = matrices if by_rows else matrices.transpose(0, 2, 1)
    whole = np.isfinite(values).all(axis=1)
    found = np.full((len(values), 4), np.nan)
    lost = (values == 0.0).all(axis=1)
    found[lost] = 0.0
    whole &= ~lost
    if not whole.any():
        return found
    square = matrices[whole] @ matrices[whole].transpose(0, 2, 1)
    off = np.abs(square - np.eye(3)).max(axis=(1, 2)) > 0.02
    bad = np.flatnonzero(off | (np.linalg.det(matrices[whole]) < 0.0))
    if len(bad):
        k = int(np.flatnonzero(whole)[bad[0]])
        raise DataError(
            "a matrix is no rotation",
            path=where(k),
            expected="three unit columns at right angles, right-handed, to 1 %",
            got=str(np.round(matrices[k], 4).tolist()),
            fix="check the order of the columns, or mend or delete the row",
        )
    turned = scipy.spatial.transform.Rotation.from_matrix(matrices[whole])
    found[whole] = turned.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return found
