"""`python -m tests.kills --count 100`: kill -9 at random moments of writing, and what is left then.

A process writes without end: a checkpoint over the last one, a pipeline into new folders, the runs of a
study, libraries into the compile cache. It is killed after a random time; then what is there must be whole,
the same work must go on to its end, and after that nothing may lie beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

_GRAPH = """
import sys
import numpy as np
from pathlib import Path
from flowgraph import *
class V(Signal):
    v: Array = real(SIZE)
@graph
def g(a: Stream[V]): return a.delay(V(np.zeros(SIZE))).at(a)
folder = Path(sys.argv[1]); once = len(sys.argv) > 2
"""
_STATE = (
    _GRAPH.replace("SIZE", "200_000")
    + """
r = Run(g.build()); k = 0
while True:
    r.push(k, a=V(np.full(200_000, float(k)))); k += 1
    save_state(r.state, folder / "state.npz"); print(k, flush=True)
    if once: break
"""
)
_PIPELINE = (
    _GRAPH.replace("SIZE", "2_000")
    + """
p = lower(g.build())
while True:
    for n in range(1 if once else 100):
        p.save(folder / f"p{n}"); print(n, flush=True)
        if not once and n > 2:
            for old in (folder / f"p{n - 2}").iterdir(): old.unlink()
    if once:
        for one in folder.iterdir(): p.save(one)
        break
"""
)
_STUDY = """
import sys
from flowgraph.study import Study, run_study
from flowgraph.study.execution import Watcher
class Says(Watcher):
    def row(self, row): print("run", flush=True)
study = Study(graphs=["ekf"], data=["sim"], seeds=24, parameters={"duration": [1.0]}, keep=True)
found = run_study(study, sys.argv[1], watcher=Says())
assert len(found.rows) == 24 and not found.failed, found.failed[:1]
"""
_COMPILE = """
import os, sys
os.environ["FLOWGRAPH_CACHE"] = sys.argv[1]
from flowgraph.engines.c.compile import load
k = 0
once = len(sys.argv) > 2
while True:
    k += 1
    which = k % 5 + 5 * (once and k > 5)  # the last is compiled by nobody before: who compiles sweeps
    text = "".join(f"double f{n}(double x) {{ return x * {n}.5 + {which}; }}\\n" for n in range(60))
    assert load({"a.c": text}).f1 is not None; print(k, flush=True)
    if once and k > 5: break
"""


def _whole_state(folder: Path) -> None:
    from flowgraph import load_state

    if (folder / "state.npz").exists():
        load_state(folder / "state.npz")


def _whole_pipelines(folder: Path) -> None:
    from flowgraph import Pipeline

    for file in folder.glob("p*/pipeline.json"):
        Pipeline.load(file)
    for file in folder.glob("p*/pipeline.txt"):
        assert file.read_text().endswith("\n"), f"{file} is half"


def _whole_study(folder: Path) -> None:
    from flowgraph.study.store import RUNS, Store, read_trajectory

    file = folder / RUNS
    whole = file.read_bytes().rpartition(b"\n")[0].splitlines() if file.exists() else []
    kept = Store(folder).read(json.loads(line)["key"] for line in whole)
    assert len(kept) == len(whole), f"a line of {file} is half"
    for file in folder.glob("trajectories/*.npz"):
        read_trajectory(file)


def _whole_libraries(folder: Path) -> None:
    from flowgraph.engines.c.compile import _is_whole

    for file in folder.glob("*.so"):
        assert _is_whole(file), f"{file} is half"


KINDS: Mapping[str, tuple[str, Callable[[Path], None], float]] = {
    "save_state": (_STATE, _whole_state, 0.3),
    "Pipeline.save": (_PIPELINE, _whole_pipelines, 0.3),
    "batch": (_STUDY, _whole_study, 0.6),
    "compile": (_COMPILE, _whole_libraries, 0.6),
}
"""What writes, what looks whether all is whole, and s within which it is killed after it has begun."""


def killed(kind: str, rng: random.Random) -> str | None:
    """One process, killed at a random moment: what was wrong afterwards."""
    code, check, span = KINDS[kind]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "work"
        folder.mkdir()
        line = [sys.executable, "-c", code, str(folder)]
        process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(rng.random() * span)
        process.kill()
        _, said = process.communicate()
        if process.returncode != -signal.SIGKILL and (kind != "batch" or process.returncode):
            return f"it ended by itself with {process.returncode}: {said[-300:]}"
        try:
            check(folder)
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        again = subprocess.run([*line, "once"], capture_output=True, text=True, check=False)
        if again.returncode:
            return f"it does not go on: {again.stderr[-300:]}"
        check(folder)
        left = [f for _, folders, files in os.walk(folder) for f in (*folders, *files)]
        left = [f for f in left if f.endswith((".part", ".lock")) or f.startswith("work-")]
        return f"left behind: {', '.join(left)}" if left else None


def run(count: int, seed: int) -> dict[str, Any]:
    """`count` kills, the kinds in turn."""
    rng = random.Random(seed)
    kinds = list(KINDS)
    failed = []
    for number in range(count):
        kind = kinds[number % len(kinds)]
        wrong = killed(kind, rng)
        if wrong is not None:
            failed.append({"number": number, "kind": kind, "wrong": wrong})
    return {"killed": count, "failed": len(failed), "seed": seed, "kinds": kinds, "failures": failed}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="processes to kill")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args(arguments)
    found = run(given.count, given.seed)
    if given.json:
        print(json.dumps(found, indent=1))
    else:
        for one in found["failures"]:
            print(f"{one['number']}, {one['kind']}: {one['wrong']}")
        print(f"{found['killed']} killed, {found['failed']} failed, seed {found['seed']}")
    return int(found["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
