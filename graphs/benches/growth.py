"""How time and memory grow with the length of a recording, and with the number of particles, in each engine.

Each run has a process of its own, on one core where the system lets it: threads of a library that wait for
each other spin, which counts as time of the processor and is no work. Its time is that of the processor
(the system's part included), which other programs on the machine do not lengthen much, the least of some
runs where they are short; what is imported and compiled once is done before. Its memory is the most that
the process held, less what it held before. A run is of a whole recording with all of its outputs, whose
memory counts but not the time in which it is made; or streamed, from arrays that are made as they are
needed to Parquet. Of particles only the pose is kept.

The exponent p of time is that of t = a + b n^p, with the smallest errors relative to t: what a run costs
whatever its length is `a`, and is no growth. That of memory is the slope of log(memory) over log(n) where the
run took more than the allocator's own. 1 is linear. Beside the particles stands what it takes to copy the
filter's registers once a tick, in an array of its own: no filter that changes them all is quicker, and where
they leave the caches that is no line either.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np

from flowgraph import (
    DeclarationError,
    Flight,
    Graph,
    Report,
    Scalar,
    Series,
    Stream,
    find_graph,
    graph,
    latest,
    lower,
    periodic,
    scan,
    simulate,
    simulate_many,
    simulate_to_parquet,
)
from flowgraph.blocks.flights import simulated
from flowgraph.data.notes import note
from flowgraph.graphs.benches import lists
from flowgraph.graphs.benches.endurance import memory

PERIOD_NS, EVERY = 5_000_000, 5
PIECE = 65_536
"""Ticks of a streamed run that are made, played and written at a time."""
LEAST_MEMORY = 1.0e6
"""Bytes below which growth is that of the allocator, and no exponent is told."""
ENOUGH, AGAIN, LONG, REPEATS = 0.3, 3, 8.0, 7
"""A run is repeated for so many seconds, and so often where it does not take too long: the first is dearer,
as the system hands out the pages of its memory. Seven times at most."""

_ONE_CORE = """
import os
if hasattr(os, "sched_setaffinity"):  # before a library counts the cores for its threads
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
"""

RANGES: dict[str, dict[str, tuple[int, int]]] = {
    "python": {"whole": (1_000, 10_000_000), "streamed": (1_000, 10_000_000), "particles": (10, 100_000)},
    "numpy": {"whole": (100, 1_000_000), "streamed": (100, 1_000_000), "particles": (10, 100_000)},
    "xla": {"whole": (1_000, 10_000_000), "streamed": (10_000, 100_000_000), "particles": (10, 1_000_000)},
    "c": {"whole": (1_000, 10_000_000), "streamed": (10_000, 100_000_000), "particles": (10, 1_000_000)},
    "reference": {"whole": (10, 10_000), "streamed": (10, 10_000), "particles": (10, 1_000)},
}
"""From where to where each engine is measured: four decades or more, and what takes minutes at most. The
reference only defines the others."""


@graph
def two_rates(a: Stream[Scalar], b: Stream[Scalar]):
    """A running fold of a fast stream, with the last value of a slow one."""
    fold = scan(a, lambda y, x: 0.99 * y + x, init=0.0)
    return {"sum": fold + latest(b, init=0.0)}


def growth(
    *,
    engines: str = "python,numpy,xla,c",
    parts: str = "whole,streamed,particles",
    least: int = 1,
    most: int = 100_000_000,
    least_particles: int = 1,
    most_particles: int = 1_000_000,
    duration: float = 0.3,
) -> Report:
    """Time and memory of each engine against ticks, whole and streamed, and against particles.

    Args:
        engines, parts: with commas between. A part is "whole", "streamed" (both over ticks) or "particles".
        least, most: ticks, for no more than the numbers between, a power of ten apart, that an engine is
            measured at.
        least_particles, most_particles: of `rbpf_indoor`, likewise.
        duration: of the particles' flight, s.

    Returns:
        A row a run: `engine`, `of` ("ticks" or "particles"), `mode`, `number`, `seconds` of the processor,
        `memory_bytes`, of particles `copy_s` too, what copying the registers takes; and a row a series of
        them with `number` None, `time_exponent` (None of fewer than three) with its standard error
        `time_error` (None of fewer than four), `memory_exponent` (None below 1 MB), and `copy_exponent`.
        Figures `growth.svg` and, as a table, `growth.md`. A note says how long it took.
    """
    if not (1 <= least <= most and 1 <= least_particles <= most_particles):
        raise DeclarationError(
            "there is no number between these", path="growth", expected="1 <= least <= most",
            got=f"{least} to {most} ticks, {least_particles} to {most_particles} particles",
            fix="write least=10000 and most=1000000",
        )  # fmt: skip
    chosen = (
        lists.names(engines, RANGES, what="engine", path="growth.engines"),
        lists.names(parts, RANGES["c"], what="part", path="growth.parts"),
    )
    begun, busy = perf_counter(), _busy()
    rows: list[dict[str, Any]] = []
    for engine in chosen[0]:
        for mode in chosen[1]:
            low, high = RANGES[engine][mode]
            of, how = ("particles", "whole") if mode == "particles" else ("ticks", mode)
            ends = (least_particles, most_particles) if mode == "particles" else (least, most)
            for number in _decades(max(low, ends[0]), min(high, ends[1])):
                rows.append(_apart(of, how, engine, number, duration))
    fits = [_fit(some) for some in _series(rows).values() if len(some) > 1]
    made = [*rows, *fits]
    figures = {"growth.svg": partial(_draw, rows), "growth.md": partial(_write, made)}
    took = (
        f"{len(rows)} processes took {perf_counter() - begun:.0f} s, {_busy() - busy:.0f} s of the processor"
    )
    return Report(made, figures, (note("info", took),))


def _busy() -> float:
    """Seconds of the processor that the processes which have ended took."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def _decades(least: int, most: int) -> list[int]:
    return [n for n in (10**k for k in range(10)) if least <= n <= most]


def _series(rows: list[dict[str, Any]]) -> dict[tuple[str, str, str], list[dict[str, Any]]]:
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["of"], row["mode"], row["engine"]), []).append(row)
    return found


def _fit(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The exponents of a series of runs."""
    number, seconds, held = (
        np.array([r[name] for r in rows], float) for name in ("number", "seconds", "memory_bytes")
    )
    grows = held > LEAST_MEMORY
    copied = np.array([r.get("copy_s") or 0.0 for r in rows])
    enough = len(rows) > 2
    power, error = exponent(number, seconds) if enough else (None, None)
    return {
        "engine": rows[0]["engine"], "of": rows[0]["of"], "mode": rows[0]["mode"], "number": None,
        "time_exponent": power, "time_error": error,
        "copy_exponent": exponent(number, copied)[0] if enough and copied.all() else None,
        "memory_exponent": float(np.polyfit(np.log(number[grows]), np.log(held[grows]), 1)[0])
        if grows.sum() > 1
        else None,
    }  # fmt: skip


def exponent(number: np.ndarray, taken: np.ndarray) -> tuple[float, float | None]:
    """p of a + b n^p, with a and b >= 0, of which the sum of squared relative errors is least.

    Returns:
        p, and its standard error as those errors tell it; None where there are fewer than four.
    """

    def fit(p: float) -> tuple[float, np.ndarray, np.ndarray]:
        """The sum of squares, the columns that it is of, and their weights."""
        rest = []
        for columns in ([0 * number + 1, number**p], [number**p]):
            basis = np.stack(columns, axis=1) / taken[:, None]
            found = np.linalg.lstsq(basis, np.ones(len(taken)), rcond=None)[0]
            if (found >= 0).all():
                rest.append((float(((basis @ found - 1) ** 2).sum()), basis, found))
        return min(rest, key=lambda r: r[0])

    tried = np.arange(0.05, 3.0, 0.005)
    p = float(min(tried, key=lambda q: fit(q)[0]))
    if len(number) < 4:
        return p, None
    squares, basis, found = fit(p)
    slope = found[-1] * basis[:, -1] * np.log(number)
    slopes = np.column_stack([basis, slope])
    sizes = np.linalg.norm(slopes, axis=0)  # seconds and powers of n differ by more than digits there are
    slopes = slopes / sizes
    spread = np.linalg.pinv(slopes.T @ slopes)[-1, -1] / sizes[-1] ** 2
    return p, float(np.sqrt(squares / max(len(number) - slopes.shape[1], 1) * spread))


def _apart(of: str, mode: str, engine: str, number: int, duration: float) -> dict[str, Any]:
    """A run in a process of its own, on one core."""
    call = f"{_ONE_CORE}from {__name__} import one; one({of!r}, {mode!r}, {engine!r}, {number}, {duration})"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    return {"engine": engine, "of": of, "mode": mode, "number": number, **found}


def one(of: str, mode: str, engine: str, number: int, duration: float) -> None:
    """Run, and print the seconds of a run and the bytes that the first took at most, as JSON."""
    if of == "particles":
        case = find_graph("rbpf_indoor").case(
            simulated.load(settings={"duration": duration}), particles=number
        )
        options: dict[str, Any] = {"engine": engine, "keep": ["pose"], "runs_at_once": 1}
        given: Callable[[], Callable[[], object]] = lambda: partial(
            simulate_many, case.graph, case.inputs, [0], **options
        )
        if engine in ("c", "xla"):
            given()()
    else:
        built = two_rates.build(a=periodic(PERIOD_NS), b=periodic(EVERY * PERIOD_NS))
        given = lambda: _run(built, mode, engine, number)
        # XLA compiles for each number of ticks; and the first run of any loads what it needs
        _run(built, mode, engine, min(number, PIECE) if engine == "xla" else 200)()
    give_back()
    forget_peak()
    held = memory()
    run = given()
    seconds = [_timed(run)]
    taken = max(peak() - held, 0)
    while len(seconds) < REPEATS and (sum(seconds) < ENOUGH or (len(seconds) < AGAIN and seconds[0] < LONG)):
        seconds.append(_timed(run))
    found: dict[str, Any] = {"seconds": min(seconds), "memory_bytes": taken, "runs": len(seconds)}
    if of == "particles":
        cells = [c for r in lower(case.graph).registers for c in r.cells]
        assert not isinstance(case.inputs, Flight)  # its streams are given
        ticks = len(np.unique(np.concatenate([s.time for s in case.inputs.values()])))
        found["copy_s"] = _copied(sum(8 * math.prod(c.shape) for c in cells), ticks)
    print(json.dumps(found))


def _copied(size: int, times: int) -> float:
    """Seconds of the processor to copy so many bytes so often, from one array to another and back."""
    one_, other = (np.full(max(size // 8, 1), 1.0) for _ in range(2))
    turns = max(1, min(times, 2**31 // max(size, 1)))

    def copy() -> None:
        for _ in range(turns):
            np.copyto(other, one_)

    return min(_timed(copy) for _ in range(REPEATS)) * times / turns


def _timed(run: Callable[[], object]) -> float:
    start = process_time()
    run()
    return process_time() - start


def _run(built: Graph, mode: str, engine: str, count: int) -> Callable[[], object]:
    """A run over so many ticks; a whole recording is made here, one that is streamed as it is played."""
    counts = {"a": (count, 1), "b": (-(-count // EVERY), EVERY)}
    if mode == "whole":
        recording = {name: next(_pieces(*some, max(count, 1))) for name, some in counts.items()}
        return lambda: simulate(built, recording, engine=engine)

    def streamed() -> None:
        with TemporaryDirectory() as folder:
            given = {name: _pieces(*some, PIECE) for name, some in counts.items()}
            simulate_to_parquet(built, given, Path(folder) / "run", engine=engine, ticks=PIECE)

    return streamed


def _pieces(count: int, every: int, size: int) -> Iterator[Series]:
    """So many values of a stream, at each n-th tick."""
    for first in range(0, count, size):
        time = np.arange(first, min(first + size, count), dtype=np.int64) * (every * PERIOD_NS)
        yield Series(time, np.sin(time * 1e-9))


def peak() -> int:
    """The most bytes that this process has held, since that was forgotten."""
    with open("/proc/self/status") as file:
        return 1024 * next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))


def give_back() -> None:
    """What the allocator keeps of an earlier run is the system's again, where it has a function for that."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def forget_peak() -> None:
    """From here on the peak is counted, where the system lets it."""
    with suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


_POWERS = ("time_exponent", "memory_exponent", "copy_exponent")


def _write(rows: list[dict[str, Any]], path: Path) -> None:
    """The exponents, and where they come from, as a table."""
    known = _series([r for r in rows if r["number"] is not None])
    lines = [
        "| engine | of | run | from | to | time | exponent | memory | exponent | copied | exponent |",
        "|---|---|---|---:|---:|---|---:|---|---:|---|---:|",
    ]
    for fit in (r for r in rows if r["number"] is None):
        first, *_, last = known[fit["of"], fit["mode"], fit["engine"]]
        spans = [f"{end['number']:,}" for end in (first, last)]
        time = f"{_short(first['seconds'])} to {_short(last['seconds'])} s"
        held = f"{first['memory_bytes'] / 1e6:.1f} to {last['memory_bytes'] / 1e6:.1f} MB"
        powers = ["" if fit.get(k) is None else f"{fit[k]:.2f}" for k in _POWERS]
        if fit.get("time_error") is not None:
            powers[0] += f" ± {fit['time_error']:.2f}"
        copied = f"{_short(first['copy_s'])} to {_short(last['copy_s'])} s" if first.get("copy_s") else ""
        cells = [f"`{fit['engine']}`", fit["of"], fit["mode"], *spans]
        cells += [time, powers[0], held, powers[1], copied, powers[2]]
        lines.append("| " + " | ".join(cells) + " |")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _short(seconds: float) -> str:
    return f"{seconds:.2g}" if seconds < 10 else f"{seconds:.0f}"


def _draw(rows: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure  # only who wants the picture waits for it

    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    panels = figure.subplots(2, 3, sharex="col")
    columns = [("ticks", "whole"), ("ticks", "streamed"), ("particles", "whole")]
    for (of, mode, engine), some in _series(rows).items():
        column = columns.index((of, mode))
        number = [r["number"] for r in some]
        place = list(RANGES).index(engine)
        style = {"color": f"C{place}", "marker": "os^Dv"[place], "markersize": 4, "label": engine}
        panels[0, column].loglog(number, [r["seconds"] for r in some], **style)
        panels[1, column].loglog(number, [max(r["memory_bytes"] / 1e6, 0.1) for r in some], **style)
    titles = ("whole recording", "streamed to Parquet", "rbpf_indoor")
    for k, ((of, _), title) in enumerate(zip(columns, titles, strict=True)):
        panels[0, k].set_title(title, fontsize=10)
        panels[1, k].set_xlabel(of)
        for panel in (p for p in panels[:, k] if p.lines):
            (low, high), (bottom, top) = panel.get_xlim(), panel.get_ylim()
            linear = [top * low / high, top]  # to the upper corner: what is steeper is not linear
            panel.loglog([low, high], linear, color="0.75", linewidth=1.0, zorder=0, label="linear")
            panel.set(xlim=(low, high), ylim=(bottom, top))
            panel.grid(alpha=0.3)
    panels[0, 0].set_ylabel("processor time, s")
    panels[1, 0].set_ylabel("memory of the run, MB")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path)
