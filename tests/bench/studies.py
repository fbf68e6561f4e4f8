"""Studies: a thousand seeds of one filter, against a process pool over the same filter in filterpy.

There are two comparisons. In the first both are given the recorded flights and are warm: `recorded` says
what is within the time that counts. In the second both make each flight, filter it and score all of it; ours
is the whole study, to a table on disk, planned and its program lowered and loaded within the time that
counts. Of the peer's runs only a sample is done.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import Flight, Series, find_graph, load_flight, simulate, simulate_many
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.pose import start_pose
from flowgraph.blocks.signals import PoseBelief
from flowgraph.study import Study, run_study
from tests.bench import direct_ekf
from tests.bench.rows import Row, interleaved, seconds

WORKERS = 2
FACTOR = 20.0  # what `ekf` puts on the densities of a unit whose biases walk


def flight_of(seed: int, duration: float) -> Flight:
    """The recording of a run."""
    return load_flight("sim", seed=seed, settings={"duration": repr(duration)})


def with_filterpy(flight: Flight) -> Series:
    """One run of the peer."""
    imu, vicon, noise = flight.streams["imu"], flight.streams["vicon"], flight.info["imu_noise"]
    found = direct_ekf.run(
        imu,
        vicon,
        start=start_pose(vicon["position"][0], vicon["attitude"][0]),
        densities=(FACTOR * noise.gyro, FACTOR * noise.accelerometer),
        position_noise=flight.info["position_noise"],
        attitude_noise=flight.info["attitude_noise"],
    )
    return Series(imu.time, PoseBelief(**found))


def scored(seed: int, duration: float) -> dict[str, float]:
    """One run of the peer with all that a study does: the flight, the filter, the errors."""
    flight = flight_of(seed, duration)
    assert flight.truth is not None
    return pose_errors(with_filterpy(flight), flight.truth, settle=1.0)


def last_error(position: np.ndarray, attitude: np.ndarray, flight: Flight) -> tuple[float, float]:
    """How far the last pose is from the truth, in m and rad."""
    truth = flight.truth
    assert truth is not None
    off = float(np.linalg.norm(position[-1] - truth["position"][-1]))
    return off, float(geodesic_angle(attitude[-1:], truth["attitude"][-1:])[0])


_recorded: dict[int, Flight] = {}


def _record(seeds: range, duration: float) -> None:
    """In each process of the pool, before time counts: its flights."""
    _recorded.update({seed: flight_of(seed, duration) for seed in seeds})


def _filtered(seed: int) -> tuple[float, float]:
    flight = _recorded[seed]
    found = with_filterpy(flight)
    return last_error(found["position"], found["attitude"], flight)


def check(duration: float) -> None:
    """The peer's errors are those of `ekf`."""
    flight = flight_of(5, duration)
    case = find_graph("ekf").case(flight)
    ours = case.score(simulate(case.graph, case.inputs, engine="reference", seed=5))
    peer = scored(5, duration)
    for name, value in peer.items():
        np.testing.assert_allclose(value, ours[name], rtol=1e-5, err_msg=name)


def seeds_of_ekf(
    *, runs: int = 1000, sample: int = 16, duration: float = 20.0, chunk: int = 25, repeats: int = 3
) -> list[Row]:
    """Runs a second on recorded flights, and of whole studies, beside a process pool over filterpy."""
    check(duration)
    return [recorded(runs, sample, duration, chunk, repeats), whole(runs, sample, duration, chunk)]


def recorded(runs: int, sample: int, duration: float, chunk: int, repeats: int) -> Row:
    """Filter flights that are there: threads over one program in C, in turn with a pool over filterpy.

    Within the time of either, for each flight: its readings as they were recorded, where its filter starts,
    every tick of the same filter, the whole trajectory of position, velocity, attitude and covariance (9, 9)
    in memory, and from it how far off the last pose is, which is all that leaves. Ours checks the readings
    and merges their times as well; and in C it makes, but does not keep, the filter's other outputs.

    Outside it: making the flights, starting the pool and giving it its flights, compiling, and a first round
    of both. The flights differ in all their noise and in where they start, which is given as `init`. Before
    any time is taken the two must say the same of the sample.
    """
    flights = [flight_of(seed, duration) for seed in range(runs)]
    built = find_graph("ekf").case(flights[0]).graph

    def start(flight: Flight) -> dict[str, Any]:
        first = flight.streams["vicon"][0]
        return {"belief": start_pose(first.position, first.attitude)}

    def ours() -> list[tuple[float, float]]:
        found = []
        for first in range(0, runs, chunk):  # so that memory does not grow with the number of runs
            part = flights[first : first + chunk]
            seeds = range(first, first + len(part))
            batch = simulate_many(
                built,
                [f.streams for f in part],
                seeds,
                engine="c",
                init=[start(f) for f in part],
                keep=["belief"],
            )
            belief = batch["belief"]
            found += [last_error(belief.position[k], belief.attitude[k], f) for k, f in enumerate(part)]
        return found

    sample = min(sample, runs)
    context = get_context("spawn")
    with ProcessPoolExecutor(
        WORKERS, mp_context=context, initializer=_record, initargs=(range(sample), duration)
    ) as pool:
        peer = lambda: list(pool.map(_filtered, range(sample)))
        np.testing.assert_allclose(ours()[:sample], peer(), rtol=1e-5, atol=1e-7)
        a, b, ratio = interleaved(lambda: runs / seconds(ours), lambda: sample / seconds(peer), repeats)
    name = f"{runs:,} seeds of ekf, {duration:g} s, recorded, c"
    against = f"filterpy in {WORKERS} processes, {sample} runs a turn"
    return Row(name, a, b, "runs/s", against, ratio, "ratio >= 50", ratio >= 50.0)


def whole(runs: int, sample: int, duration: float, chunk: int) -> Row:
    """A study from nothing to its table, in C; what either spends on making flights is in it.

    Ours flies `sim`, where world, filter and score are one graph and start alike, in the process that leads
    and as many threads as there are processors; the peer's flights are the same, written down by the loader,
    whose share of a run is `peer_load_share`.
    """
    parameters = {"duration": duration, "start": "truth"}
    study = Study(
        graphs=["ekf"], data=["sim"], seeds=runs, engine="c", chunk=8 * chunk, parameters=parameters
    )
    before = _pool(sample, duration)
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        done = run_study(study, folder)
        spent = perf_counter() - start
    assert not done.failed
    after = _pool(sample, duration)  # before and after, for the speed of a shared machine drifts
    ours, peer = runs / spent, 0.5 * (before + after)
    parts: dict[str, Any] = {
        n: float(np.mean([r[n] for r in done.rows])) for n in ("load_s", "setup_s", "run_s", "score_s")
    }
    begun = perf_counter()
    flight_of(runs, duration)
    loaded = perf_counter() - begun
    scored(runs, duration)
    parts["peer_load_share"] = loaded / (perf_counter() - begun - loaded)
    parts |= {"peer_before": before, "peer_after": after}
    name = f"{runs:,} seeds of ekf, {duration:g} s, whole study, c"
    against = f"filterpy in {WORKERS} processes, from 2 x {sample} runs"
    return Row(name, ours, peer, "runs/s", against, ours / peer, details=parts)


def _pool(sample: int, duration: float) -> float:
    """Runs a second of the peer in as many processes, once they are warm."""
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        list(pool.map(scored, range(WORKERS), [min(duration, 1.5)] * WORKERS))
        return sample / seconds(lambda: list(pool.map(scored, range(sample), [duration] * sample)))
