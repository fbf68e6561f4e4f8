"""How many bits of a machine change in a tick: what its energy goes with, counted in Verilator.

A circuit takes energy where a wire changes. Every bit of every signal that does is counted, which weighs a
long wire like a short one and leaves out what happens inside block memories: an estimate, to compare machines
of one kind by, and no number of joules.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import put
from flowgraph.data.tape import Tape
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.script import Script
from flowgraph.engines.verilog.simulate import made, verilator
from flowgraph.engines.verilog.text import texts

_FLAGS = "--coverage-toggle --coverage-max-width 4096"


def toggles(image: Image, tape: Tape, cells: list[Any], seed: np.ndarray) -> float:
    """The bits that change in a mean tick, with the host's writing and reading.

    Args:
        image: the machine.
        tape: ticks, and the events of each input.
        cells: register cells before the first.
        seed: (2,) uint32.

    Raises:
        MissingDependencyError: where there is no Verilator.
    """
    with tempfile.TemporaryDirectory(prefix="flowgraph-toggles-") as folder:
        at = Path(folder)
        for name, text in texts(image).items():
            put(at / name, text)
        put(at / "script", "\n".join(Script(image, tape, cells, seed, False).lines) + "\n")
        program = f"obj/V{image.pipeline.name}"
        made(at, program, f"{verilator()} {_FLAGS}")
        subprocess.run([str(at / program), "script"], cwd=at, capture_output=True, check=True)
        return counted((at / "coverage.dat").read_text()) / max(len(tape.time), 1)


def counted(coverage: str) -> int:
    """The sum of the counts of toggles in what Verilator has written."""
    return sum(int(line.rsplit(" ", 1)[1]) for line in coverage.splitlines() if "v_toggle" in line)
