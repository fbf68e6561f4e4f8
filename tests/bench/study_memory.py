"""What a study of many particle filters takes: memory of all its processes, and time a run, as it grows.

Each size is a process of its own that runs a whole study of `rbpf_indoor` with 100 particles, its workers
beside it. From outside the largest resident size that each of them has had is looked up twice a second, and
the peaks are added: what they share is counted twice, and they need not have been at one time, so the sum is
an upper bound. The cost of a run is the processor time of all of them, which a busy machine hardly changes.

`python -m tests.bench.study_memory RUNS SECONDS` does one study and prints what it measured, as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from os import times
from pathlib import Path
from time import perf_counter
from typing import Any

from flowgraph.study import Study, run_study
from tests.bench.rows import Row

WORKERS = 2
PARTICLES = 100
_LOOK_S = 0.5


def study(runs: int, duration: float) -> dict[str, float]:
    """One study from nothing to its table."""
    parameters = {"particles": PARTICLES, "duration": duration}
    made = Study(graphs=["rbpf_indoor"], data=["sim"], seeds=runs, engine="c", parameters=parameters)
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        done = run_study(made, folder, workers=WORKERS)
        spent = perf_counter() - start
    if done.failed or done.done != runs:
        raise AssertionError(f"{len(done.failed)} of {done.done} runs failed")
    worked = times()
    cpu = worked.user + worked.system + worked.children_user + worked.children_system
    return {"seconds": spent, "cpu_s": cpu, "ticks": float(done.rows[0]["ticks"])}


def measured(runs: int, duration: float) -> dict[str, Any]:
    """A study in a process of its own, with the sum of its processes' peaks in MiB."""
    command = [sys.executable, "-m", "tests.bench.study_memory", str(runs), repr(duration)]
    peaks: dict[int, int] = {}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        while True:
            peaks.update(_peaks(process.pid))
            try:
                out, _ = process.communicate(timeout=_LOOK_S)
                break
            except subprocess.TimeoutExpired:
                continue
    if process.returncode:
        raise RuntimeError(f"the study of {runs} runs ended with exit status {process.returncode}")
    return {**json.loads(out), "runs": runs, "peak_MiB": sum(peaks.values()) / 1024, "processes": len(peaks)}


def _peaks(root: int) -> dict[int, int]:
    """The largest resident size so far, in KiB, of a process and of all that it has started."""
    parents, sizes = {}, {}
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
        except (OSError, ValueError):  # it has just ended
            continue
        pid = int(status.parent.name)
        parents[pid] = int(lines["PPid"])
        sizes[pid] = int(lines.get("VmHWM", "0 kB").split()[0])
    found, more = {root}, True
    while more:
        children = {pid for pid, parent in parents.items() if parent in found} - found
        found, more = found | children, bool(children)
    return {pid: sizes[pid] for pid in found & sizes.keys()}


def rows(*, sizes: tuple[int, ...] = (500, 2000, 10_000), duration: float = 4.0) -> list[Row]:
    """Peak memory and cost of a run of each size; the cost beside that of the smallest."""
    if not Path("/proc/self/status").exists():
        raise RuntimeError("this bench reads the sizes of processes in /proc, which only Linux has")
    measured(2, duration)  # so that none of them has a compiler among its processes
    found = [measured(runs, duration) for runs in sizes]
    made = []
    floor = found[0]["peak_MiB"]
    for one in found:
        name = f"{one['runs']:,} seeds of rbpf_indoor, N = {PARTICLES}, {duration:g} s"
        last = one is found[-1]
        made.append(
            Row(f"{name}: peak memory of {one['processes']} processes", one["peak_MiB"], floor, "MiB",
                f"a study of {found[0]['runs']:,}", one["peak_MiB"] / floor, "ratio <= 1.25",
                one["peak_MiB"] <= 1.25 * floor, details=one)
        )  # fmt: skip
        speed = one["runs"] / one["seconds"]
        made.append(Row(f"{name}: speed", speed, None, "runs/s", "none: for information", None))
        cost, small = (1e3 * x["cpu_s"] / x["runs"] for x in (one, found[0]))
        beyond = zip(found[1:], found[:-1], strict=True)  # without what starting costs
        one["cpu_ms_of_a_further_run"] = [
            1e3 * (b["cpu_s"] - a["cpu_s"]) / (b["runs"] - a["runs"]) for b, a in beyond if b is one
        ]
        made.append(
            Row(f"{name}: cost of a run", cost, small, "CPU ms", f"a study of {found[0]['runs']:,}",
                cost / small, "ratio <= 1.1" if last else None, cost <= 1.1 * small if last else None)
        )  # fmt: skip
    return made


if __name__ == "__main__":
    print(json.dumps(study(int(sys.argv[1]), float(sys.argv[2]))))
