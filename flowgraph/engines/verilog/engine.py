"""The engine `verilog`: the pipeline as a microcoded machine in Verilog, played in Verilator."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from flowgraph.data.files import put
from flowgraph.data.inputs import Inputs
from flowgraph.engines.contract import PipelineEngine, Player
from flowgraph.engines.fixed.engine import need_formats
from flowgraph.engines.fixed.files import patterns_with_formats
from flowgraph.engines.pipeline_inputs import events_of
from flowgraph.engines.verilog.driver import Driver, events_text
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.script import Script
from flowgraph.engines.verilog.simulate import Simulated, verilator
from flowgraph.engines.verilog.text import texts
from flowgraph.errors import writes
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.random import seed_words


class VerilogEngine(PipelineEngine):
    """Registers, multipliers and block memory, clock by clock; equal to the engine `fixed` to the bit."""

    name = "verilog"
    dtypes = ("fixed", "float64")  # the second is what a user gets who leaves dtype out
    writes = True

    def need(self) -> None:
        verilator()

    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        pipeline.need_numbers("fixed")
        return Simulated(need_formats(pipeline), patterns)

    def write(
        self, pipeline: Pipeline, folder: Path, dtype: str, passes: Collection[str]
    ) -> Mapping[str, Path]:
        image = _image(pipeline)
        driver = Driver(image)
        written = texts(image) | driver.texts()
        written["Makefile"] += driver.make()
        found = {}
        for name, text in written.items():
            found[name] = folder / name
            with writes(found[name]):
                folder.mkdir(parents=True, exist_ok=True)
                put(found[name], text)
        return found

    def write_events(self, pipeline: Pipeline, inputs: Inputs | Mapping[str, Any], file: Path) -> int:
        """Write the script that the bench plays: each tick, with the interpreter's words to compare.

        Beside it, in FILE.host, lie the numbers of the inputs, for the driver.
        """
        tape = events_of(pipeline, inputs)
        cells = [c.reset for r in pipeline.registers for c in r.cells]
        script = Script(_image(pipeline), tape, cells, seed_words(0), check=True)
        with writes(file):
            put(file, "\n".join(script.checked()) + "\n")
            put(file.with_name(f"{file.name}.host"), events_text(tape))
        return len(tape.time)


def _image(pipeline: Pipeline) -> Image:
    """The machine with all patterns of present inputs that have formats."""
    known, _ = patterns_with_formats(need_formats(pipeline))
    return Image(pipeline, known)


ENGINE = VerilogEngine()
