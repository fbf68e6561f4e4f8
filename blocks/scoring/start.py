"""Where a filter starts: at the truth, at what the file shows, or with a heading of which nothing is known.

A filter starts at the time of the pose that it starts with, and what came before is left out: a pose of the
future is none of now. No heading is invented in silence: what was taken is a note of the case.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.rotations import from_rotation_vector, level, multiply, to_matrix
from flowgraph.blocks.inertial.alignment import (
    Start,
    orientation_start,
    rest_seconds,
    static_alignment,
    usable,
)
from flowgraph.blocks.kalman.lost import UNKNOWN_TURN
from flowgraph.blocks.metrics.truth import interpolate, known
from flowgraph.blocks.scoring.settings import Settings, left_out_or, one_of
from flowgraph.errors import DataError

if TYPE_CHECKING:
    from flowgraph.blocks.scoring.cases import OnFlight

__all__ = ["MAGNETIC_HEADING", "UNKNOWN_HEADING", "Started", "StartPose", "from_first", "turned"]

UNKNOWN_HEADING = UNKNOWN_TURN
"""The deviation of a heading of which nothing is known, rad."""

MAGNETIC_HEADING = 0.3
"""The deviation of a heading that one look at a magnetometer shows, rad: iron is near."""

_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
_ATTITUDES = ("vicon", "pose", "attitude", "magnetic_attitude")


class StartPose(NamedTuple):
    """Where and when a filter starts.

    Args:
        time: ns.
        position: (3,) m. attitude: (4,), body to world.
        heading: the deviation of the heading in rad; None where it is as usual.
        told: whether it is the truth's.
        tilted: whether the attitude has the body's tilt; else it is that of a level one.
        inputs: those from that time on.
    """

    time: int
    position: np.ndarray
    attitude: np.ndarray
    heading: float | None
    told: bool
    tilted: bool
    inputs: dict[str, Series]

    @property
    def unknown(self) -> bool:
        """Whether nothing is known of the heading."""
        return self.heading == UNKNOWN_HEADING


class _Shown(NamedTuple):
    """An attitude that a file shows: when, which, how sure its heading is, and whose it is."""

    time: int
    attitude: np.ndarray
    heading: float | None
    whose: str


@dataclass(frozen=True)
class Started(Settings):
    """Where a filter starts.

    Args:
        start: truth, file (the first attitude that was measured, else the magnetometer's) or unknown_yaw
            (nothing is known of the heading); if left out, what there is, in this order, but for filters of
            measured poses, which start at the first.
        start_heading: rad, the heading at the start; `start.heading` on the command line.
    """

    start: Annotated[str | None, left_out_or(one_of("truth", "file", "unknown_yaw"))] = None
    start_heading: float | None = None

    def pose(
        self,
        on: OnFlight,
        inputs: Mapping[str, Series],
        *,
        position: Series | None = None,
        attitude: Series | None = None,
        shown: np.ndarray | None = None,
        usual: str = "truth",
        rests: float = 0.0,
        deviates: bool = True,
    ) -> StartPose:
        """The pose to start from, and a note that says whose it is.

        A row that is not finite, and a quaternion that is none, start nothing: the first that does is taken.

        Args:
            inputs: of the graph. What comes before the start is left out of them, with a note.
            position, attitude: the series that measure them, None where the file has none. Where there is no
                `attitude`, the file may still show one, by another stream or by a magnetometer.
            shown: (4,), the attitude that the file shows at its first reading, where the caller has found it;
                then a heading of which nothing is known is about that one, for a filter that measures it.
            usual: what is taken first if `start` is left out.
            rests: for so many seconds from the first input on the body rests, so that a pose of that time is
                that of the first input, and nothing need be left out.
            deviates: whether the filter can be told how sure the heading is.

        Raises:
            DataError: where what is asked for is not there, or nothing comes after it.
        """
        first = min(int(series.time[0]) for series in inputs.values())
        told = self._truth(on, first)
        place = _first(position, "position")
        measured = _first(attitude, "attitude")
        if shown is not None:
            seen: _Shown | None = _Shown(
                first, shown, None, "the attitude of the first force and field that were"
            )
        elif measured is not None:
            seen = _Shown(*measured, None, "the first attitude that was")
        else:
            seen = _compass(on)
        there = {"truth": told is not None, "file": seen is not None, "unknown_yaw": True}
        chosen = self.start
        if chosen is None:
            chosen = next(name for name in (usual, "truth", "file", "unknown_yaw") if there[name])
        if not there[chosen]:
            raise DataError(
                f"there is no start of this kind for {on.name}",
                path=f"{on.name}.start",
                expected="a truth with attitudes" if chosen == "truth" else "a stream of attitudes",
                got=", ".join(on.flight.streams) + ("" if on.flight.truth is None else " and a truth"),
                fix="write --set start=unknown_yaw, or --set start.heading=RADIANS",
            )
        starts = [first] if place is None else [place[0]]
        here = np.zeros(3) if place is None else place[1]
        turn, heading = _LEVEL, None
        tilted = chosen != "unknown_yaw" or measured is not None or shown is not None
        if chosen == "truth" and told is not None:
            starts = [told[0]]
            here = here if told[1] is None else told[1]
            turn = told[2]
            on.note("assumed", "the start is the truth's")
        elif chosen == "file" and seen is not None:
            starts.append(seen.time)
            turn, heading = seen.attitude, seen.heading
            on.note("assumed", f"the start has {seen.whose} measured")
        else:
            if measured is not None:
                starts.append(measured[0])
                turn = measured[1]
            turn = turned(turn, 0.0) if shown is None else shown
            heading, whose = UNKNOWN_HEADING, "0 rad" if shown is None else "that of the first field"
            if self.start_heading is None:
                said = f" with a deviation of {UNKNOWN_HEADING:.3g} rad" if deviates else ""
                on.note("assumed", f"nothing is known of the heading at the start: {whose}{said}")
        if self.start_heading is not None:
            turn, heading = turned(turn, self.start_heading), None
            on.note("assumed", f"the heading at the start is {self.start_heading:g} rad, as it was set")
        time = max(first, *starts)
        if time - first <= rests * 1e9:
            time = first
        if chosen != "truth" and position is not None:
            here = _last(position, "position", time, here)
        return StartPose(time, here, turn, heading, chosen == "truth", tilted, _since(on, inputs, time))

    def levelled(
        self, on: OnFlight, force: str, up: np.ndarray, *, deviates: bool
    ) -> tuple[np.ndarray, StartPose]:
        """The attitude (4) at the start, of a body at rest, and the rest of it.

        Args:
            force: the name of the input that shows where up is. up: what it does (n, 3), m/s^2, body.
        """
        pose = self.pose(on, on.inputs, deviates=deviates)
        first = on.first_up(force, up[on.inputs[force].time >= pose.time])
        return pose.attitude if pose.tilted else np.asarray(level(pose.attitude, first, xp=np)), pose

    def orientation(
        self, on: OnFlight, imu: Series, still: float | None, *, deviates: bool = True
    ) -> tuple[Start, StartPose]:
        """Level by the mean force at rest, or by the first that shows where up is; the heading as `pose` has
        it.

        Args:
            still: seconds of rest at the start; those that the flight tells, or that its readings show, if
                left out.

        Raises:
            DataError: as `pose`, and where no reading shows where up is.
        """
        found = on.flight.info.get("still") if still is None else still
        still = rest_seconds(imu) if found is None else float(found)
        pose = self.pose(on, on.inputs, rests=still, deviates=deviates)
        rest = max(still - (pose.time - int(imu.time[0])) * 1e-9, 0.0)
        return orientation_start(on.flight, pose.inputs["imu"], rest, nearest=pose.attitude), pose

    def _truth(self, on: OnFlight, first: int) -> tuple[int, np.ndarray | None, np.ndarray] | None:
        """Time, position and attitude of the truth at a time, or at its first row if that is later; None
        where it tells no attitude from then on."""
        truth = on.flight.truth
        if truth is None or not len(truth) or "attitude" not in truth.leaves:
            return None
        names = [name for name in ("position", "attitude") if name in truth.leaves]
        rows = np.all([np.isfinite(truth[name]).all(axis=-1) for name in names], axis=0)
        whole = truth[rows]
        if not len(whole) or whole.time[-1] < first:
            return None
        time = max(first, int(whole.time[0]))
        at = np.array([time])
        near = truth if known(truth, at)[0] else whole
        place = interpolate(near, "position", at)[0] if "position" in names else None
        return time, place, interpolate(near, "attitude", at)[0]


def from_first(
    on: OnFlight, inputs: Mapping[str, Series], series: Series, name: str
) -> tuple[np.ndarray, dict[str, Series]]:
    """The first value of a field that is finite, and the inputs from then on."""
    found = _first(series, name)
    first = series.time[0], series[name][0]
    time, value = first if found is None else found
    return value, _since(on, inputs, int(time))


def _first(series: Series | None, name: str) -> tuple[int, np.ndarray] | None:
    """Time and value of the first row of a field that can start a filter."""
    if series is None or not len(series):
        return None
    good = _good(series, name)
    row = int(np.argmax(good))
    return (int(series.time[row]), np.asarray(series[name][row])) if good[row] else None


def _last(series: Series, name: str, time: int, otherwise: np.ndarray) -> np.ndarray:
    """The value of the last such row up to a time."""
    rows = np.flatnonzero(_good(series, name) & (series.time <= time))
    return np.asarray(series[name][rows[-1]]) if len(rows) else otherwise


def _good(series: Series, name: str) -> np.ndarray:
    """Which rows can start a filter: the finite ones, of attitudes those that are a unit quaternion."""
    values = series[name]
    with np.errstate(invalid="ignore"):
        size = np.linalg.norm(values, axis=-1)
    return np.isfinite(size) & ((np.abs(size - 1.0) < 0.1) if name == "attitude" else True)


def _compass(on: OnFlight) -> _Shown | None:
    """The first attitude of a stream that the filter does not correct by, or that of a magnetometer at rest
    or in the first reading."""
    streams = on.flight.streams
    for name in _ATTITUDES:
        if name in streams and "attitude" in streams[name].leaves:
            found = _first(streams[name], "attitude")
            if found is not None:
                return _Shown(*found, None, "the first attitude that was")
    imu, field = streams.get("imu"), streams.get("magnetometer")
    if imu is None or field is None or on.weightless or not len(imu) or not len(field):
        return None
    if not usable(field["field"], 0.0).any() or not usable(imu["specific_force"]).any():
        return None
    earth = on.flight.info.get("magnetic_field", (0.0, 1.0, -1.0))
    aligned = static_alignment(imu, field, north=math.atan2(earth[1], earth[0]))
    time = int(imu.time[0])
    return _Shown(time, aligned.attitude, MAGNETIC_HEADING, "the heading of the first field that was")


def _since(on: OnFlight, inputs: Mapping[str, Series], time: int) -> dict[str, Series]:
    """The inputs from a time on; what is left out is a note."""
    left = {}
    for name, series in inputs.items():
        rows = int(np.searchsorted(series.time, time))
        left[name] = series[rows:] if rows else series
        if rows == len(series):
            raise DataError(
                f"nothing of {name} comes after the pose that {on.name} starts with",
                path=f"{on.flight.name}: {name}",
                expected="samples from that time on",
                got=f"the last {(time - int(series.time[-1])) * 1e-9:.3g} s before it",
                fix="shift the stamps by STREAM.time_offset, or write --set start=unknown_yaw",
            )
        if rows:
            span = (time - int(series.time[0])) * 1e-9
            on.note("skipped", f"{name}: {rows} samples ({span:.3g} s) from before the start left out")
    return left


def turned(attitude: np.ndarray, heading: float) -> np.ndarray:
    """The attitude, turned about the vertical until its x axis heads there (rad from the world's x axis)."""
    R = to_matrix(attitude, xp=np)
    now = math.atan2(R[1, 0], R[0, 0])
    about_z = from_rotation_vector(np.array([0.0, 0.0, heading - now]), xp=np)
    return np.asarray(multiply(about_z, attitude, xp=np))
