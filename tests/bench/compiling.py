"""What it takes to make a compiled filter: the seven patterns of inputs of `ins_eskf`.

The peer is the plainest way: a reaction for each pattern, in one file, with the whole of `-O3`. All times are
of the processor, of the compiler's processes too.
"""

from __future__ import annotations

import os
import resource
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from flowgraph import lower
from flowgraph.blocks.flights import simulated
from flowgraph.engines.c import file
from flowgraph.engines.c.compile import FLAGS, LANES, build
from flowgraph.engines.c.loop import loop_text
from flowgraph.engines.c.patterns import Pattern
from flowgraph.engines.c.source import Source, generate
from flowgraph.engines.c.units import units
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.pipeline.optimise import COMPILED, optimise
from flowgraph.pipeline.pipeline import Pipeline
from tests.bench.rows import Row, interleaved, worked


def rows(*, repeats: int = 5) -> list[Row]:
    """Seconds to write the C, and to compile it."""
    pipeline = lower(ins_eskf.case(simulated.load(settings={"duration": 1.0})).graph)
    mine = written(pipeline)
    ours = {f"{mine.names.module}.h": mine.header, **units(mine), "fg_loop.c": loop_text(pipeline, mine)}
    with _apart():
        plain = written(pipeline)
        module = plain.names.module
        peer = {f"{module}.h": plain.header, f"{module}.c": plain.source}
        peer["fg_loop.c"] = loop_text(pipeline, plain)
    assert (len(mine.reactions), len(plain.reactions)) == (4, 7)
    name, against = "ins_eskf, 7 patterns", "a reaction a pattern"
    a, b, ratio = interleaved(
        lambda: worked(lambda: written(pipeline)), lambda: worked(lambda: _written_apart(pipeline)), repeats
    )
    made = [Row(f"writing C, {name}", a, b, "s", against, ratio)]
    a, b, ratio = interleaved(lambda: compiling(ours, FLAGS), lambda: compiling(peer, LANES), repeats)
    bound, met = "ratio <= 0.5", ratio <= 0.5
    return [*made, Row(f"compiling C, {name}", a, b, "s", f"{against}, one file, -O3", ratio, bound, met)]


def written(pipeline: Pipeline) -> Source:
    """As the engine writes it."""
    return generate(pipeline, tidy=lambda program: optimise(program, COMPILED), alone=False)


def _written_apart(pipeline: Pipeline) -> None:
    with _apart():
        written(pipeline)


@contextmanager
def _apart() -> Iterator[None]:
    with patch.object(file, "shared", lambda _, keys: [Pattern.of(key) for key in keys]):
        yield


def compiling(files: dict[str, str], flags: tuple[str, ...]) -> float:
    """The processor time of a compilation into an empty cache."""
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, {"FLOWGRAPH_CACHE": folder}):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        build(files, flags)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
