"""Which filters can be trusted in fixed point, in words of how many bits, and how far from float64.

Every graph of the library that lowers whole is quantised on simulated flights and judged on another one. What
cannot be trusted stands there with the reason and the place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph import Case, FlowgraphError, Report, find_graph, load_flight, lower
from flowgraph.data.registry import flight_settings, graph_names
from flowgraph.data.settings import parsed_settings
from flowgraph.engines.c.fixed import CompiledIntegers
from flowgraph.engines.fixed.engine import ENGINE
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.graphs.benches import lists
from flowgraph.language.checks import need_count
from flowgraph.pipeline.formats import Formats
from flowgraph.pipeline.plain import plain
from flowgraph.recorder.random import seed_words
from flowgraph.study.differences import RELATIVE
from flowgraph.study.quantise import MARGIN, Flown, quantise

__all__ = ["FLIGHTS", "fixed", "flown"]

_WORLD = {"sensors": "imu,gps,gps2,altimeter,magnetometer,optical_flow"}
_FEW = {"particles": "60"}

FLIGHTS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "attitude_mekf": ("sim:thesis", {"sensors": "body_rate,magnetic_attitude"}),
    "gnss_ins": ("sim:drive", {"gps.rate": "5", "sensors": "gps,gps_velocity,magnetometer,barometer"}),
    "ins_ekf_pose": ("course", {}),
    "ins_particle": ("course", _FEW),
    "ins_ukf_pose": ("course", {}),
    "ins_ukf_velocity": ("course", {}),
    "marg": ("sim:thesis", {"sensors": "imu,magnetometer"}),
    "orientation_complementary": ("sim:thesis", {"sensors": "gyro,coordinate_acceleration,thrust"}),
    "outdoor_eskf": ("sim:thesis", _WORLD),
    "particle": ("sim:plane", _FEW),
    "rbpf_indoor": ("sim", {"particles": "10"}),
    "rbpf_outdoor": ("sim:thesis", {**_WORLD, **_FEW}),
    "tracker": ("sim:plane", {}),
}
"""The flight of a graph, and settings, where it is not `sim`."""


def fixed(
    *,
    graphs: str = "",
    width: int = 32,
    least: int = 32,
    bound: float = 0.01,
    flights: int = 2,
    duration: float = 5.0,
    compared: float = 0.5,
    margin: float = MARGIN,
    seed: int = 0,
) -> Report:
    """The filters in fixed point: bits, the difference to float64, and what did not fit.

    Args:
        graphs: names, between commas; all that lower whole if left out.
        width, least: bits of a word at most, and at least: narrower ones are tried while the bound holds.
        bound: of the difference of the estimate, relative to its size.
        flights: simulated ones, that the formats are found on; one more judges.
        duration: of a flight, s.
        compared: seconds of it in which the interpreter and C are compared, value by value.
        margin: the sizes that occurred times this fit.
        seed: of the first flight.

    Returns:
        A row a graph: `graph`, `bits`, `position_difference_rms_m` and `attitude_difference_rms_deg` (None if
        the estimate has none), `estimate_difference_relative`, `decisions_differing`, `saturations`,
        `divisions_by_zero`, `lost_bits`, `values_compared`, `values_differing`, and `reason`, why it has no
        formats.

    Raises:
        DeclarationError: for a setting out of range.
    """
    need_count("fixed", "flights", flights, least=1)
    rows = []
    for name in lists.names(graphs, graph_names(), what="graph", path="fixed.graphs"):
        row: dict[str, Any] = dict.fromkeys(_COLUMNS) | {"graph": name}
        try:
            some = [flown(name, seed + k, duration) for k in range(flights + 1)]
            found = quantise(
                some[:-1], some[-1:], width=width, least=least, bounds={RELATIVE: bound}, margin=margin
            )
            row |= {k: v for k, v in found.figures.items() if k in row}
            same = _compared(found.formats, some[-1], compared)
            row["values_compared"], row["values_differing"] = same
        except FlowgraphError as error:
            row["reason"] = f"{error.path}: {error.message}; {error.got}"[:300]
        rows.append(row)
    note = f"{flights} flights of {duration:g} s and one held out; the sizes times {margin:g} fit"
    return Report(rows, {}, (note,))


_COLUMNS = (
    "graph", "bits", "position_difference_rms_m", "attitude_difference_rms_deg", RELATIVE,
    "decisions_differing", "saturations", "divisions_by_zero", "lost_bits", "values_compared",
    "values_differing", "reason",
)  # fmt: skip


def flown(name: str, seed: int, duration: float, particles: int = 0) -> Flown:
    spec, given = FLIGHTS.get(name, ("sim", {}))
    if particles and "particles" in given:
        given = {**given, "particles": str(particles)}
    graph = find_graph(name)
    assert graph.prepare is not None
    mine, rest = parsed_settings(
        graph.prepare, {**given, "duration": str(duration)}, also=flight_settings(spec, None), path=name
    )
    if name in ("rbpf_indoor", "rbpf_outdoor", "particle", "ins_particle"):
        mine["seed"] = seed
    case: Case = graph.case(load_flight(spec, seed=seed, settings=rest), **mine)
    lower(case.graph, dtype="fixed")
    return Flown(case.graph, case.inputs, case.estimate, seed)


def _compared(formats: Formats, flown: Flown, seconds: float) -> tuple[int, int]:
    """How many values the interpreter and C give in the first seconds of a flight, and how many differ."""
    subject = LoweredGraph(flown.graph, dtype="fixed")
    pipeline = replace(plain(subject.pipeline), formats=formats)
    start = subject.start(RunOptions(seed=flown.seed))
    events = subject.tape(flown.inputs, start.last)
    patterns = sorted(events.patterns)
    events = events.first(int(np.searchsorted(events.time, events.time[0] + int(seconds * 1e9))))
    players = (
        ENGINE.prepare(pipeline, events.patterns, len(events.time), "fixed", ()),
        CompiledIntegers(pipeline, patterns, tabled=True),
    )
    ours, theirs = (p.play(events, start.cells, seed_words(flown.seed), None) for p in players)
    count = differing = 0
    pairs: list[tuple[Any, Any]] = list(zip(ours.cells, theirs.cells, strict=True))
    for (times, leaves), (other_times, other) in zip(ours.outputs, theirs.outputs, strict=True):
        pairs += [(times, other_times), *zip(leaves, other, strict=True)]
    for a, b in pairs:
        a, b = np.asarray(a), np.asarray(b)
        count += a.size
        differing += a.size if a.shape != b.shape else int(np.sum((a != b) & ~((a != a) & (b != b))))
    return count, differing
