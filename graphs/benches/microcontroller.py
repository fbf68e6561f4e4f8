"""What a filter takes on a Cortex-M4F and on a Cortex-M7: instructions a tick, flash, RAM and stack.

The C of each filter, in double, in float and in fixed point, is built by arm-none-eabi-gcc and replays a
simulated flight in qemu-system-arm; the same files replay it on this machine, and the lines of both are
compared. Nothing is timed: an emulator knows instructions, not cycles.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from flowgraph import FlowgraphError, Report, lower
from flowgraph.data.registry import find_graph, flight_settings, graph_names
from flowgraph.data.registry import load_flight as fly
from flowgraph.data.settings import parsed_settings
from flowgraph.engines.c import generate, write_c, write_events
from flowgraph.engines.c.cortex import CORES, Measured, Metered, measure, need_tools, on_host
from flowgraph.engines.c.fixed_replay import write_fixed
from flowgraph.engines.c.header import react_signature
from flowgraph.engines.c.names import given, made
from flowgraph.graphs.benches import lists
from flowgraph.graphs.benches.fixed import FLIGHTS
from flowgraph.pipeline.optimise import COMPILED, optimise
from flowgraph.study.differences import RELATIVE
from flowgraph.study.quantise import Flown, quantise

__all__ = ["microcontroller"]

KINDS = ("float64", "float32", "fixed")


def microcontroller(
    *,
    graphs: str = "ins_eskf",
    cores: str = "cortex-m4f,cortex-m7",
    dtypes: str = "float64,float32,fixed",
    width: int = 28,
    margin: float = 8.0,
    duration: float = 2.0,
    flights: int = 3,
    seed: int = 0,
) -> Report:
    """Filters on microcontrollers: instructions a tick, flash, RAM, stack, and what is equal to the host.

    Args:
        graphs: names, between commas.
        cores: cortex-m4f, cortex-m7.
        dtypes: float64, float32, fixed.
        width: bits of a word in fixed point.
        margin: the sizes that occurred times this fit a word.
        duration: of a flight, s.
        flights: simulated ones that number formats are found on; the one after them is replayed.
        seed: of the first.

    Returns:
        A row a filter, core and kind of number: `text_bytes` of the filter, `flash_bytes` with what it calls
        of the compiler and library, `ram_bytes` that are kept for it, `stack_bytes` of the deepest tick,
        `instructions_usual` of the commonest pattern of inputs and `instructions_all` of the fullest (means),
        `lines` printed, and `lines_equal` to the text on this machine.

    Raises:
        MissingDependencyError: without the cross compiler or the emulator.
        UnknownNameError: for a core or a kind of number that is not there.
    """
    need_tools()
    kinds = lists.names(dtypes, KINDS, what="dtype", path="microcontroller.dtypes")
    chips = lists.names(cores, CORES, what="core", path="microcontroller.cores")
    chosen = lists.names(graphs, graph_names(), what="graph", path="microcontroller.graphs")
    rows: list[dict[str, Any]] = []
    for name in chosen:
        cases = [_flown(name, seed + k, duration) for k in range(flights + 1)]
        for dtype in kinds:
            with tempfile.TemporaryDirectory() as folder:
                try:
                    rows += _rows(name, dtype, chips, cases, Path(folder), width, margin)
                except FlowgraphError as error:
                    reason = f"{error.path}: {error.message}; {error.got}"[:300]
                    rows.append({"graph": name, "core": None, "dtype": dtype, "reason": reason})
    columns = dict.fromkeys(k for row in rows for k in row)
    note = (
        f"a simulated flight of {duration:g} s; -Os, with the sines of the generated text; "
        f"fixed: {width} bits, the sizes times {margin:g} fit; instructions are counted, not cycles"
    )
    return Report([dict.fromkeys(columns) | row for row in rows], {}, (note,))


def _flown(name: str, seed: int, duration: float) -> Flown:
    spec, settings = FLIGHTS.get(name, ("sim", {}))
    graph = find_graph(name)
    assert graph.prepare is not None
    mine, rest = parsed_settings(
        graph.prepare, {**settings, "duration": str(duration)}, also=flight_settings(spec, None), path=name
    )
    case = graph.case(fly(spec, seed=seed, settings=rest), **mine)
    return Flown(case.graph, case.inputs, case.estimate, seed)


def _rows(
    name: str, dtype: str, cores: list[str], cases: list[Flown], folder: Path, width: int, margin: float
) -> list[dict[str, Any]]:
    flown = cases[-1]
    pipeline = lower(flown.graph, dtype=dtype)
    events = folder / "events.csv"
    write_events(pipeline, flown.inputs, events)
    if dtype == "fixed":
        found = quantise(
            cases[:-1], cases[-1:], width=width, least=width, bounds={RELATIVE: math.inf}, margin=margin
        )
        write_fixed(replace(found.pipeline, formats=found.formats), folder)
        file = f"{pipeline.name}_fixed.c"
        takes = "(int32_t *v, int64_t *w, int64_t *count, int key)"
        names = ("v", "w", "count", "key")
        functions = [
            Metered(f"int {f}{takes}", f, names, "key", f == "fx_end") for f in ("fx_compute", "fx_end")
        ]
        tables: tuple[str, ...] = ("fx_begin",)
        ram = "FX_SMALL * sizeof(int32_t) + (FX_WIDE + 3) * sizeof(int64_t)"
    else:
        write_c(pipeline, folder, dtype)
        source = generate(pipeline, dtype, tidy=lambda program: optimise(program, COMPILED))
        m = source.names.module
        file, react = f"{m}.c", f"{m}_react"
        arguments = ("s", "time", "present", *given(source.names), *made(source.names))
        functions = [Metered(react_signature(source.names), react, arguments, "present")]
        ram, tables = f"sizeof({m}_state)", ()
    host = on_host(folder, file, events).splitlines()
    rows = []
    for core in cores:
        took = measure(core, folder, file, functions, ram, events, tables)
        rows.append({"graph": name, "core": core, "dtype": dtype} | _row(took, host))
    return rows


def _row(took: Measured, host: list[str]) -> dict[str, Any]:
    lines = took.outputs.splitlines()
    equal = sum(a == b for a, b in zip(lines, host, strict=False))
    fullest = max(took.instructions, key=lambda k: (k.bit_count(), k))
    usual = max(took.ticks, key=lambda k: took.ticks[k])
    return {
        "text_bytes": took.text,
        "flash_bytes": took.flash,
        "ram_bytes": took.ram,
        "stack_bytes": took.stack,
        "instructions_usual": round(took.instructions[usual]),
        "instructions_all": round(took.instructions[fullest]),
        "lines": max(len(lines), len(host)),
        "lines_equal": equal,
    }
