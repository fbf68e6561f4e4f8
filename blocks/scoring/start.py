"""Where a filter starts: at the truth, at what the file shows, or with a heading of which nothing is known.

No heading is invented in silence: what was taken is a note of the case.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, to_matrix
from flowgraph.blocks.metrics.truth import interpolate, known
from flowgraph.blocks.scoring.settings import Settings, left_out_or, one_of
from flowgraph.errors import DataError

if TYPE_CHECKING:
    from flowgraph.blocks.scoring.cases import OnFlight

__all__ = ["UNKNOWN_HEADING", "Started", "StartPose"]

UNKNOWN_HEADING = math.pi / math.sqrt(3.0)
"""The deviation of an angle of which nothing is known, rad: that of a uniform one."""

_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class StartPose(NamedTuple):
    """Position (3), attitude (4), and the deviation of the heading in rad, None where it is as usual."""

    position: np.ndarray
    attitude: np.ndarray
    heading: float | None


@dataclass(frozen=True)
class Started(Settings):
    """Where a filter starts.

    Args:
        start: truth, file (the first that was measured) or unknown_yaw (nothing is known of the heading); if
            left out, what there is, in this order, but for filters of measured poses, which start at the
            first.
        start_heading: rad, the heading at the start; `start.heading` on the command line.
    """

    start: Annotated[str | None, left_out_or(one_of("truth", "file", "unknown_yaw"))] = None
    start_heading: float | None = None

    def pose(
        self,
        on: OnFlight,
        time: int,
        position: np.ndarray | None,
        attitude: np.ndarray | None,
        *,
        usual: str = "truth",
    ) -> StartPose:
        """The pose to start from, and a note that says whose it is.

        Args:
            time: ns, of the start.
            position, attitude: what the file shows, None where it shows none.
            usual: what is taken first if `start` is left out.

        Raises:
            DataError: where what is asked for is not there.
        """
        truth = on.flight.truth
        at = np.array([time])
        told = set() if truth is None or not len(truth) else {"position", "attitude"} & set(truth.leaves)
        shown = {"truth": "attitude" in told, "file": attitude is not None, "unknown_yaw": True}
        chosen = self.start
        if chosen is None:
            chosen = next(name for name in (usual, "truth", "file", "unknown_yaw") if shown[name])
        if not shown[chosen]:
            raise DataError(
                f"there is no start of this kind for {on.name}",
                path=f"{on.name}.start",
                expected="a truth with attitudes" if chosen == "truth" else "a stream of attitudes",
                got=", ".join(on.flight.streams) + ("" if truth is None else " and a truth"),
                fix="write --set start=unknown_yaw, or --set start.heading=RADIANS",
            )
        place = np.zeros(3) if position is None else np.asarray(position)
        turn, heading = _LEVEL if attitude is None else np.asarray(attitude), None
        if chosen == "truth" and truth is not None:
            near = truth if known(truth, at)[0] else _whole(truth, told)
            place = interpolate(near, "position", at)[0] if "position" in told else place
            turn = interpolate(near, "attitude", at)[0]
            on.note("assumed", "the start is the truth's")
        elif chosen == "file":
            on.note("assumed", "the start has the first attitude that was measured")
        else:
            turn, heading = _turned(turn, 0.0), UNKNOWN_HEADING
            if self.start_heading is None:
                said = f"0 rad with a deviation of {UNKNOWN_HEADING:.3g} rad"
                on.note("assumed", f"nothing is known of the heading at the start: {said}")
        if self.start_heading is not None:
            turn, heading = _turned(turn, self.start_heading), None
            on.note("assumed", f"the heading at the start is {self.start_heading:g} rad, as it was set")
        return StartPose(place, turn, heading)


def _whole(truth, fields):  # type: ignore[no-untyped-def]
    """The rows of a truth that are known, or all of it where none is."""
    rows = np.all([np.isfinite(truth[name]).all(axis=-1) for name in fields], axis=0)
    return truth[rows] if rows.any() else truth


def _turned(attitude: np.ndarray, heading: float) -> np.ndarray:
    """The attitude, turned about the vertical until its x axis heads there (rad from the world's x axis)."""
    R = to_matrix(attitude, xp=np)
    now = math.atan2(R[1, 0], R[0, 0])
    about_z = from_rotation_vector(np.array([0.0, 0.0, heading - now]), xp=np)
    return np.asarray(multiply(about_z, attitude, xp=np))
