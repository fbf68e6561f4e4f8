"""What the tests of the Kalman graphs share: noisy flights, the mean NEES of many runs, equal engines."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from flowgraph import Case, Flight, Graph, Result, lower, simulate
from flowgraph.blocks.flights import simulated
from flowgraph.blocks.flights.worlds import load_world
from flowgraph.blocks.metrics import nees, state_error
from flowgraph.data.batch import Runs

SENSORS = "imu,gps,gps2,altimeter,magnetometer,optical_flow"
"""Of the outdoor flights."""

THESIS = math.sqrt(0.1 / 200.0)
"""The density of a variance of 0.1 per sample at 200 Hz."""


@functools.cache
def thesis(seed: int, duration: float = 10.0, **settings: float) -> Flight:
    """A flight of the thesis; the motion capture keeps a clock of its own."""
    named = {name.replace("_", ".", 1): value for name, value in settings.items()}
    return load_world("thesis", seed=seed, settings={"duration": duration, **named})


@functools.cache
def smooth(seed: int, duration: float = 10.0) -> Flight:
    """A smooth flight with the noise of the thesis and no biases."""
    none = dict.fromkeys(("gyro.bias", "accelerometer.bias", "gyro.walk", "accelerometer.walk"), 0.0)
    noise = {"gyro.noise": THESIS, "accelerometer.noise": THESIS}
    pose = {"position.noise": 0.1, "attitude.noise": 0.1}
    return simulated.load(seed=seed, settings={"duration": duration, **none, **noise, **pose})


@functools.cache
def outdoor(seed: int = 0, duration: float = 3.0, world: str = "thesis", **settings: float) -> Flight:
    """A flight with all sensors of the outdoor filters; `gyro__bias=` sets gyro.bias."""
    named = {k.replace("__", "."): v for k, v in settings.items()}
    return load_world(world, seed=seed, settings={"sensors": SENSORS, "duration": duration, **named})


def ratios(particles: list[dict[str, float]], reference: list[dict[str, float]]) -> dict[str, float]:
    """How many times the error of the error-state filter ours is, over all flights."""
    root = {
        name: [np.sqrt(np.mean([score[name] ** 2 for score in scores])) for scores in (particles, reference)]
        for name in ("position_rmse_m", "attitude_rmse_deg")
    }
    return {name: ours / theirs for name, (ours, theirs) in root.items()}


def mean_nees(belief: Runs, flights: list[Flight]) -> np.ndarray:
    """The NEES of each tick, averaged over the runs."""
    total = np.zeros(len(belief.time))
    for k, flight in enumerate(flights):
        assert flight.truth is not None
        attitude = belief.attitude[k] if "attitude" in belief.leaves else None
        error = state_error(belief.time, flight.truth, belief.position[k], belief.velocity[k], attitude)
        total += nees(error, belief.covariance[k])
    return total / len(flights)


def engines_agree(graph: Graph, inputs: Any, *, exact: tuple[str, ...] = ("python", "reference")) -> Result:
    """The result, the same in all engines: DESIGN section 5; the reference interpreter to the same bits."""
    python, reference, xla = (simulate(graph, inputs, engine=e) for e in (*exact, "xla"))
    for name, series in python.series.items():
        for leaf, values in series.leaves.items():
            np.testing.assert_array_equal(values, reference[name][leaf], err_msg=f"{name}.{leaf}")
        compare(series, xla[name])
    return python


def compare(a: Any, b: Any) -> None:
    """States within 1e-9 max(1, |x|), covariances within 1e-6 sqrt(P_ii P_jj), the same decisions."""
    np.testing.assert_array_equal(a.time, b.time)
    for leaf, x in a.leaves.items():
        if x.dtype.kind != "f":
            np.testing.assert_array_equal(x, b[leaf], err_msg=leaf)
            continue
        bound = 1e-9 * np.maximum(1.0, np.abs(x))
        if leaf == "covariance":
            variance = np.maximum(np.einsum("nii->ni", x), 1e-12)
            bound = 1e-6 * np.sqrt(variance[:, :, None] * variance[:, None, :])
        assert (np.abs(x - b[leaf]) <= bound).all(), leaf


def is_lowered_and_drawn(case: Case, *paths: str) -> None:
    """The pipeline holds a stage for each path, and the drawing names it."""
    stages = {stage.path for stage in lower(case.graph).stages}
    for path in paths:
        assert path in stages
        assert path in case.graph.text()
