"""How long a program waits for flowgraph: for its import beside NumPy's, and for the first tick of a filter.

Each is measured in a fresh process, whose compiled modules are kept in a folder of this bench's own: whether
the machine lets Python keep them is not what is asked here.
"""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from statistics import median
from tempfile import TemporaryDirectory

from tests.bench.rows import Row, interleaved, seconds

LIMIT_S = 0.06
FIRST_TICK_S = 0.5

DECLARE = "from flowgraph import Scalar, Signal, Stream, block, graph, latest, real"
FIRST_TICK = """
import numpy as np
import flowgraph as fg
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu, Position
from flowgraph.graphs.ins_eskf import ins_eskf
up = np.array([0.0, 0.0, 9.81])
start = start_belief(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), specific_force=up, spread=StartSpread())
built = ins_eskf.build(
    imu=fg.periodic("5ms"), position=fg.periodic("250ms"), start=start,
    noise=ImuNoise(1e-3, 1e-2, 1e-5, 1e-4), position_noise=0.01,
)
run = fg.Run(built)
run.push(0, imu=Imu(gyro=np.zeros(3), specific_force=up), position=Position(position=np.zeros(3)))
assert run.ticks == 1
"""


def seconds_of(program: str, *, before: str = "pass") -> float:
    """Seconds that lines take in a process of its own, after those `before`, without the start of Python."""
    clock = "from time import perf_counter as now"
    return float(_python("-c", f"{clock}\n{before}\n_began = now()\n{program}\nprint(now() - _began)").stdout)


def heaviest(module: str, count: int) -> list[dict[str, object]]:
    """The modules whose own code takes longest when `module` is imported."""
    found = []
    for line in _python("-X", "importtime", "-c", f"import {module}").stderr.splitlines():
        parts = line.removeprefix("import time:").split("|")
        if len(parts) == 3 and parts[0].strip().isdigit():
            own, total, name = (part.strip() for part in parts)
            found.append({"module": name, "own_ms": int(own) / 1e3, "total_ms": int(total) / 1e3})
    return sorted(found, key=lambda m: -float(str(m["own_ms"])))[:count]


def import_time(*, repeats: int = 9) -> list[Row]:
    """What the import adds to NumPy's, what the language does, and how long a first tick takes."""
    numpy = lambda: seconds_of("import numpy")
    adds = lambda program: lambda: seconds_of(program, before="import numpy")
    bare = median(seconds(lambda: _python("-c", "pass")) for _ in range(repeats))
    rows = []
    for name, program, limit in (
        ("import flowgraph, after NumPy", "import flowgraph", LIMIT_S),
        ("names to declare a graph, after NumPy", DECLARE, None),
    ):
        ours, peer, ratio = interleaved(adds(program), numpy, repeats)
        bound = None if limit is None else f"ours < {limit} s"
        met = None if limit is None else ours < limit
        against = f"import numpy (bare Python process: {bare:.3f} s)"
        heavy = {"bare_process_s": bare, "heaviest_modules": heaviest("flowgraph.language", 15)}
        rows.append(Row(name, ours, peer, "s", against, ratio, bound, met, heavy))
    ours, peer, ratio = interleaved(lambda: seconds_of(FIRST_TICK), numpy, repeats)
    name, bound = "first tick of ins_eskf, python", f"ours <= {FIRST_TICK_S} s"
    return [*rows, Row(name, ours, peer, "s", "import numpy", ratio, bound, ours <= FIRST_TICK_S)]


@cache
def _compiled() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="flowgraph-bench-")


def _python(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = _compiled().name
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=True, env=environment
    )
