"""What a filter is given of a flight: no reading that is not a number, and none that a sensor cannot read.

A control says how the body moved until the next one, so a part of it says nothing: with a NaN in it, it is
absent, and the one before is held. A measurement corrects by its finite entries. A reading beyond the range
of its sensor is absent too. What was left out is a note.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.scoring.settings import Positive, Settings
from flowgraph.blocks.signals import (
    Attitude,
    BodyRate,
    CameraMotion,
    CoordinateAcceleration,
    GnssFix,
    GnssHeading,
    GnssPosition,
    GnssVelocity,
    Gyro,
    Height,
    Imu,
    ImuCounts,
    MagneticField,
    OpticalFlow,
    PlanePosition,
    PlaneVelocity,
    Pose,
    PoseMeasurement,
    Position,
    Range,
    SpecificForce,
    Thrust,
    Velocity,
    WheelSpeed,
)
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError
from flowgraph.types import StructType, unflatten

__all__ = ["Ranges", "gap_notes", "pause", "taken"]

CONTROLS = (
    Imu, Gyro, SpecificForce, CoordinateAcceleration, Thrust, BodyRate, ImuCounts, PlaneVelocity,
)  # fmt: skip
MEASURED = (
    Pose, PoseMeasurement, Position, Attitude, Velocity, MagneticField, Range, OpticalFlow, PlanePosition,
    CameraMotion,
)  # fmt: skip
AIDS = (*MEASURED, GnssFix, GnssPosition, GnssVelocity, GnssHeading, Height, WheelSpeed)
"""All that corrects; of those that `MEASURED` has not, entries may be missing throughout."""

GAP, MEASURED_GAP = 4.0, 10.0
"""Of how many usual steps a gap is: of a control, and of a measurement, which must last a second, too."""

FASTEST = 1e-5
"""s, between readings of a control: less is of stamps that count something else than nanoseconds."""

BURSTS = 0.02
"""The share of steps that must be waits for readings to come in bursts."""

PAUSE, USUAL = 10.0, 100.0
"""s, and median steps of all streams together: what is longer is a jump of the stamps, or a pause."""

RANGED = {
    "gyro": ((Imu, "gyro"), (Gyro, "rate")),
    "specific_force": ((Imu, "specific_force"), (SpecificForce, "force")),
}
"""By the name of the setting: what signals read it, in which field."""

UNITS = {"gyro": ("rad/s", 40.0), "specific_force": ("m/s^2", 320.0)}
"""The unit, and what hardly a unit on a vehicle reads beyond: 2300 deg/s, and 32 g."""


@dataclass(frozen=True)
class Ranges(Settings):
    """What an inertial sensor can read.

    Args:
        gyro_range, specific_force_range: rad/s and m/s^2, the most that an axis can read; a reading beyond it
            is refused. `gyro.range` and `specific_force.range` on the command line.
    """

    gyro_range: Positive | None = None
    specific_force_range: Positive | None = None

    def most(self) -> dict[str, float | None]:
        """By the quantity that is ranged."""
        return {"gyro": self.gyro_range, "specific_force": self.specific_force_range}


def taken(
    flight: Flight, ranges: Ranges, graph: str, measured: Collection[str] | None
) -> tuple[Flight, list[str]]:
    """The flight without what a filter cannot take, and notes.

    Only series whose NaN are data (`gaps`) have some; others are refused by the run.

    Args:
        ranges: beyond which a reading is refused.
        graph: who asks, for messages.
        measured: names of streams that correct by their finite entries though controls elsewhere; with None
            the graph takes whole measurements only.

    Raises:
        DataError: where nothing is left of a stream.
        DeclarationError: for a range of what no stream reads.
    """
    streams, notes = dict(flight.streams), dict[str, str]()
    for name, series in flight.streams.items():
        cls = _class(series)
        if cls not in CONTROLS and cls not in MEASURED:
            continue
        entries = measured is not None and (cls in MEASURED or name in measured)
        found, said = _finite(name, series, entries)
        found, more = _within(name, found, ranges)
        if len(series) and not len(found):
            raise DataError(
                f"no reading of {name} is left for {graph}",
                path=f"{flight.name}: {name}",
                expected="finite readings, within the range of the sensor",
                got="; ".join([*said, *more]),
                fix="check the columns and units of the sensor, and its range",
            )
        streams[name] = found
        for one in (*said, *more):  # of the parts of an imu the same is not said again
            notes.setdefault(one.partition(f"{name}: ")[2], one)
    for what, most in ranges.most().items():
        if most is not None and not any(_field(s, what) for s in streams.values()):
            raise DeclarationError(
                f"setting '{what}.range' has nothing to act on",
                path=f"{graph}.{what}.range",
                expected="a stream that reads it: imu, gyro or accelerometer",
                got=", ".join(streams),
                fix=f"leave {what}.range out",
            )
    return replace(flight, streams=streams) if notes else flight, list(notes.values())


def _class(series: Series) -> type | None:
    return series.type.cls if isinstance(series.type, StructType) else None


def _finite(name: str, series: Series, entries: bool) -> tuple[Series, list[str]]:
    """The readings that are whole, or have finite entries and come from the first whole one on."""
    if not series.gaps or not len(series):
        return series, []
    n = len(series)
    known = [np.isfinite(leaf).reshape(n, -1) for leaf in series.leaves.values()]
    whole = np.hstack(known).all(axis=1)
    if whole.all():
        return series, []
    kept = whole
    if entries:
        kept = np.hstack(known).any(axis=1) & (np.arange(n) >= int(np.argmax(whole))) & whole.any()
        leaves = (np.where(np.isfinite(leaf), leaf, np.nan) for leaf in series.leaves.values())
        values = unflatten(series.type, leaves)
        stamp = series.stamp if series.is_late else None
        series = Series(series.time, values, type=series.type, name=series.name, gaps=True, stamp=stamp)
    said, part = [], int((kept & ~whole).sum())
    if not kept.all():
        said.append(note("skipped", f"{name}: {int((~kept).sum())} of {n} readings are not finite"))
    if part:
        said.append(note("info", f"{name}: {part} of {n} readings are finite in part"))
    return series[kept], said


def _field(series: Series, what: str) -> str | None:
    """The field of a stream that reads a ranged quantity."""
    return next((field for cls, field in RANGED[what] if _class(series) is cls), None)


def _within(name: str, series: Series, ranges: Ranges) -> tuple[Series, list[str]]:
    """The readings within the ranges that are set; where none is, a note on what no sensor reads."""
    notes = []
    for what, most in ranges.most().items():
        field = _field(series, what)
        if field is None or not len(series):
            continue
        unit, hardly = UNITS[what]
        size = np.nan_to_num(np.abs(series[field])).max(axis=-1)
        off = size > (hardly if most is None else most)
        if not off.any():
            continue
        said = f"{name}: {int(off.sum())} of {len(series)} readings beyond"
        largest = f"the largest {size.max():.3g}"
        if most is None:
            notes.append(
                note("warning", f"{said} {hardly:g} {unit}, {largest}: {what}.range=.. refuses such")
            )
        else:
            notes.append(note("refused", f"{said} {what}.range={most:g} {unit}, {largest}"))
            series = series[~off]
    return series, notes


def gap_notes(inputs: Mapping[str, Series], noted: Collection[str]) -> Iterator[str]:
    """Notes on streams that have gaps, end early, or have stamps that no sensor has; once for equal stamps.

    Args:
        noted: streams whose gaps are noted already.
    """
    seen: list[Series] = []
    one_time = pause(inputs) is None
    last = max((int(s.stamp.max()) for s in inputs.values() if len(s)), default=0)
    for name, series in sorted(inputs.items(), key=lambda item: item[0] not in noted):
        cls = _class(series)
        if (cls not in CONTROLS and cls not in AIDS) or any(
            np.array_equal(series.time, other.time) for other in seen
        ):
            continue
        seen.append(series)
        wide, usual = gaps(series, control=cls in CONTROLS)
        if len(wide) and name not in noted:
            yield gap_note(name, wide, usual)
        silent = (last - int(series.stamp.max())) * 1e-9 if len(series) else 0.0
        if one_time and silent > max(MEASURED_GAP * usual, 1.0):
            yield note(
                "bridged", f"{name}: nothing of it in the last {silent:.3g} s (usual step {usual:.3g} s)"
            )
        if cls in CONTROLS:
            yield from _stamp_notes(name, series, usual)


def _stamp_notes(name: str, series: Series, usual: float) -> Iterator[str]:
    """Notes on stamps of a control that are not those of its readings."""
    if 0.0 < usual < FASTEST:
        sentence = (
            f"{name}: a reading each {usual:.3g} s: a stamp counts nanoseconds; do these count ms or us?"
        )
        yield note("warning", sentence)
    elif not series.is_late and len(series) > 1 and usual > 2e-9 * float(np.median(np.diff(series.time))):
        sentence = f"{name}: readings come in bursts, {usual:.3g} s apart: these stamps say when they arrived"
        yield note("warning", f"{sentence}, not when they were read; stamp them at the sensor")


def gaps(series: Series, *, control: bool = True) -> tuple[np.ndarray, float]:
    """The steps that are gaps, and the usual step, s."""
    steps = np.diff(series.time) * 1e-9
    usual = usual_step(steps)
    least = GAP * usual if control else max(MEASURED_GAP * usual, 1.0)
    return steps[steps > least], usual


def usual_step(steps: np.ndarray) -> float:
    """The median of steps (s), or where readings come in bursts the step in which half of the time lies.

    A reading is as old as the wait between two bursts each time, so that is the sensor's own period.
    Waits that are fewer than a fiftieth of all steps are no bursts.
    """
    if not len(steps):
        return 0.0
    median = float(np.median(steps))
    by_size = np.sort(steps)
    wait = float(by_size[np.searchsorted(np.cumsum(by_size), 0.5 * by_size.sum())])
    often = np.count_nonzero(steps >= wait) >= BURSTS * len(steps)
    return wait if wait > 2.0 * median and often else median


def gap_note(name: str, wide: np.ndarray, usual: float) -> str:
    """What is said of the gaps of a stream."""
    many = "a gap of" if len(wide) == 1 else f"{len(wide)} gaps, the longest of"
    return note("bridged", f"{name}: {many} {wide.max():.3g} s (usual step {usual:.3g} s)")


def pause(inputs: Mapping[str, Any]) -> tuple[float, str] | None:
    """The least step (s) that is a pause of all streams, and a note; None where there is no pause."""
    stamps = [np.asarray(series.time) for series in inputs.values()]
    time = np.unique(np.concatenate(stamps)) if stamps else np.zeros(0, dtype=np.int64)
    steps = np.diff(time) * 1e-9
    least = max(PAUSE, USUAL * float(np.median(steps))) if len(steps) else PAUSE
    wide = np.flatnonzero(steps > least)
    if not len(wide):
        return None
    k = int(wide[steps[wide].argmax()])
    many = "a pause of" if len(wide) == 1 else f"{len(wide)} pauses, the longest of"
    sentence = (
        f"all streams: {many} {steps[k]:.6g} s, {(time[k] - time[0]) * 1e-9:.3g} s after the first reading"
    )
    return least, note("bridged", f"{sentence}; nothing is predicted across it")
