"""Studies: a thousand seeds of one filter, against a process pool over the same filter in filterpy.

Both make each flight, filter it and score it, in two processes; ours to a table on disk, its processes
started and its program compiled within the time that counts. Of the peer's runs only a sample is done,
after one a process that is not counted.
"""

from __future__ import annotations

import resource
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import Series, find_graph, load_flight, simulate
from flowgraph.blocks.extended import PoseBelief, start_pose
from flowgraph.blocks.metrics import pose_errors
from flowgraph.study import Study, run_study
from tests.bench import direct_ekf
from tests.bench.rows import Row

WORKERS = 2
FACTOR = 20.0  # what `ekf` puts on the densities of a unit whose biases walk


def with_filterpy(seed: int, duration: float) -> dict[str, float]:
    """One run of the peer: the flight, the filter, the errors."""
    flight = load_flight("sim", seed=seed, settings={"duration": repr(duration)})
    imu, vicon, noise = flight.streams["imu"], flight.streams["vicon"], flight.info["imu_noise"]
    found = direct_ekf.run(
        imu,
        vicon,
        start=start_pose(vicon["position"][0], vicon["attitude"][0]),
        densities=(FACTOR * noise.gyro, FACTOR * noise.accelerometer),
        position_noise=flight.info["position_noise"],
        attitude_noise=flight.info["attitude_noise"],
    )
    assert flight.truth is not None
    return pose_errors(Series(imu.time, PoseBelief(**found)), flight.truth, settle=1.0)


def _timed(seed: int, duration: float) -> float:
    start = perf_counter()
    with_filterpy(seed, duration)
    return perf_counter() - start


def check(duration: float) -> None:
    """The peer's errors are those of `ekf`."""
    flight = load_flight("sim", seed=5, settings={"duration": repr(duration)})
    case = find_graph("ekf").case(flight)
    ours = case.score(simulate(case.graph, case.inputs, engine="reference", seed=5))
    peer = with_filterpy(5, duration)
    for name, value in ours.items():
        np.testing.assert_allclose(peer[name], value, rtol=1e-5, err_msg=name)


def seeds_of_ekf(*, runs: int = 1000, sample: int = 16, duration: float = 20.0, chunk: int = 50) -> list[Row]:
    """Runs a second of a whole study in XLA, and of a process pool over filterpy; taken in turn."""
    name = f"{runs:,} seeds of ekf, {duration:g} s, {WORKERS} processes"
    check(duration)
    study = Study(
        graphs=["ekf"], data=["sim"], seeds=runs, engine="xla", chunk=chunk, parameters={"duration": duration}
    )
    before = _pool(sample, duration)
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        done = run_study(study, folder, workers=WORKERS)
        ours = runs / (perf_counter() - start)
    assert not done.failed
    after = _pool(sample, duration)  # before and after, for the speed of a shared machine drifts
    peer = 0.5 * (before + after)
    spent: dict[str, Any] = {
        n: float(np.mean([r[n] for r in done.rows])) for n in ("load_s", "setup_s", "run_s", "score_s")
    }
    spent |= {"peer_before": before, "peer_after": after}
    ratio = ours / peer
    against = f"filterpy in a process pool, from 2 x {sample} runs"
    return [Row(name, ours, peer, "runs/s", against, ratio, "ratio >= 50", ratio >= 50.0, spent)]


def _pool(sample: int, duration: float) -> float:
    """Runs a second of the peer in as many processes, once they are warm."""
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        list(pool.map(_timed, range(WORKERS), [min(duration, 1.5)] * WORKERS))
        start = perf_counter()
        list(pool.map(_timed, range(sample), [duration] * sample))
        return sample / (perf_counter() - start)


def memory_of_particles(*, runs: int = 10_000, fewer: int = 500, duration: float = 20.0) -> list[Row]:
    """Peak memory of many seeds of `rbpf_indoor`, and the cost of a run beside that in a smaller study."""
    small, _ = _particles(fewer, duration)
    cost, peak = _particles(runs, duration)
    name = f"{runs:,} seeds of rbpf_indoor, N = 100"
    against = f"a study of {fewer:,}"
    return [
        Row(f"{name}: memory", peak, None, "MiB", "none: a bound", None, "ours < 2048 MiB", peak < 2048.0),
        Row(f"{name}: cost of a run", cost, small, "ms", against, cost / small, "ratio <= 1.2",
            cost <= 1.2 * small),
    ]  # fmt: skip


def _particles(runs: int, duration: float) -> tuple[float, float]:
    """Milliseconds a run, and the largest peak of any process in MiB."""
    study = Study(
        graphs=["rbpf_indoor"], data=["sim"], seeds=runs, engine="xla",
        parameters={"particles": 100, "duration": duration},
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        assert not run_study(study, folder, workers=WORKERS).failed
        spent = 1e3 * (perf_counter() - start) / runs
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return spent, max(resource.getrusage(k).ru_maxrss for k in kinds) / 1024
