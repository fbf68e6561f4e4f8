"""The engine `hls`: fixed point as C++ for high-level synthesis, compiled and run on this computer."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from flowgraph.data.files import put
from flowgraph.data.inputs import Inputs
from flowgraph.engines.contract import PipelineEngine, Player
from flowgraph.engines.fixed.engine import need_formats
from flowgraph.engines.fixed.files import patterns_with_formats
from flowgraph.engines.hls.bench import script
from flowgraph.engines.hls.play import PlayedHls, compiler, headers, texts
from flowgraph.engines.hls.source import HlsSource
from flowgraph.engines.pipeline_inputs import events_of
from flowgraph.errors import writes
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.random import seed_words


class HlsEngine(PipelineEngine):
    """Words of `ap_int`, compiled by g++; equal to the engine `fixed` to the bit."""

    name = "hls"
    dtypes = ("fixed", "float64")  # the second is what a user gets who leaves dtype out
    writes = True

    def need(self) -> None:
        compiler()
        headers()

    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        pipeline.need_numbers("fixed")
        return PlayedHls(need_formats(pipeline), patterns)

    def write(
        self, pipeline: Pipeline, folder: Path, dtype: str, passes: Collection[str]
    ) -> Mapping[str, Path]:
        found = {}
        for name, text in texts(_source(pipeline)).items():
            found[name] = folder / name
            with writes(found[name]):
                folder.mkdir(parents=True, exist_ok=True)
                put(found[name], text)
        return found

    def write_events(self, pipeline: Pipeline, inputs: Inputs | Mapping[str, Any], file: Path) -> int:
        """Write the script that the bench plays: each tick, with the interpreter's words to compare."""
        tape = events_of(pipeline, inputs)
        cells = [c.reset for r in pipeline.registers for c in r.cells]
        lines, _ = script(_source(pipeline), tape, cells, seed_words(0), check=True)
        with writes(file):
            put(file, "\n".join(lines) + "\n")
        return len(tape.time)


def _source(pipeline: Pipeline) -> HlsSource:
    """The C++ with all patterns of present inputs that have formats."""
    known, _ = patterns_with_formats(need_formats(pipeline))
    return HlsSource(pipeline, known)


ENGINE = HlsEngine()
