"""What a score carries: sums while a run goes, and the figures that they come to."""

from __future__ import annotations

from flowgraph import Array, Signal, boolean, integer, real

__all__ = [
    "Bounds",
    "Extremes",
    "NisFigures",
    "NisSums",
    "PoseFigures",
    "PoseSums",
    "Settling",
    "Tally",
]


class Tally(Signal):
    """How many values there were, and the sum of them or of their squares."""

    count: Array = real()
    total: Array = real()


class Extremes(Signal):
    """The least and the largest value so far."""

    least: Array = real()
    most: Array = real()


class PoseFigures(Signal):
    """The figures of `pose_errors`: m, m/s, degrees, and shares from 0 to 1."""

    position_rmse_m: Array = real()
    position_mean_m: Array = real()
    position_max_m: Array = real()
    position_3sigma: Array = real()
    velocity_rmse_mps: Array = real()
    attitude_rmse_deg: Array = real()
    attitude_mean_deg: Array = real()
    attitude_max_deg: Array = real()
    tilt_rmse_deg: Array = real()
    heading_rmse_deg: Array = real()
    tilt_3sigma: Array = real()
    heading_3sigma: Array = real()
    nees_mean: Array = real()
    nees_inside: Array = real()
    compared_ticks: Array = real()


class NisFigures(Signal):
    """The figures of `nis_summary` but for its band, which follows from `nis_parts`, how many numbers there
    were."""

    nis_mean: Array = real()
    nis_inside: Array = real()
    nis_count: Array = real()
    nis_parts: Array = real()
    nis_rejected: Array = real()


class PoseSums(Signal):
    """What `PoseFigures` are made of; first: ns, when the estimate was first there."""

    first: Array = integer(dtype="int64", unit="ns")
    count: Array = real()
    sums: Array = real(12)
    most: Array = real(2)


class NisSums(Signal):
    """What `NisFigures` are made of."""

    nis: Array = real()
    parts: Array = real()
    inside: Array = real()
    count: Array = real()
    rejected: Array = real()


class Bounds(Signal):
    """The extremes, and whether there was a value."""

    extremes: Extremes
    any: Array = boolean()


class Settling(Signal):
    """When it began, and how long after that a value was last outside."""

    first: Array = integer(dtype="int64", unit="ns")
    last: Array = real(unit="s")
