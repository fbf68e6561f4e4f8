"""How two runs of one filter differ, by the figures that a bound may be of."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flowgraph.data.result import Result
from flowgraph.data.series import Series

POSITION, ATTITUDE = "position_difference_rms_m", "attitude_difference_rms_deg"
RELATIVE, DECISIONS = "estimate_difference_relative", "decisions_differing"
FIGURES = (POSITION, ATTITUDE, RELATIVE, DECISIONS)
"""What a bound may be of."""


def differences(reference: Result, found: Mapping[str, Series], estimate: str) -> dict[str, float]:
    """How two runs of one filter differ, by the figures of `FIGURES` that it has.

    A decision is an event of an output in which a truth value or an integer differs, or that only one has.
    The relative difference is the root mean square of a leaf's, divided by that of the leaf: the worst.
    """
    differing = 0
    for name, ours in found.items():
        theirs = reference.series[name]
        common, a, b = np.intersect1d(ours.time, theirs.time, return_indices=True)
        differing += len(ours.time) + len(theirs.time) - 2 * len(common)
        differs = np.zeros(len(common), bool)
        for leaf, x in ours.leaves.items():
            if x.dtype.kind != "f":
                unequal = x[a] != theirs.leaves[leaf][b]
                differs |= unequal.reshape(len(common), -1).any(axis=1)
        differing += int(differs.sum())
    figures: dict[str, float] = {DECISIONS: differing}
    ours, theirs = found[estimate], reference.series[estimate]
    _, a, b = np.intersect1d(ours.time, theirs.time, return_indices=True)
    worst = 0.0
    for leaf, x in ours.leaves.items():
        if x.dtype.kind != "f" or leaf.endswith("covariance"):
            continue
        p, q = x[a].reshape(len(a), -1), theirs.leaves[leaf][b].reshape(len(a), -1)
        if leaf == "position":
            figures[POSITION] = _rms(p - q)
        if leaf == "attitude" and p.shape[-1] == 4:
            figures[ATTITUDE] = float(np.degrees(np.sqrt(np.mean(_turned(p, q) ** 2))))
        size = _rms(q)
        worst = max(worst, _rms(p - q) / size if size else float(_rms(p - q) > 0.0))
    return figures | {RELATIVE: worst}


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(x * x, axis=-1)))) if x.size else 0.0


def _turned(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The angles between quaternions, in rad; those of the words need not be of unit length."""
    p, q = (x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-300) for x in (p, q))
    p = np.where(np.sum(p * q, axis=-1, keepdims=True) < 0.0, -p, p)
    return np.asarray(4.0 * np.arcsin(np.clip(np.linalg.norm(p - q, axis=-1) / 2.0, 0.0, 1.0)))
