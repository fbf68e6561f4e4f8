"""The settings of streams, on a flight that is there already: its clocks shifted, thinned, turned, placed.

What a loader of files does while it reads is done here to a flight that was made: the same settings mean the
same. A stream that was made where the body is, and is said to sit elsewhere, is taken at its word.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.adjust import TURNED, Adjustment, adjustment, shifted, thinned, turned
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.types import unflatten

__all__ = ["PLACED", "parted", "placed_flight"]

PLACED = ("time_offset", "every", "lever", "mount")
"""The settings of a stream that need no file."""


def parted(settings: Mapping[str, Any], own: Collection[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings of a flight's own, and those of `PLACED` of its streams."""
    placed = {n: v for n, v in settings.items() if n not in own and n.rpartition(".")[2] in PLACED}
    return {n: v for n, v in settings.items() if n not in placed}, placed


def placed_flight(flight: Flight, given: Mapping[str, Any], kind: str) -> Flight:
    """The flight with what the settings say of its streams, and notes of it.

    Args:
        flight: as it was made.
        given: by STREAM.SETTING, of `PLACED`.
        kind: of the flight, in messages.

    Raises:
        UnknownNameError: for a stream that the flight has not.
        DeclarationError: for a setting that is not usable, or has nothing to act on.
    """
    if not given:
        return flight
    streams, info, notes = dict(flight.streams), dict(flight.info), list(flight.notes)
    for name in dict.fromkeys(setting.rpartition(".")[0] for setting in given):
        if name not in streams:
            raise UnknownNameError("stream", name, streams, path=kind)
        how = adjustment(given, name, kind)
        streams[name] = _placed(streams[name], how, info, notes, kind)
    # it is no longer as its graph makes it
    return replace(flight, streams=streams, info=info, notes=tuple(notes), experiment=None)


def _placed(series: Series, how: Adjustment, info: dict[str, Any], notes: list[str], kind: str) -> Series:
    name, leaves = series.name, dict(series.leaves)
    if how.mount is not None:
        _need(f"{name}.mount", TURNED, leaves, kind)
        leaves = turned(leaves, how.mount)
        info[f"{name}_mount"] = tuple(how.mount.tolist())
        notes.append(note("info", f"{name}: turned into the body's axes by {name}.mount"))
    if how.lever is not None:
        _need(f"{name}.lever", ("position", "latitude"), leaves, kind)
        info[f"{name}_lever"] = how.lever
        at = ", ".join(f"{x:g}" for x in how.lever)
        notes.append(note("info", f"{name}: taken to sit at ({at}) m in the body"))
    time, stamp = (shifted(name, kind, t, how.shift) for t in (series.time, series.stamp))
    if how.shift:
        notes.append(note("info", f"{name}: stamps shifted by {how.shift} ns"))
    values = unflatten(series.type, iter(leaves.values()))
    late = stamp if series.is_late else None
    moved = Series(time, values, type=series.type, name=name, gaps=series.gaps, stamp=late)
    kept = thinned(name, time, how.every, notes)
    return moved if kept.all() else moved[np.flatnonzero(kept)]


def _need(setting: str, fields: Collection[str], leaves: Mapping[str, Any], kind: str) -> None:
    if not set(fields) & set(leaves):
        raise DeclarationError(
            f"setting {setting!r} has nothing to act on",
            path=kind,
            expected=f"a stream with {' or '.join(fields)}",
            got=", ".join(leaves),
            fix=f"leave {setting} out",
        )
