"""Filters of an attitude on flights: shares of a sensor, and errors as a recording counts them.

Some recordings say at what times an error counts, and have a truth with gaps.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.metrics.errors import orientation_errors
from flowgraph.blocks.scoring.scorer import Errors
from flowgraph.errors import DeclarationError

__all__ = ["Share", "counted", "counted_errors", "scored_errors"]


def check_alpha(graph: str, name: str, alpha: float) -> None:
    """Refuse a share outside (0, 1]."""
    if not 0.0 < alpha <= 1.0:
        raise DeclarationError(
            "alpha is outside (0, 1]",
            path=graph,
            expected="0 < alpha <= 1; 1 is the gyroscope alone",
            got=f"{alpha!r}",
            fix="write alpha=0.98",
        )


Share = Annotated[float, check_alpha]


def scored_errors(estimate: Series, flight: Flight, *, settle: float = 1.0) -> dict[str, float]:
    """`orientation_errors` against the flight's truth; none without a truth.

    Where the flight's info has `scored`, a series of whether an error at that time counts (as that of BROAD:
    the body moves, and was seen), only those times are compared, all of them, and `settle` is not used.

    Raises:
        DataError: when no time is left to compare.
    """
    if flight.truth is None:
        return {}
    if "scored" not in flight.info:
        return orientation_errors(estimate, flight.truth, settle=settle)
    return orientation_errors(counted(estimate, flight), flight.truth, settle=0.0)


def counted(estimate: Series, flight: Flight) -> Series:
    """The estimate at the times whose error counts, where the flight's info has `scored`; else all of it."""
    scored = flight.info.get("scored")
    return estimate if scored is None else estimate[np.isin(estimate.time, scored.time[scored["value"]])]


def counted_errors(flight: Flight) -> Errors:
    """`scored_errors` of that flight, as a `Scorer` asks for errors."""

    def errors(estimate: Series, truth: Series, *, settle: float) -> dict[str, float]:
        return scored_errors(estimate, flight, settle=settle)

    return errors
