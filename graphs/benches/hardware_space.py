"""The machines that a filter can become: bits of a word against lanes, each with its error, time and area.

A narrower word takes less of the FPGA and is less exact; more lanes take more of it and are faster. What no
other machine betters in one of the three without being worse in another is the Pareto front.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import FlowgraphError, Report
from flowgraph.data.files import put
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.place import TARGET_HZ, route, synthesise
from flowgraph.engines.verilog.text import texts
from flowgraph.graphs.benches.fixed import flown
from flowgraph.study.differences import RELATIVE
from flowgraph.study.quantise import quantise

__all__ = ["design_space", "draw", "fronted", "taped"]

_ANY = 1e9
"""A bound that every width keeps: here all are wanted, the bad ones too."""

_COLUMNS = (
    "graph", "width", "lanes", "multipliers", "position_difference_rms_m", "attitude_difference_rms_deg",
    RELATIVE, "saturations", "cycles", "cycles_all_aids", "area", "lut", "ff", "dsp", "bram", "fmax_hz",
    "us_per_tick", "front", "reason",
)  # fmt: skip


def taped(flight: Any, seconds: float | None = None) -> tuple[Any, Any]:
    """The ticks of a flight, or of its first seconds, and the registers that it starts from."""
    subject = LoweredGraph(flight.graph)
    start = subject.start(RunOptions(seed=flight.seed))
    events = subject.tape(flight.inputs, start.last)
    if seconds is None:
        return events, start
    return events.first(int(np.searchsorted(events.time, events.time[0] + int(seconds * 1e9)))), start


def design_space(
    name: str, widths: Sequence[int], lanes: Sequence[int], *,
    flights: int, duration: float, particles: int, routed: bool, seeds: int, folder: str, seed: int,
) -> Report:  # fmt: skip
    """A row for each width and number of lanes of a graph, and a picture.

    Args:
        name: of the graph.
        widths: bits of a word.
        lanes: of the machine, each with a multiplier.
        flights: simulated ones, that the formats are found on; one more judges.
        duration: of a flight, s.
        particles: of a filter that has some; 0 for as many as usual.
        routed: whether each is placed and routed; else it is synthesised.
        seeds: of the placer, as many as are tried at most.
        folder: where the files of each go; a temporary one if empty.
        seed: of the first flight.

    Returns:
        `graph`, `width`, `lanes`, `multipliers`, the differences to float64 (`estimate_difference_relative`
        judges), `saturations`; `cycles` and `cycles_all_aids` of the schedule; `area`, "routed" or
        "synthesised", and with it `lut`, `ff`, `dsp`, `bram`, `fmax_hz`; `us_per_tick` with all aids, at
        that clock or else at 100 MHz; `front`; and `reason`, why there is no machine.
    """
    some = [flown(name, seed + k, duration, particles) for k in range(flights + 1)]
    patterns = taped(some[-1])[0].patterns
    rows: list[dict[str, Any]] = []
    for width in widths:
        try:
            found = quantise(some[:-1], some[-1:], width=width, least=width, bounds={RELATIVE: _ANY})
        except FlowgraphError as error:
            rows += [_row(name, width, n) | _reason(error) for n in lanes]
            continue
        pipeline = replace(found.pipeline, formats=found.formats)
        for n in lanes:
            row = _row(name, width, n) | {k: v for k, v in found.figures.items() if k in _COLUMNS}
            try:
                row |= _made(pipeline, patterns, n, seeds if routed else None, folder)
            except FlowgraphError as error:
                row |= _reason(error)
            rows.append(row)
    fronted(rows)
    note = f"{name}: formats from {flights} flights of {duration:g} s; cycles are those of the schedule"
    if routed and seeds > 1:
        note += f"; place and route with up to {seeds} seeds, the fastest counts"
    return Report(rows, {"space.png": partial(draw, rows)}, (note,))


def _row(name: str, width: int, lanes: int) -> dict[str, Any]:
    return dict.fromkeys(_COLUMNS) | {
        "graph": name, "width": width, "lanes": lanes, "multipliers": lanes, "front": False,
    }  # fmt: skip


def _reason(error: FlowgraphError) -> dict[str, str]:
    return {"reason": f"{error.path}: {error.message}; {error.got}"[:300]}


def _made(
    pipeline: Any, patterns: Sequence[int], lanes: int, seeds: int | None, folder: str
) -> dict[str, Any]:
    image = Image(pipeline, patterns, lanes)
    with tempfile.TemporaryDirectory() as other:
        at = Path(folder or other) / f"{pipeline.name}_{image.width}_{lanes}"
        at.mkdir(parents=True, exist_ok=True)
        for file, text in texts(image).items():
            put(at / file, text)
        name = pipeline.name
        takes = synthesise(at, name) if seeds is None else route(at, name, seeds=seeds)
    cycles = [e.cycles for e in image.entries]
    clock = takes.fmax_hz or TARGET_HZ
    return {
        "cycles": min(cycles), "cycles_all_aids": max(cycles), "us_per_tick": max(cycles) / clock * 1e6,
        "area": "synthesised" if seeds is None else "routed", **vars(takes),
    }  # fmt: skip


_LESS = (RELATIVE, "us_per_tick", "lut")
"""What is to be little."""


def fronted(rows: list[dict[str, Any]]) -> None:
    """Mark the rows that no other betters in one figure without being worse in another."""
    whole = [r for r in rows if all(r[name] is not None for name in _LESS)]
    for r in whole:
        mine = [r[name] for name in _LESS]
        others = [[o[name] for name in _LESS] for o in whole]
        r["front"] = not any(o != mine and all(a <= b for a, b in zip(o, mine, strict=True)) for o in others)


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Error against area, and against time: filled what is on the front."""
    from matplotlib.figure import Figure  # only who wants the picture waits for it

    figure = Figure(figsize=(11.0, 4.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    whole = [r for r in rows if r["lut"] is not None and r[RELATIVE] is not None]
    counts = sorted({r["lanes"] for r in whole})
    for panel, column, label in (
        (panels[0], "lut", f"LUT of an ECP5 ({whole[0]['area'] if whole else 'none'})"),
        (panels[1], "us_per_tick", "time of a tick with all aids, µs"),
    ):
        for k, n in enumerate(counts):
            some = sorted((r for r in whole if r["lanes"] == n), key=lambda r: r["width"])
            said = f"{n} lane{'s' if n > 1 else ''}"
            x, y = [r[column] for r in some], [max(r[RELATIVE], 1e-12) for r in some]
            panel.plot(x, y, color=f"C{k}", alpha=0.35)
            for on, fill in ((True, f"C{k}"), (False, "white")):
                here = [(a, b) for a, b, r in zip(x, y, some, strict=True) if r["front"] == on]
                if here:
                    panel.scatter(
                        *zip(*here, strict=True), s=46, facecolor=fill, edgecolor=f"C{k}", zorder=3,
                        label=f"{said}, {'on the front' if on else 'bettered by another'}",
                    )  # fmt: skip
            for a, b, r in zip(x, y, some, strict=True):
                panel.annotate(
                    f"{r['width']}", (a, b), textcoords="offset points", xytext=(7, 5 + 11 * k), fontsize=9,
                    color=f"C{k}",
                )  # fmt: skip
        panel.set_yscale("log")
        panel.set_xlabel(label)
        panel.grid(alpha=0.3)
        panel.margins(y=0.2)
        panel.set_xlim(0.0, 1.2 * max((r[column] for r in whole), default=1.0))
    panels[0].set_ylabel("difference to float64, relative")
    if whole:
        handles = panels[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=4, fontsize=9)
        figure.suptitle(f"{whole[0]['graph']}: the number at a point is bits of a word")
    figure.savefig(path, dpi=110)
