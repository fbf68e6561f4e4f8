"""What all datasets share: a recording in the making, and the one check that every stream passes through.

A `Recording` gathers streams and what there is to say about them, and becomes a `Flight` at the end: when
anything is wrong, an error has been raised and there is no flight, so nothing half-read is ever returned.
Stamps, units, ranges and the time that streams have in common are looked at here, for all loaders alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.datasets import adjust
from flowgraph.blocks.datasets.overlap import check_overlap
from flowgraph.blocks.datasets.ranges import PLAUSIBLE, doubtful, geodetic, plausible, upright
from flowgraph.blocks.datasets.settings import (
    MEASURED_NOISE,
    MOST_OFFSET,
    NOISE_SETTINGS,
    chosen,
    imu_noise,
    known,
    measured_noise,
    number,
    offset,
    policy,
    split_argument,
    the_file,
)
from flowgraph.blocks.datasets.stamps import POLICIES, check_clock, in_order
from flowgraph.blocks.geometry.rotations import rotate
from flowgraph.data.arrival import delayed
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

__all__ = [
    "MEASURED_NOISE",
    "MOST_OFFSET",
    "NOISE_SETTINGS",
    "PLAUSIBLE",
    "Recording",
    "chosen",
    "imu_noise",
    "known",
    "measured_noise",
    "number",
    "offset",
    "plausible",
    "policy",
    "present",
    "split_argument",
    "stream_settings",
    "the_file",
    "unit_quaternions",
]

stream_settings = adjust.stream_settings
_ARRIVAL = "arrival"  # how late each row came, ns: it goes with the rows, whatever becomes of them


def present(
    name: str,
    place: str,
    time: np.ndarray,
    table: np.ndarray,
    notes: list[str],
    absent: dict[str, int],
    said: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The rows (n, ...) without a NaN, and their times; what is left out is counted in `notes` and `absent`,
    but for the rows `said` (n,), of which something was said before.

    Of the truth, rows with a NaN stay where they lie between others, all NaN: they say that nothing is known
    there, and keep errors from being measured against what would be interpolated.

    Raises:
        DataError: when no row is left.
    """
    broken = np.isnan(table).any(axis=1)
    new = broken if said is None else broken & ~said
    if new.any():
        done = "masked" if name == "truth" else "left out as absent"
        notes.append(note("skipped", f"{name}: {int(new.sum())} of {len(time)} rows hold NaN, {done}"))
        absent[name] = int(new.sum())
    if broken.all():
        raise DataError(
            f"{name} holds nothing that was measured",
            path=place,
            expected="at least one row without NaN",
            got=f"{len(time)} rows" + (", all with NaN" if len(time) else ""),
            fix="choose another recording",
        )
    if name == "truth":
        known = np.flatnonzero(~broken)
        table = np.where(broken[:, None], np.nan, table)[known[0] : known[-1] + 1]
        return time[known[0] : known[-1] + 1], table
    return time[~broken], table[~broken]


def unit_quaternions(q: np.ndarray, place: str, row: Callable[[int], str] | None = None) -> np.ndarray:
    """Attitudes (n, 4) scaled to unit norm; rows of NaN stay. `row` is what to call row k in a message.

    Raises:
        DataError: for a row whose norm is farther than 1 % from 1.
    """
    norm = np.linalg.norm(q, axis=-1)
    off = np.flatnonzero(np.abs(norm - 1.0) > 0.01)
    if len(off):
        raise DataError(
            "an attitude is not a unit quaternion",
            path=row(int(off[0])) if row else f"{place}, row {off[0] + 1}",
            expected="a norm within 1 % of 1",
            got=f"{norm[off[0]]:.6g}",
            fix="mend or delete the row",
        )
    return np.asarray(q / norm[:, None])


class Recording:
    """A flight in the making.

    Args:
        name: of the flight.
        bad_time: one of `POLICIES`.
        kind: of flight, for messages.
        given: the settings; those of `stream_settings` are heeded here.
        unit: what stamps were read as, where a setting `time.unit` can say otherwise.
        clock: what a user can do where the clocks of streams differ; None for `STREAM.time_offset`.
        units: what a user can do where a unit cannot be; {stream}, {field} and {unit}, the one that is often
            meant, are filled in.
        begins: a stream before whose first sample those of others, but for the truth, are left out.
        place: the recording, for messages; its name where it is left out.
    """

    def __init__(
        self,
        name: str,
        bad_time: str = POLICIES[0],
        *,
        kind: str = "",
        given: Mapping[str, Any] | None = None,
        unit: str | None = None,
        clock: str | None = None,
        units: str = "convert the file to SI units",
        begins: str | None = None,
        place: str | None = None,
    ) -> None:
        self.name, self.bad_time, self.kind, self.given = name, bad_time, kind, dict(given or {})
        self.unit, self.clock, self.units, self.begins = unit, clock, units, begins
        self.place = place or name
        self.streams: dict[str, Series] = {}
        self.truth: Series | None = None
        self.info: dict[str, Any] = {"absent": {}}
        self.notes: list[str] = []

    def add(
        self,
        name: str,
        place: str,
        time: np.ndarray,
        columns: Mapping[str, np.ndarray],
        signal: Callable[..., Any],
        *,
        row: Callable[[int], str] | None = None,
        checked: bool = True,
        mount: tuple[float, ...] | None = None,
        raw: bool = False,
        exact: bool = False,
        scalar_last: bool = False,
        arrival: np.ndarray | None = None,
    ) -> Series:
        """A stream, or the truth where `name` is "truth".

        Stamps are moved, rows are brought in order and passed over as the settings say; rows with a NaN are
        left out, and counted in a note and in `info["absent"]`; stamps, attitudes, lengths of what
        `PLAUSIBLE` knows and geodetic positions are checked.

        Args:
            name: of the stream.
            place: the file (and field) it is from, for messages.
            time: (n,) int64 ns.
            columns: arrays (n, ...) by field of the signal.
            signal: made of the columns, such as `Imu`.
            row: what to call row k in a message; "row k+1" of `place` where it is left out.
            checked: whether units are.
            mount: quaternion, sensor to body, as the recording has it: it is taken out.
            raw: whether the numbers are counts, of which nothing is known.
            exact: whether attitudes are of unit norm as they were made, and not read.
            scalar_last: whether attitudes are x, y, z, w; they are put scalar first.
            arrival: (n,) int64 ns, when each row arrived, of the clock of `time`; when it was true, if left
                out.

        Raises:
            DataError: for stamps that are no clock's or out of order, infinite values, attitudes that are
                none, implausible units and ranges, or when no row is left.
            DeclarationError, UnknownNameError: for a setting of the stream.
        """
        how = adjust.adjustment(self.given, name, self.kind or "flight")
        names = list(columns)
        where = row or (lambda k: f"{place}, row {k + 1}")
        flat = {n: np.asarray(columns[n], dtype=float).reshape(len(time), -1) for n in names}
        endless = np.flatnonzero(np.isinf(np.concatenate(list(flat.values()), axis=1)).any(axis=1))
        if len(endless):
            k = int(endless[0])
            raise DataError(
                "a value is infinite",
                path=where(k),
                expected="finite numbers, or NaN for what was not measured",
                got=str([x for part in flat.values() for x in part[k].tolist()])[:80],
                fix="mend or delete the row",
            )
        gone = np.zeros(len(time), bool) if raw else adjust.lost_rows(name, how.lost, flat, where, self.notes)
        if gone.any():
            flat = {n: np.where(gone[:, None], np.nan, part) for n, part in flat.items()}
        if "attitude" in flat and not exact:
            flat["attitude"] = unit_quaternions(flat["attitude"], place, where)
        if scalar_last:
            flat["attitude"] = flat["attitude"][:, [3, 0, 1, 2]]
        if "latitude" in flat:
            flat, said = geodetic(name, flat, where, lambda field: self._convert(name, field))
            self.notes += said
        time = adjust.shifted(name, place, np.asarray(time), how.shift)
        if how.shift:
            self.notes.append(note("info", f"{name}: stamps shifted by {how.shift} ns"))
        if arrival is not None:
            names.append(_ARRIVAL)
            flat[_ARRIVAL] = (arrival - time).astype(float)[:, None]
        rows = np.flatnonzero(~gone) if name != "truth" else np.arange(len(time))
        overtaken = "sort" if arrival is not None else self.bad_time
        time, rows, said = in_order(name, lambda k: where(int(rows[k])), time[rows], rows, overtaken)
        self.notes += said
        time, rows = self._clocked(name, where, time, rows, inertial="specific_force" in flat)
        table = np.concatenate([flat[n] for n in names], axis=1)[rows]
        lost = len(np.flatnonzero(gone))
        time, table = present(name, place, time, table, self.notes, self.info["absent"], gone[rows])
        if lost:
            self.info["absent"][name] = self.info["absent"].get(name, 0) + lost
        keep = adjust.thinned(name, time, how.every, self.notes)
        time, table = time[keep], table[keep]
        widths = np.cumsum([flat[n].shape[1] for n in names])[:-1]
        parts = {
            n: part.reshape(len(time), *np.shape(columns.get(n, time))[1:])
            for n, part in zip(names, np.split(table, widths, axis=1), strict=True)
        }
        late = parts.pop(_ARRIVAL, None)
        if checked and not raw:
            for field, part in parts.items():
                plausible(field, part, f"{place}: {name}.{field}", self._convert(name, field))
        if not raw:
            self.notes += doubtful(name, time, parts)
        parts = self._placed(name, parts, how, mount)
        series = Series(time, signal(**parts), name=name, gaps=name == "truth")
        if late is not None:
            series = self._arrived(series, place, late)
        if name == "truth":
            self.truth = series
        else:
            self.streams[name] = series
        return series

    def _arrived(self, series: Series, place: str, late: np.ndarray) -> Series:
        """The stream as it arrived, `late` ns (n,) after it was true."""
        if (late < 0).any():
            k = int(np.argmin(late))
            raise DataError(
                "a value arrived before it was true",
                path=f"{place}: {series.name}",
                expected="arrivals after the stamps, by one clock",
                got=f"{-late[k] * 1e-9:.6g} s before it, at t = {series.time[k]} ns",
                fix=f"{series.name}.time_offset={late[k] * 1e-9:.6g} moves the stamps",
            )
        mean, most = late.mean() * 1e-9, late.max() * 1e-9
        self.notes.append(
            note("info", f"{series.name}: arrived {mean:.3g} s after it was true, {most:.3g} s at most")
        )
        return delayed(series, late.astype(np.int64))

    def take(self, series: Series, place: str) -> Series:
        """A stream that was made elsewhere, or the truth, by the name of the series; its clock and its units
        are looked at as `add` does.

        Args:
            series: the stream.
            place: the file it is from, for messages.

        Raises:
            DataError: for stamps that are no clock's, or implausible units.
            DeclarationError: for a setting of the stream.
        """
        name = series.name
        how = adjust.adjustment(self.given, name, self.kind or "flight")
        if how.shift:
            time = adjust.shifted(name, place, series.time, how.shift)
            series = Series(time, series.values, name=name, gaps=name == "truth")
            self.notes.append(note("info", f"{name}: stamps shifted by {how.shift} ns"))
        rows, leaves = np.arange(len(series)), series.leaves
        where = lambda k: f"{place}, row {k + 1}"
        _, rows = self._clocked(name, where, series.time, rows, inertial="specific_force" in leaves)
        rows = rows[adjust.thinned(name, series.time[rows], how.every, self.notes)]
        if len(rows) < len(series):
            series = series[rows]
        if len(series):
            for field, values in series.leaves.items():
                plausible(field, values, f"{place}: {name}.{field}", self._convert(name, field))
            self.notes += doubtful(name, series.time, series.leaves)
        if name == "truth":
            self.truth = series
        else:
            self.streams[name] = series
        return series

    def _convert(self, name: str, field: str) -> str:
        return self.units.format(stream=name, field=field, unit=OFTEN.get(field, "UNIT"))

    def _clocked(
        self, name: str, where: Callable[[int], str], time: np.ndarray, rows: np.ndarray, inertial: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """The stamps (n,) that hang together, and their rows."""
        while True:
            part, said = check_clock(
                name,
                lambda k, rows=rows: where(int(rows[k])),  # type: ignore[misc]
                time,
                inertial=inertial,
                unit=self.unit,
                drop=self.bad_time == "drop",
                fix=self.clock or "check the stamps of the recording",
            )
            if said is None:
                if (
                    not inertial
                    and len(time) >= 10
                    and (np.diff(time) == 10**9).all()
                    and time[0] in (0, 10**9)
                    and not any((s.time % 10**9).any() for s in self.streams.values())  # of the same clock
                ):
                    first = ", ".join(str(k // 10**9) for k in time[:3].tolist())
                    sentence = f"{name}: its stamps are {first}, ... s, as an index of rows is"
                    self.notes.append(note("warning", f"{sentence}: check the column of the time"))
                return time, rows
            self.notes.append(note("skipped", f"{name}: {said}: left out"))
            time, rows = time[part], rows[part]

    def _placed(
        self,
        name: str,
        parts: dict[str, np.ndarray],
        how: adjust.Adjustment,
        mount: tuple[float, ...] | None,
    ) -> dict[str, np.ndarray]:
        """The readings of the body's axes; where the sensor sits is put into `info`."""
        turn = None if mount is None else np.asarray(mount)
        if how.mount is not None:
            self._needs(f"{name}.mount", adjust.TURNED, parts)
            turn = how.mount
            self.info[f"{name}_mount"] = tuple(how.mount.tolist())
            self.notes.append(note("info", f"{name}: turned into the body's axes by {name}.mount"))
        if turn is not None:
            parts = adjust.turned(parts, turn)
        if how.lever is None:
            return parts
        at = ", ".join(f"{x:g}" for x in how.lever)
        if name != "truth":
            self._needs(f"{name}.lever", ("position", "latitude"), parts)
            self.info[f"{name}_lever"] = how.lever
            self.notes.append(note("info", f"{name}: taken to sit at ({at}) m in the body"))
            return parts
        self._needs("truth.lever", ("position",), parts)
        self._needs("truth.lever", ("attitude",), parts)
        self.notes.append(
            note("info", f"truth: of a point at ({at}) m in the body, moved to the inertial unit")
        )
        if "velocity" in parts:
            self.notes.append(note("skipped", "truth: its velocities stay those of the point it tells of"))
        away = rotate(parts["attitude"], np.broadcast_to(how.lever, parts["position"].shape), xp=np)
        return {**parts, "position": parts["position"] - away}

    def _needs(self, setting: str, fields: Iterable[str], parts: Mapping[str, np.ndarray]) -> None:
        if not set(fields) & set(parts):
            raise DeclarationError(
                f"setting {setting!r} has nothing to act on",
                path=self.kind or "flight",
                expected=f"a stream with {' or '.join(fields)}",
                got=", ".join(parts),
                fix=f"leave {setting} out",
            )

    def flight(self) -> Flight:
        """The flight, when all of it was read.

        Raises:
            DataError: where streams have no time in common.
            UnknownNameError: for a setting of a stream that cannot be there.
        """
        held = [*self.streams, *(["truth"] if self.truth is not None else [])]
        for setting in self.given:
            stream, dot, what = str(setting).rpartition(".")
            if not dot or what not in adjust.MEANT or stream in held:
                continue
            if self.clock is not None:
                raise UnknownNameError("stream", stream, held, path=f"{self.kind}.{setting}")
            self.notes.append(note("skipped", f"{setting}: this flight has no {stream}"))
        self.notes += check_overlap(self.place, self.streams, self.truth, self._together, self._moved)
        if self.begins in self.streams:
            first = self.streams[self.begins].time[0]
            for name, series in self.streams.items():
                kept = series[series.time >= first]
                early = len(series) - len(kept)
                if early:
                    sentence = f"{name}: {early} samples from before the first {self.begins} sample left out"
                    self.notes.append(note("skipped", sentence))
                    self.streams[name] = kept
        imu = next((s for s in self.streams.values() if "specific_force" in s.leaves), None)
        posed = [s for s in (self.truth, *self.streams.values()) if s is not None and "attitude" in s.leaves]
        if imu is not None and posed:
            self.notes += upright(imu, posed[0], posed[0].name)
        return Flight(self.name, self.streams, truth=self.truth, info=self.info, notes=tuple(self.notes))

    def _together(self, name: str, one: str, seconds: float) -> str:
        """What to do where the clocks of two streams are apart."""
        if self._moved(name, one):
            return f"check {name}.time_offset and {one}.time_offset, which are in seconds"
        shift = f"{name}.time_offset={seconds:.9g} if they began together"
        if self.clock:
            return self.clock + (f", or {shift}" if abs(seconds) <= MOST_OFFSET else "")
        if abs(seconds) <= MOST_OFFSET:
            return f"{shift}; or check the column and the unit of the time"
        return "give both the stamps of one clock, and of one recording"

    def _moved(self, name: str, one: str) -> str:
        """Which offsets were given."""
        offsets = [f"{n}.time_offset" for n in (name, one)]
        if not any(offset(self.given, o, self.kind) for o in offsets):
            return ""
        return ", with " + " and ".join(f"{o}={offset(self.given, o, self.kind) / 1e9:g}" for o in offsets)


OFTEN: Mapping[str, str] = {
    "latitude": "deg",
    "longitude": "deg",
    "specific_force": "g",
    "gyro": "deg/s",
    "field": "uT",
}
"""The unit that is often meant where a field's is another than it should be."""
