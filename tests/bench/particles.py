"""One tick of `rbpf_indoor`, and its parts, beside a hand-written NumPy loop and the particle libraries.

The hand-written loop (`direct_rbpf.py`) has the same equations, layout and random numbers; its poses and the
indices it resamples with must be those of the engines before anything is timed.

The library filters with something simpler: nine plain states (position, velocity and acceleration of a point
in space, constant acceleration), a measured position at each step, a bootstrap proposal, and systematic
resampling. Beside it, `rbpf_indoor` gets a measured pose at each tick. `bootstrap` has one on both.
A library that is not installed gives a row without a peer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import datetime, timedelta
from importlib import import_module
from typing import Any

import numpy as np

from flowgraph import Case, Result, simulate
from flowgraph.blocks.flights import simulated
from flowgraph.blocks.particles.cloud import start_cloud
from flowgraph.blocks.particles.resampling import SCHEMES, quantised
from flowgraph.graphs.rbpf_indoor import rbpf_indoor
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.random import NumpyDraw, seed_words
from tests.bench import direct_eskf, direct_rbpf
from tests.bench.bootstrap import JERK, SEEN, START_SPREAD, STEP_S, plain_model
from tests.bench.rows import Row, interleaved, missing, seconds, worked

SIZES = (100, 1000, 10_000)
SEED = seed_words(0)
LIMIT_MS = 0.6
"""At most, in XLA with 1,000 particles."""


def case(particles: int, duration: float, **settings: float) -> tuple[Case, dict[str, Any]]:
    """The filter on a simulated flight, and the arguments of the hand-written loop."""
    flight = simulated.load(settings={"duration": duration, **settings})
    built = rbpf_indoor.case(flight, particles=particles, covariance=False, still=1.0)
    imu, vicon = flight.streams["imu"], flight.streams["vicon"]
    start = start_cloud(particles, position=vicon.position[0])
    noise = flight.info["imu_noise"].scaled(gyro=3.0, accelerometer=2.0)  # as the case does
    time, imu_index, pose_index = direct_eskf.ticks(imu.time, vicon.time)
    direct = {
        "time": time,
        "imu_index": imu_index,
        "pose_index": pose_index,
        "imu": np.concatenate([imu.gyro, imu.specific_force], axis=1),
        "poses": np.concatenate([vicon.position, vicon.attitude], axis=1),
        "start": direct_rbpf.Cloud(*vars(start).values()),
        "seed": 0,
        "gyro_noise": noise.gyro,
        "accelerometer_noise": noise.accelerometer,
        "position_noise": flight.info["position_noise"],
        "attitude_noise": flight.info["attitude_noise"],
        "resample_below": 0.5,
        "still": 1.0,
    }
    return built, direct


def check(result: Result, by_hand: direct_rbpf.History) -> None:
    """Fail unless an engine and the hand-written loop agree on poses and on which particles live on."""
    pose, ancestors = result["pose"], result["ancestors"]
    found = np.concatenate([pose[name] for name in ("position", "velocity", "attitude")], axis=1)
    np.testing.assert_allclose(found, by_hand.poses, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(ancestors["resampled"], by_hand.resampled)
    np.testing.assert_array_equal(ancestors["index"], by_hand.index)


def engines(*, sizes: tuple[int, ...] = SIZES, duration: float = 2.55, repeats: int = 7) -> list[Row]:
    """Milliseconds a tick, draws included: the whole `simulate` call in Python, the compiled loop in XLA."""
    rows = []
    for n in sizes:
        built, direct = case(n, duration)
        by_hand = direct_rbpf.run(**direct)
        ticks = len(by_hand.poses)
        run = lambda engine, case=built: simulate(case.graph, case.inputs, engine=engine)  # type: ignore[misc]
        peer = lambda args=direct, ticks=ticks: (  # type: ignore[misc]
            seconds(lambda: direct_rbpf.run(**args)) * 1e3 / ticks
        )
        python = lambda run=run, ticks=ticks: seconds(lambda: run("python")) * 1e3 / ticks  # type: ignore[misc]
        check(run("python"), by_hand)
        ours, other, ratio = interleaved(python, peer, repeats)
        bound, met = "ratio <= 1.2", ratio <= 1.2
        name = f"rbpf_indoor, {n:,} particles"
        rows.append(Row(f"{name}, python", ours, other, "ms/tick", "direct NumPy", ratio, bound, met))
        xla = lambda run=run, ticks=ticks: run("xla").wall_s * 1e3 / ticks  # type: ignore[misc]
        check(run("xla"), by_hand)
        ours, other, ratio = interleaved(xla, peer, repeats)
        limit = (f"ours <= {LIMIT_MS} ms", ours <= LIMIT_MS) if n == 1000 else ()
        rows.append(Row(f"{name}, xla", ours, other, "ms/tick", "direct NumPy", ratio, *limit))
    return rows


# What the libraries filter.


def with_stone_soup(n: int, steps: int) -> Callable[[], np.ndarray]:
    """The plain filter of Stone Soup: the estimate (9) after the last step."""
    part = lambda name: import_module(f"stonesoup.{name}")
    transition = part("models.transition.linear")
    model = transition.CombinedLinearGaussianTransitionModel([transition.ConstantAcceleration(JERK**2)] * 3)
    _, _, _, _, seen = plain_model(steps)
    sensor = part("models.measurement.linear").LinearGaussian(9, (0, 3, 6), SEEN**2 * np.eye(3))
    resampling = part("resampler.particle")
    resampler = resampling.ESSResampler(threshold=n / 10, resampler=resampling.SystematicResampler())
    predictor = part("predictor.particle").ParticlePredictor(model)
    updater = part("updater.particle").ParticleUpdater(sensor, resampler)
    start = datetime(2000, 1, 1)
    spread = START_SPREAD * np.random.default_rng(1).normal(size=(9, n))
    vectors = part("types.array").StateVectors
    detection, hypothesis = part("types.detection").Detection, part("types.hypothesis").SingleHypothesis
    detections = [
        detection(z[:, None], timestamp=start + timedelta(seconds=STEP_S * (k + 1)), measurement_model=sensor)
        for k, z in enumerate(seen)
    ]

    def run() -> np.ndarray:
        log_weight = np.full(n, -math.log(n))
        now = part("types.state").ParticleState(vectors(spread), log_weight=log_weight, timestamp=start)
        for z in detections:
            now = updater.update(hypothesis(predictor.predict(now, timestamp=z.timestamp), z))
        return np.asarray(now.mean, dtype=float).reshape(9)

    return run


LIBRARIES: dict[str, tuple[str, Callable[[int, int], Callable[[], np.ndarray]]]] = {
    "Stone Soup": ("stonesoup", with_stone_soup),
}


def libraries(*, sizes: tuple[int, ...] = SIZES, steps: int = 100, repeats: int = 5) -> list[Row]:
    """Milliseconds a step of `rbpf_indoor` in Python, with a pose at each, and of the libraries' filters."""
    rows = []
    for n in sizes:
        built, direct = case(n, (steps - 1) * STEP_S, **{"vicon.rate": 1.0 / STEP_S})
        check(simulate(built.graph, built.inputs), direct_rbpf.run(**direct))
        truth = plain_model(steps)[3][-1]
        ours = lambda built=built: (  # type: ignore[misc]
            seconds(lambda: simulate(built.graph, built.inputs)) * 1e3 / steps
        )
        name = f"rbpf_indoor, {n:,} particles, a pose a tick"
        for library, (module, make) in LIBRARIES.items():
            try:
                import_module(module)
            except ImportError as error:
                rows.append(missing(name, ours(), "ms/step", library, error))
                continue
            run = make(n, steps)
            assert np.abs(run() - truth)[::3].max() < 10.0 * SEEN, library
            peer = lambda run=run: seconds(run) * 1e3 / steps  # type: ignore[misc]
            against = f"{library}, 9 plain states, a position a step"
            mine, other, ratio = interleaved(ours, peer, repeats)
            rows.append(Row(name, mine, other, "ms/step", against, ratio))
    return rows


def resampling(*, sizes: tuple[int, ...] = SIZES, repeats: int = 15) -> list[Row]:
    """Microseconds of work of a systematic resampling in NumPy, draw included, beside filterpy's loop."""
    rows = []
    for n in sizes:
        weight = np.random.default_rng(n).exponential(size=n) ** 3
        weight /= weight.sum()
        name = f"systematic resampling of {n:,}, python"

        def ours(time: int = 0, weight: np.ndarray = weight) -> np.ndarray:
            draw = NumpyDraw("bench", SEED, time)
            parts = quantised(weight, xp=NUMPY)
            return np.asarray(SCHEMES["systematic"](parts, draw=draw, xp=NUMPY))

        calls = max(1, 20_000 // n)
        mine = lambda ours=ours, calls=calls: (  # type: ignore[misc]
            worked(lambda: [ours(k) for k in range(calls)]) * 1e6 / calls
        )
        try:
            theirs = import_module("filterpy.monte_carlo").systematic_resample
        except ImportError as error:
            rows.append(missing(name, mine(), "us", "filterpy", error))
            continue
        for found in (
            ours(),
            theirs(weight),
        ):  # each draws its own place; copies are the weight's, within one
            copies = np.bincount(found, minlength=n)
            assert np.all(np.abs(copies - n * weight) < 1.0 + 1e-6)
        peer = lambda theirs=theirs, weight=weight, calls=calls: (  # type: ignore[misc]
            worked(lambda: [theirs(weight) for _ in range(calls)]) * 1e6 / calls
        )
        figures = interleaved(mine, peer, repeats)
        met = figures[2] <= 1.0
        rows.append(
            Row(name, *figures[:2], "us", "filterpy.systematic_resample", figures[2], "ratio <= 1", met)
        )
    return rows
