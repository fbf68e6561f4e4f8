"""Filters as hardware: cycles, equality with the interpreter, and what a routed FPGA takes.

Each filter is quantised on simulated flights, written as Verilog, and played in Verilator beside the
integer interpreter, register by register and output by output. With `routed` it is synthesised, placed and
routed too.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from flowgraph import DeclarationError, FlowgraphError, Report, UnknownNameError
from flowgraph.data.files import put
from flowgraph.data.registry import graph_names
from flowgraph.engines.hls.play import PlayedHls
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.place import TARGET_HZ, route
from flowgraph.engines.verilog.simulate import Simulated
from flowgraph.engines.verilog.text import texts
from flowgraph.engines.verilog.toggles import toggles
from flowgraph.graphs.benches import lists
from flowgraph.graphs.benches.fixed import flown
from flowgraph.graphs.benches.hardware_space import design_space, taped
from flowgraph.language.checks import need_count
from flowgraph.recorder.random import seed_words
from flowgraph.study.differences import RELATIVE
from flowgraph.study.quantise import quantise

__all__ = ["hardware"]

GRAPHS = "kalman,complementary,ekf,marg,ins_eskf"


def hardware(
    *,
    graphs: str = GRAPHS,
    width: int = 28,
    bound: float = 0.01,
    flights: int = 2,
    duration: float = 3.0,
    compared: float = 0.5,
    particles: int = 0,
    lanes: str = "1",
    played: str = "verilog",
    energy: bool = False,
    routed: bool = False,
    seeds: int = 1,
    space: str = "",
    folder: str = "",
    seed: int = 0,
) -> Report:
    """The filters as hardware: cycles a tick, words compared with the interpreter, and a routed FPGA.

    Args:
        graphs: names, between commas; "all" for every one that needs no host.
        width: bits of a word.
        bound: of the difference of the estimate to float64, relative to its size.
        flights: simulated ones, that the formats are found on; one more judges.
        duration: of a flight, s.
        compared: seconds of it that are played in Verilator; with 0 the machine is made and not played.
        particles: of the filters that have some; as many as `bench fixed` takes if left out.
        lanes: of the machine, some between commas; each has a multiplier of 34 bits.
        played: "verilog", or "hls" for the C++ of high-level synthesis, which has no cycles.
        energy: whether to count what the energy of a tick goes with.
        routed: whether to synthesise, place and route each.
        seeds: of the placer: they are tried until one reaches 100 MHz, and the fastest counts.
        space: widths between commas, such as 16,20,24: then one graph is made in each, and a row is a
            machine, with a picture of the Pareto front. See `hardware_space`.
        folder: where the files of each go; a temporary one if left out.
        seed: of the first flight.

    Returns:
        A row a graph and number of lanes: `graph`, `particles` (the setting above), `width`, `lanes`,
        `multipliers` (of 34 bits),
        `position_difference_rms_m`, `attitude_difference_rms_deg`, `saturations`, `values_compared`,
        `values_differing`, `cycles` (of the shortest tick) and `cycles_all_aids` (of the longest), `steps` of
        the program and how many are different (`steps_different`), `words` of memory, and the `memories` of
        18 kbit that both want; where `energy` is asked for, `energy_estimate_operations` (terms of sums in
        the longest tick; None of a filter with loops) and `energy_estimate_toggles` (bits that change in a
        mean tick, block memories left out); `lut`, `ff`, `dsp`, `bram`, `fmax_hz` (None where it was not
        routed), `us_per_tick` (with all aids, at that clock,
        or else at 100 MHz), and `reason`, why there is no machine.
    """
    if played not in ("verilog", "hls"):
        raise UnknownNameError("text to play", played, ("verilog", "hls"), path="played")
    if compared < 0.0 or (compared == 0.0 and (energy or played == "hls")):
        raise DeclarationError(
            "this plays a part of a flight", path="compared", expected="more than 0 s", got=f"{compared:g}",
            fix="write --set compared=0.5",
        )  # fmt: skip
    need_count("hardware", "seeds", seeds, least=1)
    chosen = lists.names(graphs, graph_names(), what="graph", path="hardware.graphs")
    counts = lists.numbers(lanes, "hardware.lanes")
    if space:
        if len(chosen) != 1:
            raise DeclarationError(
                "the machines of one graph are compared", path="space", expected="one name in graphs",
                got=", ".join(chosen), fix="write --set graphs=kalman",
            )  # fmt: skip
        return design_space(
            chosen[0], lists.numbers(space, "hardware.space"), counts, flights=flights, duration=duration,
            particles=particles, routed=routed, seeds=seeds, folder=folder, seed=seed,
        )  # fmt: skip
    rows: list[dict[str, Any]] = []
    for name, count in product(chosen, counts):
        row: dict[str, Any] = dict.fromkeys(_COLUMNS) | {
            "graph": name, "particles": particles or None, "width": width,
            "lanes": count, "multipliers": count,
        }  # fmt: skip
        try:
            some = [flown(name, seed + k, duration, particles) for k in range(flights + 1)]
            found = quantise(some[:-1], some[-1:], width=width, least=width, bounds={RELATIVE: bound})
            row |= {k: v for k, v in found.figures.items() if k in row}
            pipeline = replace(found.pipeline, formats=found.formats)
            if played == "hls":
                _compiled(row, pipeline, some[-1], compared)
                rows.append(row)
                continue
            _played(row, pipeline, some[-1], compared)
            if energy:
                _weighed(row, pipeline, some[-1], compared)
            if routed:
                _routed(row, pipeline, some[-1], folder, seeds)
            clock = row["fmax_hz"] or TARGET_HZ
            row["us_per_tick"] = row["cycles_all_aids"] / clock * 1e6
        except FlowgraphError as error:
            row["reason"] = f"{error.path}: {error.message}; {error.got}"[:300]
        rows.append(row)
    where = "Verilator" if played == "verilog" else "C++ compiled here"
    note = f"formats from {flights} flights of {duration:g} s; {compared:g} s of another played in {where}"
    tried = (f"place and route with up to {seeds} seeds, the fastest counts",) if routed and seeds > 1 else ()
    return Report(rows, {}, (note, *tried))


_COLUMNS = (
    "graph", "particles", "width", "lanes", "multipliers", "position_difference_rms_m",
    "attitude_difference_rms_deg", "saturations", "values_compared", "values_differing",
    "cycles", "cycles_all_aids", "steps", "steps_different", "words", "memories",
    "energy_estimate_operations", "energy_estimate_toggles", "lut", "ff", "dsp", "bram", "fmax_hz",
    "us_per_tick", "reason",
)  # fmt: skip


def _played(row: dict[str, Any], pipeline: Any, flight: Any, seconds: float) -> None:
    if seconds:
        events, start = taped(flight, seconds)
        player = Simulated(pipeline, events.patterns, check=True, lanes=row["lanes"])
        player.play(events, start.cells, seed_words(flight.seed), None)
        image, cycles = player.image, player.cycles
        row |= {"values_compared": player.compared, "values_differing": player.differing}
    else:
        image = Image(pipeline, taped(flight)[0].patterns, row["lanes"])
        cycles = [e.cycles for e in image.entries]
    row |= {
        "cycles": min(cycles), "cycles_all_aids": max(cycles), "steps": len(image.program),
        "steps_different": len(set(image.program)),
        "words": image.words, "memories": image.memories,
    }  # fmt: skip


def _compiled(row: dict[str, Any], pipeline: Any, flight: Any, seconds: float) -> None:
    events, start = taped(flight, seconds)
    player = PlayedHls(pipeline, events.patterns, check=True)
    player.play(events, start.cells, seed_words(flight.seed), None)
    row |= {"values_compared": player.compared, "values_differing": player.differing}


def _weighed(row: dict[str, Any], pipeline: Any, flight: Any, seconds: float) -> None:
    events, start = taped(flight, seconds)
    image = Image(pipeline, events.patterns, row["lanes"])
    if not image.has_rows:
        row["energy_estimate_operations"] = max(e.terms for e in image.entries)
    row["energy_estimate_toggles"] = round(toggles(image, events, start.cells, seed_words(flight.seed)))


def _routed(row: dict[str, Any], pipeline: Any, flight: Any, folder: str, seeds: int) -> None:
    events, _ = taped(flight, None)
    with tempfile.TemporaryDirectory() as other:
        at = Path(folder or other) / pipeline.name
        at.mkdir(parents=True, exist_ok=True)
        for name, text in texts(Image(pipeline, events.patterns, row["lanes"])).items():
            put(at / name, text)
        row |= vars(route(at, pipeline.name, seeds=seeds))
