"""C++ for high-level synthesis on this computer: compiled by g++ with the headers of `ap_int`, and run."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.files import put
from flowgraph.data.tape import Tape
from flowgraph.engines.contract import Outcome, Player
from flowgraph.engines.hls.bench import bench_text, makefile_text, script
from flowgraph.engines.hls.source import HlsSource
from flowgraph.engines.options import Meter
from flowgraph.errors import MissingDependencyError
from flowgraph.pipeline.formats import real_numbers
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.types import DTYPES


def headers() -> Path:
    """The folder with `ap_int.h`.

    Raises:
        MissingDependencyError: where the package that ships it is not installed, or has it no more.
    """
    spec = find_spec("hls4ml")
    for place in (spec.submodule_search_locations or []) if spec is not None else []:
        found = Path(place) / "templates" / "vivado" / "ap_types"
        if (found / "ap_int.h").exists():
            return found
    raise MissingDependencyError(
        "C++ for high-level synthesis is compiled with the headers of ap_int",
        path='engine="hls"',
        expected="ap_int.h, as the package hls4ml ships it",
        got="no such package" if spec is None else "a version of hls4ml without it",
        fix="pip install 'flowgraph-filters[hardware]', or use engine=\"fixed\", which gives the same",
    )


def compiler() -> str:
    """The path of a C++ compiler.

    Raises:
        MissingDependencyError: where there is none, or no `make`.
    """
    found = next(filter(None, map(shutil.which, ("g++", "clang++", "c++"))), None)
    if found is not None and shutil.which("make") is not None:
        return found
    raise MissingDependencyError(
        "C++ for high-level synthesis is compiled here",
        path='engine="hls"',
        expected="g++, clang++ or c++, and make, on the PATH",
        got=f"the compiler {found or 'none'}, and make {shutil.which('make') or 'none'}",
        fix='install them (Debian: apt-get install g++ make), or use engine="fixed", which gives the same',
    )


def texts(source: HlsSource) -> dict[str, str]:
    """The files by their names."""
    name = source.names.module
    return {
        f"{name}_hls.cpp": source.text,
        f"{name}_hls.h": source.header,
        "bench.cpp": bench_text(source),
        "Makefile": makefile_text(name),
    }


class PlayedHls(Player):
    """Plays a pipeline in its formats, in compiled C++.

    Args:
        pipeline: with formats.
        patterns: of present inputs that come.
        check: whether each tick is compared with the interpreter's.

    Attributes:
        compared, differing: with `check`, words compared with the interpreter's, and those that differ.
    """

    def __init__(self, pipeline: Pipeline, patterns: Sequence[int], *, check: bool = False) -> None:
        self.pipeline, self.check = pipeline, check
        self.source = HlsSource(pipeline, patterns)
        self.compared = self.differing = 0
        self._folder = tempfile.TemporaryDirectory(prefix="flowgraph-hls-")
        self._at = Path(self._folder.name)
        for name, text in texts(self.source).items():
            put(self._at / name, text)
        command = ["make", "-s", f"AP_TYPES={headers()}", f"CXX={compiler()}"]
        done = subprocess.run(command, cwd=self._at, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} in {self._at}:\n{done.stderr[-4000:]}")

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        lines, player = script(self.source, tape, cells, seed, check=self.check)
        if self.check:
            lines = [x for line in lines for x in (("get", line) if line.startswith("is") else (line,))]
        put(self._at / "script", "\n".join(lines) + "\n")
        start = perf_counter()
        command = [str(self._at / "replay"), "script"]
        done = subprocess.run(command, cwd=self._at, capture_output=True, text=True, check=False)
        wall = perf_counter() - start
        said = dict(line.split() for line in done.stderr.split("\n") if len(line.split()) == 2)
        if "ticks" not in said:
            raise RuntimeError(f"{' '.join(command)}:\n{done.stderr[-4000:]}")
        self.compared += int(said["values_compared"])
        self.differing += int(said["values_differing"])
        rows: list[Iterator[int]] = [iter(map(int, line.split())) for line in done.stdout.split("\n")[:-1]]
        outputs = self._outputs(tape, rows)
        if rows:
            player.cells = [
                _words(rows[-1], c.shape, c.dtype) for r in self.pipeline.registers for c in r.cells
            ]
        stats = {"saturations": int(said["cut"]), "divisions_by_zero": int(said["by_zero"])}
        return Outcome(player.reals(), outputs, wall, stats | {"lost_bits": int(said["lost"])})

    def _outputs(self, tape: Tape, rows: list[Iterator[int]]) -> list[tuple[np.ndarray, list[np.ndarray]]]:
        """The outputs of all ticks; of each row the words of the registers are left."""
        ports = self.pipeline.outputs
        bounds = dict(zip(self.source.keys, self.source.bound, strict=True))
        found: list[tuple[list[int], list[list[Any]]]] = [([], [[] for _ in p.leaves]) for p in ports]
        for time, key, row in zip(tape.time.tolist(), tape.key.tolist(), rows, strict=True):
            bound = bounds[key]
            for (times, kept), port, (_, values) in zip(found, ports, bound.program.outputs, strict=True):
                if not next(row):
                    continue
                times.append(time)
                for column, leaf, n in zip(kept, port.leaves, values, strict=True):
                    x = _words(row, leaf.shape, leaf.dtype)
                    column.append(real_numbers(x, bound.fractions[n]) if leaf.dtype == "real" else x)
        return [
            (
                np.asarray(times, dtype=np.int64),
                [
                    np.asarray(column, dtype=DTYPES[leaf.dtype]).reshape(len(times), *leaf.shape)
                    for column, leaf in zip(kept, port.leaves, strict=True)
                ],
            )
            for (times, kept), port in zip(found, ports, strict=True)
        ]


def _words(row: Iterator[int], shape: tuple[int, ...], dtype: str) -> np.ndarray:
    found = np.array([next(row) for _ in range(int(np.prod(shape)))], dtype=np.int64).reshape(shape)
    return found if dtype == "real" else found.astype(DTYPES[dtype])
