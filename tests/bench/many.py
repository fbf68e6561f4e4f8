"""Many runs of one filter in one batched call, against a call for each: time, and peak memory.

A run is a simulated flight of its own noise through `ins_eskf`. Each of the two ways has a process of its
own, so that its peak memory is its own. Of the separate calls only a sample is run, and its time is scaled.

`python -m tests.bench.many WAY RUNS SECONDS` does one of them and prints what it measured, as JSON.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import Graph, Series, simulate, simulate_many
from flowgraph.blocks.flights import simulated
from flowgraph.blocks.signals import Position
from flowgraph.engines.options import RUNS_AT_ONCE
from tests.bench import inertial
from tests.bench.rows import Row

KEPT = ("position", "attitude")
SAMPLE = 20


def case(runs: int, duration: float) -> tuple[Graph, list[dict[str, Series]]]:
    """The filter, and the inputs of each run: the same movement, another flight's noise."""
    built = inertial.case(duration)[0]
    inputs = []
    for seed in range(runs):
        streams = simulated.load(seed=seed, settings={"duration": duration}).streams
        vicon = streams["vicon"]
        position = Series(vicon.time, Position(position=vicon.position), name="position")
        inputs.append({"imu": streams["imu"], "position": position})
    return built, inputs


def batched(runs: int, duration: float, runs_at_once: int = RUNS_AT_ONCE) -> dict[str, Any]:
    """One call, compilation included; fails unless its last run is what a single call gives."""
    built, inputs = case(runs, duration)
    before = peak_bytes()
    start = perf_counter()
    batch = simulate_many(
        built,
        lambda seed: inputs[seed],
        range(runs),
        keep=[f"belief.{name}" for name in KEPT],
        runs_at_once=runs_at_once,
    )
    wall, peak = perf_counter() - start, peak_bytes()
    alone = simulate(built, inputs[runs - 1], engine="xla", seed=runs - 1)
    for name in KEPT:
        np.testing.assert_allclose(batch["belief"][name][runs - 1], alone["belief"][name], rtol=0, atol=1e-9)
    return {"seconds": wall, "loop_s": batch.wall_s, "peak": peak, "before": before, "ticks": batch.ticks}


def separate(runs: int, duration: float) -> dict[str, Any]:
    """A sample of single calls, after one that compiles; their time scaled to `runs`."""
    sample = min(SAMPLE, runs)
    built, inputs = case(sample, duration)
    simulate(built, inputs[0], engine="xla")
    before = peak_bytes()
    start = perf_counter()
    kept = []
    for seed in range(sample):
        belief = simulate(built, inputs[seed], engine="xla", seed=seed)["belief"]
        kept.append([belief[name] for name in KEPT])
    wall = (perf_counter() - start) * runs / sample
    return {"seconds": wall, "peak": peak_bytes(), "before": before, "sample": sample}


def peak_bytes() -> int:
    """The most memory that this process has had so far.

    On Linux `getrusage` would count what the parent had when it started this process, so the kernel's own
    high-water mark goes first.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def rows(*, runs: int = 1000, duration: float = 20.0) -> list[Row]:
    """Seconds and peak memory of one batched call, against single calls."""
    ours, peer = (_measured(way, runs, duration) for way in ("batched", "separate"))
    name = f"{runs:,} seeds of a {duration:g} s ins_eskf"
    against = f"{runs:,} simulate calls, from {peer['sample']} of them"
    details = {"batched": ours, "separate": peer, "runs_at_once": RUNS_AT_ONCE}
    speed, other = runs / ours["seconds"], runs / peer["seconds"]
    peak, beside = ours["peak"] / 2**20, peer["peak"] / 2**20
    alone = f"the process of {peer['sample']} simulate calls"
    return [
        Row(f"{name}: speed", speed, other, "runs/s", against, speed / other, details=details),
        Row(f"{name}: peak memory", peak, beside, "MiB", alone, peak / beside, details=details),
    ]


def _measured(way: str, runs: int, duration: float) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.bench.many", way, str(runs), str(duration)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


if __name__ == "__main__":
    work = {"batched": batched, "separate": separate}[sys.argv[1]]
    print(json.dumps(work(int(sys.argv[2]), float(sys.argv[3]))))
