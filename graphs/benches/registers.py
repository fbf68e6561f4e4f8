"""How many bits the registers of a particle filter need, if it is to resample as in float64.

Everything is computed in float64, and only what is kept from one tick to the next is rounded, to words of so
many bits. No arithmetic in words that keeps its state in one word each can do better, whatever its formats.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import DeclarationError, Report, find_graph, load_flight
from flowgraph.data.tape import Tape
from flowgraph.engines.options import RunOptions
from flowgraph.engines.reference import Interpreter
from flowgraph.engines.subject import LoweredGraph
from flowgraph.pipeline.formats import fraction_for
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.random import seed_words

__all__ = ["registers"]

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
    for n in _numbers(particles, "particles"):
        flight = load_flight("sim", seed=seed, settings={"duration": str(duration)})
        case = find_graph("rbpf_indoor").case(flight, particles=n, seed=seed)
        subject = LoweredGraph(case.graph)
        start = subject.start(RunOptions(seed=seed))
        given = (subject.pipeline, subject.tape(case.inputs, start.last), start.cells, seed_words(seed))
        decided, sizes = _played(*given, None)
        for width in _numbers(bits, "bits"):
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


def _numbers(text: str, name: str) -> list[int]:
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts or not all(part.isdigit() and int(part) for part in parts):
        raise DeclarationError(
            "these are no whole numbers",
            path=f"registers.{name}",
            expected="numbers from 1 on, between commas",
            got=repr(text),
            fix=f"write --set {name}=10,100",
        )
    return [int(part) for part in parts]


def _played(
    pipeline: Pipeline, tape: Tape, cells: list[Any], seed: np.ndarray, fractions: list[Any] | None
) -> tuple[list[np.ndarray], list[Any]]:
    """The decisions of each event, and the largest that each real register was; particles are taken
    together."""
    player = Interpreter(pipeline, cells, np.dtype(np.float64), seed)
    kept = [c for r in pipeline.registers for c in r.cells]
    rows = [zip(*s.leaves.values(), strict=True) for s in tape.series]
    out = next(k for k, port in enumerate(pipeline.outputs) if port.name == "ancestors")
    decided: list[np.ndarray] = []
    sizes: list[Any] = [None] * len(kept)
    for time, key in zip(tape.time.tolist(), tape.key.tolist(), strict=True):
        values = [next(row) for k, row in enumerate(rows) if key >> k & 1]
        program, env = player.values(time, key, values)
        player.cells = [env[n] for n in program.writes]
        for k, (cell, x) in enumerate(zip(kept, player.cells, strict=True)):
            if cell.dtype != "real":
                continue
            if fractions is not None:
                player.cells[k] = _rounded(x, fractions[k])
                continue
            alike = tuple(a for a, name in enumerate(cell.axes) if name == "particles")
            size = np.abs(x).max(axis=alike, keepdims=True) if alike else np.abs(x)
            sizes[k] = size if sizes[k] is None else np.maximum(sizes[k], size)
        flag, leaves = program.outputs[out]
        if flag is not None and env.get(flag, True):
            decided.append(np.concatenate([np.ravel(env[n]).astype(np.int64) for n in leaves]))
    return decided, sizes


def _rounded(x: Any, fraction: np.ndarray) -> Any:
    return np.ldexp(np.floor(np.ldexp(x, fraction.astype(int)) + 0.5), -fraction.astype(int))
