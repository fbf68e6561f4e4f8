"""How time and memory grow with the length of a recording, and with the number of particles, in each engine.

Each run has a process of its own, whose largest memory the system tells; what it took before the run, with
everything imported and compiled, is taken off. A run is of a whole recording with all of its outputs, or
streamed from a generator to Parquet. The exponent is the slope of log(time) over log(number): 1 is linear.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import (
    DeclarationError,
    Graph,
    Report,
    Scalar,
    Series,
    Stream,
    find_graph,
    graph,
    latest,
    periodic,
    scan,
    simulate,
    simulate_to_parquet,
)
from flowgraph.blocks.flights import simulated
from flowgraph.graphs.benches.endurance import memory

PERIOD_NS, EVERY = 5_000_000, 5
WARM = 200
LEAST_MEMORY = 2.0e6
"""Bytes below which growth is that of the allocator, and no exponent is told."""

LIMITS = {("reference", "whole"): 100_000, ("reference", "streamed"): 10_000}
"""Ticks that the reference is not asked to go beyond, since it only defines the others."""


@graph
def two_rates(a: Stream[Scalar], b: Stream[Scalar]):
    """A running fold of a fast stream, with the last value of a slow one."""
    fold = scan(a, lambda y, x: 0.99 * y + x, init=0.0)
    return {"sum": fold + latest(b, init=0.0)}


def growth(
    *,
    engines: str = "python,reference,xla,c",
    least: int = 10_000,
    most: int = 1_000_000,
    least_particles: int = 10,
    most_particles: int = 10_000,
    duration: float = 2.0,
) -> Report:
    """Time and memory of each engine against ticks, whole and streamed, and against particles.

    Args:
        engines: with commas between.
        least, most: ticks, a power of ten apart each.
        least_particles, most_particles: of `rbpf_indoor`, likewise; in C, XLA and Python.
        duration: of the particles' flight, s.

    Returns:
        A row a run: `engine`, `of` ("ticks" or "particles"), `mode`, `number`, `seconds`, `memory_bytes`; and
        a row a series of them with `time_exponent` and `memory_exponent` (None below 2 MB).
        Figure `growth.svg`.
    """
    if not (1 <= least <= most and 1 <= least_particles <= most_particles):
        raise DeclarationError(
            "there is no number between these", path="growth", expected="1 <= least <= most",
            got=f"{least} to {most} ticks, {least_particles} to {most_particles} particles",
            fix="write least=10000 and most=1000000",
        )  # fmt: skip
    rows: list[dict[str, Any]] = []
    for engine in engines.split(","):
        for mode in ("whole", "streamed"):
            for number in _decades(least, min(most, LIMITS.get((engine, mode), most))):
                rows.append(_apart("ticks", mode, engine, number, duration))
    for engine in (e for e in engines.split(",") if e != "reference"):
        for number in _decades(least_particles, most_particles):
            rows.append(_apart("particles", "whole", engine, number, duration))
    fits = [_fit(some) for some in _series(rows).values() if len(some) > 1]
    return Report([*rows, *fits], {"growth.svg": lambda path: _draw(rows, path)})


def _decades(least: int, most: int) -> list[int]:
    return [n for n in (least * 10**k for k in range(10)) if n <= most]


def _series(rows: list[dict[str, Any]]) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["of"], row["mode"], row["engine"]), []).append(row)
    return found


def _fit(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The exponents of a series of runs."""

    def slope(some: list[dict[str, Any]], name: str) -> float:
        number, value = ([r[key] for r in some] for key in ("number", name))
        return float(np.polyfit(np.log(number), np.log(np.maximum(value, 1e-9)), 1)[0])

    grows = [r for r in rows if r["memory_bytes"] > LEAST_MEMORY]
    return {
        "engine": rows[0]["engine"], "of": rows[0]["of"], "mode": rows[0]["mode"], "number": None,
        "time_exponent": slope(rows, "seconds"),
        "memory_exponent": slope(grows, "memory_bytes") if len(grows) > 1 else None,
    }  # fmt: skip


def _apart(of: str, mode: str, engine: str, number: int, duration: float) -> dict[str, Any]:
    """A run in a process of its own."""
    call = f"from {__name__} import one; one({of!r}, {mode!r}, {engine!r}, {number}, {duration})"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    return {"engine": engine, "of": of, "mode": mode, "number": number, **found}


def one(of: str, mode: str, engine: str, number: int, duration: float) -> None:
    """Run, and print the seconds of the run and the bytes that it took at most, as JSON."""
    if of == "particles":
        case = find_graph("rbpf_indoor").case(
            simulated.load(settings={"duration": duration}), particles=number
        )
        run = lambda: simulate(case.graph, case.inputs, engine=engine).wall_s
        if engine != "python":
            run()
        held = memory()
        print(json.dumps({"seconds": run(), "memory_bytes": max(peak() - held, 0)}))
        return
    built = two_rates.build(a=periodic(PERIOD_NS), b=periodic(EVERY * PERIOD_NS))
    ticks = lambda count: _play(built, mode, engine, count)
    ticks(WARM)
    if engine == "xla":
        ticks(min(number, 131_072))  # each size of a chunk is compiled once
    held = memory()
    start = perf_counter()
    ticks(number)
    print(json.dumps({"seconds": perf_counter() - start, "memory_bytes": max(peak() - held, 0)}))


def _play(built: Graph, mode: str, engine: str, count: int) -> None:
    if mode == "whole":
        time = np.arange(count, dtype=np.int64) * PERIOD_NS
        a, b = np.sin(time * 1e-9), np.cos(time[::EVERY] * 1e-9)
        simulate(built, {"a": Series(time, a), "b": Series(time[::EVERY], b)}, engine=engine)
        return
    with TemporaryDirectory() as folder:
        given = {"a": _events(count, 1), "b": _events(-(-count // EVERY), EVERY)}
        simulate_to_parquet(built, given, Path(folder) / "run", engine=engine, ticks=4096)


def _events(count: int, every: int) -> Iterator[tuple[int, float]]:
    return ((k * every * PERIOD_NS, float(k % 7)) for k in range(count))


def peak() -> int:
    """The most bytes that this process has held."""
    with open("/proc/self/status") as file:
        return 1024 * next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure  # only who wants the picture waits for it

    figure = Figure(figsize=(10.0, 6.5), layout="constrained")
    panels = figure.subplots(2, 2)
    for (of, mode, engine), some in _series(rows).items():
        column = 0 if of == "ticks" else 1
        style = {"whole": "-o", "streamed": "--s"}[mode]
        number = [r["number"] for r in some]
        colour = f"C{_KNOWN.index(engine) if engine in _KNOWN else 5}"
        label = f"{engine}, {mode}" if of == "ticks" else engine
        for line, name, unit in ((0, "seconds", 1.0), (1, "memory_bytes", 1e6)):
            values = [max(r[name] / unit, 1e-3 if line == 0 else 0.1) for r in some]
            panels[line, column].loglog(number, values, style, color=colour, label=label, markersize=4)
    for column, name in enumerate(("ticks", "particles")):
        panels[0, column].set_ylabel("time, s")
        panels[1, column].set_ylabel("memory of the run, MB")
        panels[1, column].set_xlabel(name)
        panels[0, column].legend(fontsize=7)
    for panel in panels.flat:
        panel.grid(alpha=0.3)
    figure.savefig(path)


_KNOWN = ("python", "reference", "xla", "c")
