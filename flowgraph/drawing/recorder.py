"""What a page remembers of the wires of a run: at some of its ticks, the last value on each, in few numbers.

A page must open in seconds and weigh little, so it cannot hold each value of each wire. A recorder looks at
ticks that are evenly spaced over the run; where it cannot know how long that will be, it drops every second
of what it has when that is enough, and then looks half as often. Of a value it keeps the small arrays whole,
of a square matrix the roots of the diagonal, and of what is larger the range; of a cloud of particles, where
some of them are.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.inputs import Inputs
from flowgraph.data.series import Series
from flowgraph.drawing.canvas import deviation
from flowgraph.drawing.fields import SIZES
from flowgraph.language.graph import CallNode, Graph, RegisterNode, SourceNode, Wire
from flowgraph.types import ArrayType, Type, flatten, leaves_of

NUMBERS = 250_000
"""That are kept of all wires, about."""

FRAMES, PARTICLES = 240, 300
"""Clouds that are kept, and particles of each."""

_WHOLE, _SQUARE = 9, 15


@dataclass(frozen=True)
class _Part:
    """What is kept of a leaf: `way` is "whole", "deviation" or "range", in `size` numbers."""

    name: str
    type: ArrayType
    way: str
    size: int

    def of(self, leaf: Any) -> np.ndarray:
        array = np.asarray(leaf, dtype=float)
        if self.way == "whole":
            return array.ravel()
        if self.way == "deviation":
            return deviation(np.diagonal(array))
        known = array[np.isfinite(array)]
        return np.array([known.min(), known.max()]) if known.size else np.full(2, np.nan)


class Recorder:
    """A watcher of `flowgraph.engines.watched`: `see` at every `stride`-th tick, `took` at the end.

    Args:
        graph: that is run.
        inputs: what it is fed; of a source that is not recorded nothing is known. None for a live run, whose
            events `see` is shown with the rest.
        share: of what a page of one run holds, for one of several.
    """

    def __init__(self, graph: Graph, inputs: Inputs | None, share: float = 1.0) -> None:
        self.graph = graph
        streams: Mapping[str, Any] = inputs.streams if isinstance(inputs, Flight) else inputs or {}
        self._sources: dict[int, Series] = {}
        self._types: dict[str, tuple[int, Type]] = {}
        self._feeds: dict[int, tuple[str, Wire]] = {}
        for index, node in enumerate(graph.nodes):
            if isinstance(node, CallNode):
                self._types |= {f"{index}.{k}": (index, p.type) for k, p in enumerate(node.outputs)}
            elif isinstance(node, SourceNode) and isinstance(streams.get(node.path), Series):
                self._sources[index] = streams[node.path]
                self._types[f"{index}.0"] = index, node.type
            elif isinstance(node, SourceNode) and inputs is None:
                self._types[f"{index}.0"] = index, node.type
            elif (
                isinstance(node, RegisterNode) and node.feed is not None and node.role in ("latest", "delay")
            ):
                self._feeds[index] = node.role, node.feed
                self._types[f"{index}.0"] = index, node.type
        self._parts = {key: _parts(type_) for key, (_, type_) in self._types.items()}
        size = sum(1 + sum(p.size for p in parts) for parts in self._parts.values())
        self._most = int(np.clip(share * NUMBERS / max(size, 1), 120, 2000))
        self.stride = max(self._ticks() // self._most, 1)
        self._times: list[int] = []
        self._rows: list[dict[str, tuple[int, np.ndarray]]] = []
        self._cloud = _cloud_of(graph)
        self._clouds: dict[int, np.ndarray] = {}  # by time
        self.blocks: Mapping[str, tuple[float, int]] = {}

    def see(
        self, time: int, seen: Mapping[Wire, tuple[int, Any]], read: Mapping[int, tuple[int, Any]]
    ) -> None:
        """Keep what a page can show of this tick."""
        self._times.append(time)
        self._rows.append(self.row(time, seen, read))
        if self._cloud is not None and self._cloud.wire in seen:
            self._clouds[time] = self._cloud.places(seen[self._cloud.wire][1])
        if len(self._times) >= 2 * self._most:
            self._thin()

    def row(
        self, time: int, seen: Mapping[Wire, tuple[int, Any]], read: Mapping[int, tuple[int, Any]]
    ) -> dict[str, tuple[int, np.ndarray]]:
        """By wire, the time of its value and the numbers that are shown of it."""
        row: dict[str, tuple[int, Any]] = {f"{w.node}.{w.output}": found for w, found in seen.items()}
        for index, series in self._sources.items():
            at = int(np.searchsorted(series.time, time, side="right")) - 1
            if at >= 0:
                row[f"{index}.0"] = int(series.time[at]), series[at]
        for index, (role, feed) in self._feeds.items():
            found = row.get(f"{feed.node}.{feed.output}") if role == "latest" else read.get(index)
            if found is not None:
                row[f"{index}.0"] = found
        return {key: (at, self._small(key, value)) for key, (at, value) in row.items()}

    def parts(self) -> dict[str, list[dict[str, Any]]]:
        """By wire, what its numbers are."""
        return {
            key: [{"name": p.name, "way": p.way, "size": p.size, "unit": p.type.unit or ""} for p in parts]
            for key, parts in self._parts.items()
        }

    def _ticks(self) -> int:
        """How many there will be; 0 where that is unknown."""
        if len(self._sources) < len(self.graph.sources) or not self._sources:
            return 0
        return len(np.unique(np.concatenate([series.time for series in self._sources.values()])))

    def took(self, blocks: Mapping[str, tuple[float, int]]) -> None:
        self.blocks = blocks

    def _small(self, key: str, value: Any) -> np.ndarray:
        leaves = flatten(value, self._types[key][1])
        return np.concatenate(
            [p.of(leaf) for p, leaf in zip(self._parts[key], leaves, strict=True)] or [np.zeros(0)]
        )

    def _thin(self) -> None:
        self.stride *= 2
        self._times, self._rows = self._times[1::2], self._rows[1::2]
        kept = set(self._times)
        self._clouds = {t: c for t, c in self._clouds.items() if t in kept}

    def data(self, begin: int) -> dict[str, Any]:
        """What was kept, with times in seconds after `begin` (ns), as `front/src/model.ts` declares it."""
        wires, shown = {}, self.parts()
        for key, parts in self._parts.items():
            size = sum(p.size for p in parts)
            rows = [row.get(key) for row in self._rows]
            if not any(row is not None for row in rows):
                continue
            wires[key] = {
                "at": packed([(row[0] - begin) * 1e-9 if row is not None else np.nan for row in rows]),
                "values": packed([row[1] if row is not None else np.full(size, np.nan) for row in rows]),
                "parts": shown[key],
            }
        found: dict[str, Any] = {
            "times": packed([(t - begin) * 1e-9 for t in self._times]), "stride": self.stride, "wires": wires,
        }  # fmt: skip
        if self._clouds and self._cloud is not None:
            times = sorted(self._clouds)
            times = times[:: -(-len(times) // FRAMES)]
            found["cloud"] = {
                "name": self.graph.label(self._cloud.wire),
                "times": packed([(t - begin) * 1e-9 for t in times]),
                "size": len(self._clouds[times[0]]),
                "of": self._cloud.count,
                "places": packed([self._clouds[t] for t in times]),
            }
        return found


def _parts(type_: Type) -> list[_Part]:
    found = []
    for name, leaf in leaves_of(type_):
        shape = tuple(int(n) for n in leaf.shape)
        size = int(np.prod(shape, dtype=int))
        if size <= _WHOLE and (len(shape) < 2 or shape[0] != shape[1]):
            found.append(_Part(name, leaf, "whole", size))
        elif len(shape) == 2 and shape[0] == shape[1] <= _SQUARE:
            found.append(_Part(name, leaf, "deviation", shape[0]))
        else:
            found.append(_Part(name, leaf, "range", 2))
    return found


@dataclass(frozen=True)
class _Cloud:
    """A wire that carries a cloud, and which of its leaves says where the particles are."""

    wire: Wire
    type: Type
    leaf: int
    across: bool  # the particle is the last axis
    count: int

    def places(self, value: Any) -> np.ndarray:
        """(particles, 3): some of them, evenly by their numbers."""
        array = np.asarray(flatten(value, self.type)[self.leaf], dtype=float)
        array = (array.T if self.across else array)[:: -(-self.count // PARTICLES), :3]
        return np.pad(array, ((0, 0), (0, 3 - array.shape[1])))


def _cloud_of(graph: Graph) -> _Cloud | None:
    """The last wire in firing order that carries positions of particles."""
    found = None
    for index, call in graph.calls:
        for k, port in enumerate(call.outputs):
            for place, (name, leaf) in enumerate(leaves_of(port.type)):
                if "particles" not in leaf.axes or len(leaf.shape) != 2:
                    continue
                across = leaf.axes[1] == "particles"
                own, count = leaf.shape if across else leaf.shape[::-1]
                places = name.rpartition(".")[2] == "position" and own in (2, 3)
                if places or (name == "state" and own in SIZES):
                    found = _Cloud(Wire(index, k), port.type, place, across, int(count))
    return found


def packed(numbers: Any) -> str:
    """Numbers as base64 of float32, little-endian."""
    array = np.asarray(numbers, dtype="<f4") if len(numbers) else np.zeros(0, "<f4")
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


__all__ = ["Recorder", "packed"]
