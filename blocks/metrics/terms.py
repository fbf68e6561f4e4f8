"""What a pose or a measurement is off by at a tick: the terms that every figure sums up, or has the most of.

The scorers of recorded runs and the scores that are blocks both sum these up, so that their figures are the
same. Leading axes are ticks; a block has none.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.rotations import conjugate, multiply, parted, to_matrix, to_rotation_vector
from flowgraph.blocks.metrics.chi_square import chi_square
from flowgraph.blocks.signals import NisSums

__all__ = ["FIGURES", "attitude_terms", "nis_limits", "nis_terms", "place_terms", "turn_error"]

FIGURES = (
    ("position_rmse_m", "position", "root"),
    ("position_mean_m", "position", "mean"),
    ("position_max_m", "position", "most"),
    ("position_3sigma", "position_held", "mean"),
    ("velocity_rmse_mps", "velocity", "root"),
    ("attitude_rmse_deg", "attitude", "root"),
    ("attitude_mean_deg", "attitude", "mean"),
    ("attitude_max_deg", "attitude", "most"),
    ("tilt_rmse_deg", "tilt", "root"),
    ("heading_rmse_deg", "heading", "root"),
    ("tilt_3sigma", "tilt_held", "mean"),
    ("heading_3sigma", "heading_held", "mean"),
)
"""Of each figure its name, its term, and what it is of all ticks: the mean, the root of the mean of squares,
or the most."""

_DEGREES = 180.0 / np.pi


def turn_error(estimate: Array, truth: Array, xp: Any) -> Array:
    """Log(q^-1 q_true) (..., 3), rad, body, of attitudes (..., 4)."""
    return to_rotation_vector(multiply(conjugate(estimate, xp=xp), truth, xp=xp), xp=xp)


def place_terms(error: Array, covariance: Array | None, xp: Any, *, of: str = "position") -> dict[str, Array]:
    """The length of an error (..., 3), and the share of axes within three deviations, given a covariance."""
    found = {of: xp.sqrt(xp.linalg.vecdot(error, error))}
    if covariance is not None:
        held = _held(error, _diagonal(covariance, xp), xp)
        found[f"{of}_held"] = xp.sum(held, axis=-1) / 3.0
    return found


def attitude_terms(estimate: Array, truth: Array, covariance: Array | None, xp: Any) -> dict[str, Array]:
    """Of attitudes (..., 4): the angle between them with its tilt and heading, degrees, and which are within
    three deviations, given the covariance (..., 3, 3) of the rotation vector in the body: that of the turn in
    the world is R P R^T."""
    turn = turn_error(estimate, truth, xp)
    off = multiply(estimate, conjugate(truth, xp=xp), xp=xp)
    root = lambda a, b: xp.sqrt(a * a + b * b)  # of a unit quaternion, which needs no more care
    tilt, heading = parted(off, xp=xp, hypot=root)
    angle = xp.sqrt(xp.linalg.vecdot(turn, turn))
    found = {"attitude": _DEGREES * angle, "tilt": _DEGREES * tilt, "heading": _DEGREES * heading}
    if covariance is not None:
        R = to_matrix(estimate, xp=xp)
        held = _held((R @ turn[..., :, None])[..., 0], xp.sum((R @ covariance) * R, axis=-1), xp)
        found |= {"tilt_held": xp.sum(held[..., :2], axis=-1) / 2.0, "heading_held": held[..., 2]}
    return found


def nis_limits(width: int, probability: float) -> np.ndarray:
    """The band (2, width + 1) in which an honest NIS is with this probability, by how many numbers it has."""
    tail, parts = 0.5 * (1.0 - probability), np.maximum(np.arange(width + 1), 1)
    return np.stack([chi_square(tail, parts), chi_square(1.0 - tail, parts)])


def nis_terms(innovation: Any, limits: Array, xp: Any) -> NisSums:
    """What an innovation adds to the sums: where nothing was measured, nothing.

    Args:
        innovation: with nis (...) and residual (..., m), and perhaps parts and accepted.
        limits: those of `nis_limits`.
    """
    nis, width = innovation.nis, innovation.residual.shape[-1]
    parts = innovation.parts if hasattr(innovation, "parts") else 0.0 * nis + float(width)
    low, high = (xp.take(row, xp.astype(xp.round(parts), xp.int32), axis=0) for row in limits)
    there = xp.astype(parts > 0.0, nis.dtype)
    refused = ~innovation.accepted if hasattr(innovation, "accepted") else nis < 0.0
    return NisSums(
        nis=xp.where(parts > 0.0, nis, 0.0),
        parts=parts,
        inside=there * xp.astype((nis >= low) & (nis <= high), nis.dtype),
        count=there,
        rejected=there * xp.astype(refused, nis.dtype),
    )


def _held(error: Array, variance: Array, xp: Any) -> Array:
    return xp.astype(error * error <= 9.0 * variance, error.dtype)


def _diagonal(P: Array, xp: Any) -> Array:
    return xp.sum(P * xp.eye(P.shape[-1], dtype=P.dtype), axis=-1)
