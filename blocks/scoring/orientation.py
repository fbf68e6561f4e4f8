"""Errors as a recording counts them: only at the times that it says count, against a truth with gaps."""

from __future__ import annotations

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.metrics.errors import orientation_errors

__all__ = ["scored_errors"]


def scored_errors(estimate: Series, flight: Flight, *, settle: float = 1.0) -> dict[str, float]:
    """`orientation_errors` against the flight's truth; none without a truth.

    Where the flight's info has `scored`, a series of whether an error at that time counts (as that of BROAD:
    the body moves, and was seen), only those times are compared, all of them, and `settle` is not used.

    Raises:
        DataError: when no time is left to compare.
    """
    if flight.truth is None:
        return {}
    scored = flight.info.get("scored")
    if scored is None:
        return orientation_errors(estimate, flight.truth, settle=settle)
    counted = scored.time[scored["value"]]
    return orientation_errors(estimate[np.isin(estimate.time, counted)], flight.truth, settle=0.0)
