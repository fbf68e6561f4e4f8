"""Several files, one flight: the parts of a SPEC such as `csv:imu.csv+csv:mocap.csv`, and their settings.

A recording seldom is one file: a logger writes one a sensor, and the truth comes from somebody else. Each
part is loaded by its own kind, and the streams are put together; nothing may be there twice, and what was
recorded at another time is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.notes import note
from flowgraph.data.series import Series
from flowgraph.errors import DataError, UnknownNameError

__all__ = ["doubtful_span", "joined", "numbered", "of_a_truth", "parts_of", "shared", "with_truth"]

_ALIKE = 0.1  # of log10 of two spans; a recording and its truth start and end with as much between them
_PART, _FEW = 0.5, 3  # the share and the number of samples that are enough

_MOVING = ("time_offset", "every", "lost", "lever", "mount")
"""What may be set of every stream of a recording."""

Claims = Callable[[str, Mapping[str, Any]], Iterable[str]]
"""Given the argument of a part and settings for all, the names of those that are for this part."""


def parts_of(spec: str, kinds: Iterable[str]) -> list[str]:
    """The parts of a SPEC: a `+` begins one where an installed kind, or a file of code, and a colon follow.

    Any other `+` is of a file's name, and so is each where a file of the whole name exists.
    """
    if Path(spec.partition(":")[2]).expanduser().exists():
        return [spec]
    names = "|".join(map(re.escape, kinds))
    return re.split(rf"\+(?=(?:{names}|[^+:]+\.py):)", spec)


def numbered(names: Sequence[Iterable[str]]) -> list[str]:
    """The settings of a flight of several parts, given those of each: for all, or for one by its number."""
    plain = dict.fromkeys(n for part in names for n in part)
    return [*plain, *(f"{k}.{n}" for k, part in enumerate(names, start=1) for n in part)]


def shared(
    specs: Sequence[str],
    names: Sequence[Sequence[str]],
    claims: Sequence[Claims | None],
    settings: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """The settings of each part.

    One that begins with a number is for that part. Any other is for all parts whose kind has it and that
    claim it: a table claims the columns that it has.

    Args:
        specs: of the parts.
        names: of the settings that the kind of each has.
        claims: what tells which of these are for the part, where its kind can tell.
        settings: given for the whole flight.

    Raises:
        UnknownNameError: for a setting that no part has.
    """
    found: list[dict[str, Any]] = [{} for _ in specs]
    own: list[dict[str, Any]] = [{} for _ in specs]
    plain: dict[str, Any] = {}
    for key, value in settings.items():
        number, _, name = key.partition(".")
        if not (number.isdecimal() and name):
            if not any(_has(valid, key) for valid in names):
                raise UnknownNameError("setting", key, numbered(names), path="+".join(specs))
            plain[key] = value
        elif 1 <= int(number) <= len(specs) and _has(names[int(number) - 1], name):
            own[int(number) - 1][name] = value
        else:
            raise UnknownNameError("setting", key, numbered(names), path="+".join(specs))
    wanted = []
    for spec, valid, claim, mine in zip(specs, names, claims, own, strict=True):
        given = {k: v for k, v in plain.items() if _has(valid, k)}
        kept = set(claim(spec.partition(":")[2], {**given, **mine})) if claim is not None else set(given)
        wanted.append(kept)
    for k, valid in enumerate(names):
        for key, value in plain.items():
            nobody = not any(key in part for part in wanted)
            if _has(valid, key) and (key in wanted[k] or nobody):  # then the part says what is wrong with it
                found[k][key] = value
        found[k].update(own[k])
    return found


def of_a_truth(settings: Mapping[str, Any], names: Sequence[Sequence[str]]) -> dict[str, Any]:
    """The settings of a flight whose last part is its truth: what moves, thins or places the truth is for
    that part, and a trajectory that may be either is read as a truth then.

    Args:
        settings: given for the whole flight.
        names: of the settings that the kind of each part has.
    """
    last = len(names)
    moving = {k for k in settings if k.removeprefix("truth.") in _MOVING and _has(names[-1], k)}
    moving -= set(_MOVING)
    given = {(f"{last}.{k}" if k in moving else k): v for k, v in settings.items()}
    if moving and "role" in names[-1] and not {"role", f"{last}.role"} & set(given):
        given[f"{last}.role"] = "truth"
    return given


def _has(names: Sequence[str], key: str) -> bool:
    """Whether a kind has a setting; `STREAM.NAME` stands for that of a stream of any name."""
    return key in names or ("." in key and "STREAM." + key.rpartition(".")[2] in names)


def joined(specs: Sequence[str], flights: Sequence[Flight]) -> Flight:
    """One flight of several.

    Raises:
        DataError: where a stream, the truth or a calibration is in two parts, or a part was recorded at
            another time than the first.
    """
    streams: dict[str, Series] = {}
    info: dict[str, Any] = {}
    truth: Series | None = None
    owner: dict[str, int] = {}

    def claim(what: str, k: int) -> None:
        if what in owner:
            first = owner[what]
            raise DataError(
                f"{what} is in two parts of one flight",
                path="+".join(specs),
                expected="each stream, and the truth, in one part",
                got=f"{specs[first]} (part {first + 1}) and {specs[k]} (part {k + 1})",
                fix=f"map its columns in one part only, as in {k + 1}.{what}.FIELD=...; or leave a part out",
            )
        owner[what] = k

    for k, flight in enumerate(flights):
        for name, series in flight.streams.items():
            claim(name, k)
            streams[name] = series
        if flight.truth is not None:
            claim("truth", k)
            truth = flight.truth
        for key, value in flight.info.items():
            if isinstance(value, Mapping) and isinstance(info.get(key, {}), Mapping):
                info[key] = {**info.get(key, {}), **value}
            elif key in info and not _alike(info[key], value):
                raise DataError(
                    f"two parts of one flight say different things of {key}",
                    path="+".join(specs),
                    expected="one value",
                    got=f"{info[key]!r}, and {value!r} in {specs[k]}"[:200],
                    fix="say it by a setting, for all parts or for each: 1.NAME=VALUE",
                )
            else:
                info[key] = value
    said = _together(specs, owner, {**streams, **({"truth": truth} if truth is not None else {})})
    notes = tuple(dict.fromkeys((*(n for f in flights for n in f.notes), *said)))
    return Flight(
        "+".join(dict.fromkeys(f.name for f in flights)), streams, truth=truth, info=info, notes=notes
    )


def with_truth(flight: Flight, spec: str, other: Flight) -> Flight:
    """A flight with the truth of another: its truth, or else its only stream of poses or parts of them.

    Raises:
        DataError: where it has none or several, or was recorded at another time.
    """
    truth = other.truth
    if truth is None:
        poses = [s for s in other.streams.values() if {"position", "attitude"} & set(s.leaves)]
        if len(poses) != 1:
            raise DataError(
                "which of these is the truth?",
                path=f"--truth {spec}",
                expected="a truth, or one stream with a position or an attitude",
                got=", ".join(other.streams) or "no stream",
                fix="map columns to truth.position and truth.attitude, or name another SPEC",
            )
        truth = Series(poses[0].time, poses[0].values, type=poses[0].type, name="truth", gaps=True)
    said = [note("info", f"the truth is that of {spec}")] if flight.truth is not None else []
    whole = {**flight.streams, "truth": truth}
    said += _together([flight.name, spec], {**dict.fromkeys(flight.streams, 0), "truth": 1}, whole)
    notes = tuple(dict.fromkeys((*flight.notes, *other.notes, *said)))
    return replace(flight, truth=truth, notes=notes, experiment=None)


def _alike(a: Any, b: Any) -> bool:
    """Whether two values of a calibration are one."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return bool(np.array_equal(np.asarray(a), np.asarray(b)))
    return bool(a == b)


def _together(specs: Sequence[str], owner: Mapping[str, int], series: Mapping[str, Series]) -> list[str]:
    """Refuse a stream that does not overlap with the first of another part; notes on those that hardly do."""
    held = {n: s for n, s in series.items() if len(s)}
    said: list[str] = []
    if not held:
        return said
    first, against = next(iter(held.items()))
    for name, one in held.items():
        if owner[name] == owner[first]:
            continue
        if one.time[0] <= against.time[-1] and one.time[-1] >= against.time[0]:
            said += doubtful_span(name, one.time, first, against.time)
            continue
        apart = int(against.time[0]) - int(one.time[0])
        part = owner[name] + 1
        raise DataError(
            f"no sample of {name} lies within the span of the {first}",
            path=f"{specs[owner[name]]}: {name}",
            expected=f"stamps from {against.time[0]} to {against.time[-1]} ns, as in {specs[owner[first]]}",
            got=f"{one.time[0]} to {one.time[-1]} ns, {_words(abs(apart))} "
            + ("earlier" if apart > 0 else "later"),
            fix=f"check the unit of the stamps, for one part by {part}.time.unit=..., or shift it where"
            f" the clocks differ: {part}.{name}.time_offset",
        )
    return said


def doubtful_span(name: str, time: np.ndarray, first: str, against: np.ndarray) -> list[str]:
    """A note where stamps that overlap with those of another stream look like another unit's, or hardly meet.

    A clock that counts from 0 overlaps in any unit. What tells is its span, which is then 1e3, 1e6 or 1e9
    times the other, or that of many samples next to none lies within it.

    Args:
        name: of the stream.
        time: (n,) int64 ns, its stamps.
        first: the stream that it is held against.
        against: (m,) int64 ns, the stamps of that.
    """
    if min(len(time), len(against)) < 10:
        return []
    mine, other = float(time[-1]) - float(time[0]), float(against[-1]) - float(against[0])
    inside = int(np.searchsorted(time, against[-1], side="right") - np.searchsorted(time, against[0]))
    around = int(np.searchsorted(against, time[-1], side="right") - np.searchsorted(against, time[0]))
    spans = f"{name} spans {mine / 1e9:.3g} s, {first} {other / 1e9:.3g} s"
    for power in (3, 6, 9):
        if abs(abs(np.log10(mine / other)) - power) < _ALIKE:
            return [note("warning", f"{spans}: its unit of time looks wrong by 1e{power}")]
    few = max(inside / len(time), around / len(against)) < _PART or (inside < _FEW and inside < len(time))
    if few:
        within = f"{inside} of {len(time)} samples of it lie within"
        return [note("warning", f"{spans}: only {within}; check the unit of the stamps")]
    return []


def _words(ns: int) -> str:
    """A span of time in the unit that suits it."""
    for unit, size in (("years", 365.25 * 86400e9), ("days", 86400e9), ("h", 3600e9), ("s", 1e9)):
        if ns >= 2 * size:
            return f"{ns / size:.3g} {unit}"
    return f"{ns} ns"
