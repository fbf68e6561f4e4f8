"""How many bits the registers of a particle filter need, if it is to resample as in float64.

Everything is computed in float64, and only what is kept from one tick to the next is rounded, to words of so
many bits. No arithmetic in words that keeps its state in one word each can do better, whatever its formats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from flowgraph import Report, find_graph, load_flight
from flowgraph.data.tape import Tape
from flowgraph.engines.options import RunOptions
from flowgraph.engines.reference import Interpreter
from flowgraph.engines.subject import LoweredGraph
from flowgraph.graphs.benches import lists
from flowgraph.pipeline.formats import fraction_for
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program
from flowgraph.recorder.random import seed_words

__all__ = ["played", "registers", "rounded"]

MARGIN = 2.0
"""The sizes that occurred times this fit a word."""


def registers(
    *,
    particles: str = "10,100,1000",
    bits: str = "24,26,28,30,32,34,36,38",
    duration: float = 20.0,
    seed: int = 3,
) -> Report:
    """`rbpf_indoor` on a simulated flight, with its registers rounded to words after each tick.

    Args:
        particles, bits: whole numbers, between commas.
        duration: of the flight, s.
        seed: of the flight, the start and the draws.

    Returns:
        A row a number of particles and of bits: `particles`, `bits`, `events` at which it may resample,
        `events_differing` (in whether it does, or in which particle any new one is a copy of), and
        `first_differing`, the first of them, or None.

    Raises:
        DeclarationError: for a setting out of range.
    """
    rows: list[dict[str, Any]] = []
    for n in lists.numbers(particles, "registers.particles"):
        flight = load_flight("sim", seed=seed, settings={"duration": str(duration)})
        case = find_graph("rbpf_indoor").case(flight, particles=n, seed=seed)
        subject = LoweredGraph(case.graph)
        start = subject.start(RunOptions(seed=seed))
        given = (subject.pipeline, subject.tape(case.inputs, start.last), start.cells, seed_words(seed))
        decided, sizes = _played(*given, None)
        for width in lists.numbers(bits, "registers.bits"):
            fractions = [None if s is None else fraction_for(MARGIN * s, width) for s in sizes]
            found, _ = _played(*given, fractions)
            differs = [
                k for k, (a, b) in enumerate(zip(decided, found, strict=True)) if not np.array_equal(a, b)
            ]
            rows.append({
                "particles": n, "bits": width, "events": len(decided), "events_differing": len(differs),
                "first_differing": differs[0] if differs else None,
            })  # fmt: skip
    note = f"a flight of {duration:g} s; only registers are rounded, and sizes times {MARGIN:g} fit them"
    return Report(rows, {}, (note,))


def _played(
    pipeline: Pipeline, tape: Tape, cells: list[Any], seed: np.ndarray, fractions: list[Any] | None
) -> tuple[list[np.ndarray], list[Any]]:
    """The decisions of each event, and the largest that each real register was; particles are taken
    together."""
    kept = [c for r in pipeline.registers for c in r.cells]
    out = next(k for k, port in enumerate(pipeline.outputs) if port.name == "ancestors")
    decided: list[np.ndarray] = []
    sizes: list[Any] = [None] * len(kept)

    def keep(k: int, x: Any) -> Any:
        if fractions is not None:
            return rounded(x, fractions[k])
        alike = tuple(a for a, name in enumerate(kept[k].axes) if name == "particles")
        size = np.abs(x).max(axis=alike, keepdims=True) if alike else np.abs(x)
        sizes[k] = size if sizes[k] is None else np.maximum(sizes[k], size)
        return x

    for program, env in played(pipeline, tape, cells, seed, keep):
        flag, leaves = program.outputs[out]
        if flag is not None and env.get(flag, True):
            decided.append(np.concatenate([np.ravel(env[n]).astype(np.int64) for n in leaves]))
    return decided, sizes


def played(
    pipeline: Pipeline,
    tape: Tape,
    cells: list[Any],
    seed: np.ndarray,
    keep: Callable[[int, Any], Any],
) -> Iterator[tuple[Program, dict[int, Any]]]:
    """Play a flight in float64: after each tick its program and values.

    Args:
        pipeline, tape, cells, seed: the flight.
        keep: given the place of a real register cell and its value, what the next tick reads of it.
    """
    player = Interpreter(pipeline, cells, np.dtype(np.float64), seed)
    real = [c.dtype == "real" for r in pipeline.registers for c in r.cells]
    rows = [zip(*s.leaves.values(), strict=True) for s in tape.series]
    for time, key in zip(tape.time.tolist(), tape.key.tolist(), strict=True):
        values = [next(row) for k, row in enumerate(rows) if key >> k & 1]
        program, env = player.values(time, key, values)
        written = (env[n] for n in program.writes)
        player.cells = [keep(k, x) if real[k] else x for k, x in enumerate(written)]
        yield program, env


def rounded(x: Any, fraction: np.ndarray) -> Any:
    """Reals rounded to multiples of 2^-fraction."""
    return np.ldexp(np.floor(np.ldexp(x, fraction.astype(int)) + 0.5), -fraction.astype(int))
