"""`sim`: a smooth figure, flown in a graph: world and sensors are blocks, a flight is a run of them.

Its waves and all noise are drawn in the graph, by the counter-based generator, from the seed. So a flight is
the same whether it is written down first, as `load_figure` does by a run of the graph, or made tick by tick
in front of a filter, as a study of many seeds does; see `Experiment`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from flowgraph import Flight, Graph, Stream, Tick, graph, latest, simulate, ticks
from flowgraph.blocks.flights import worlds
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.sensors import bias_at_start, drift, read_imu, read_pose, true_state
from flowgraph.blocks.signals import FigureShape, Vector
from flowgraph.blocks.world import AT_REST, figure_motion, figure_shape
from flowgraph.data.experiment import Experiment
from flowgraph.data.inputs import clocks_of
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["DEFAULTS", "figure", "load_figure"]

DEFAULTS: Mapping[str, float] = {
    "duration": 20.0,
    "imu.rate": 200.0,
    "vicon.rate": 4.0,
    "gyro.noise": 1e-3,
    "accelerometer.noise": 1e-2,
    "gyro.walk": 2e-5,
    "accelerometer.walk": 3e-4,
    "gyro.bias": 0.01,
    "accelerometer.bias": 0.1,
    "position.noise": 0.01,
    "attitude.noise": 0.01,
}
"""Settings: seconds, Hz, continuous densities, standard deviations of the constant biases, and of the motion
capture in m and rad."""


@graph
def figure(
    start: Stream[Tick], imu: Stream[Tick], vicon: Stream[Tick], *, rate: float, noise: ImuNoise,
    gyro_bias: float, accelerometer_bias: float, position_noise: float, attitude_noise: float,
):  # fmt: skip
    """A body on a smooth figure, with an inertial unit at `rate` Hz and a motion capture.

    `start` ticks once, at 0: there the figure and the constant biases are drawn. There is a truth at every
    reading of either.
    """
    shape = latest(figure_shape(at=start), init=_NO_SHAPE, name="shape")
    motion = figure_motion(shape, at=imu | vicon)
    biases = {}
    for part, deviation, walk in (
        ("gyro", gyro_bias, noise.gyro_bias),
        ("accelerometer", accelerometer_bias, noise.accelerometer_bias),
    ):
        first = bias_at_start(at=start, deviation=deviation, name=f"{part}_start", draws=f"{part}_start")
        held = latest(first, init=Vector(vector=np.zeros(3)), name=f"{part}_bias")
        biases[part] = drift(held, at=imu, walk=walk, name=f"{part}_drift", draws=f"{part}_drift")
    reading = read_imu(
        motion, biases["gyro"], biases["accelerometer"], at=imu, gyro=noise.gyro * math.sqrt(rate),
        accelerometer=noise.accelerometer * math.sqrt(rate), draws="imu",
    )  # fmt: skip
    pose = read_pose(
        motion, at=vicon, position_noise=position_noise, attitude_noise=attitude_noise, draws="vicon"
    )
    now = {n: latest(b, init=Vector(vector=np.zeros(3)), name=f"{n}_now") for n, b in biases.items()}
    truth = true_state(motion, now["gyro"], now["accelerometer"])
    return {"imu": reading, "vicon": pose, "truth": truth}


_NO_SHAPE = FigureShape(
    **{n: np.zeros((3, 3)) for n in ("sizes", "frequencies", "phases", "origin")},
    **{n: np.zeros(2) for n in ("yaw_phases", "yaw_origin")},
)


def load_figure(*, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Make a flight by a run of the graph, all its ticks at once.

    Args:
        seed: of the figure and of all noise. Each noise has a random stream of its own name, so that a
            change of one setting does not change the draws of another.
        settings: any of `DEFAULTS`.

    Returns:
        A `Flight` with the streams `imu` (`Imu`) and `vicon` (`Pose`), and its `experiment`. truth is a
        `NavigationState` at the times of both; info has `still` (s), `imu_noise` (`ImuNoise`),
        `position_noise` (m), `attitude_noise` (rad), `imu_period_ns` and `vicon_period_ns`.

    Raises:
        UnknownNameError: for an unknown setting; DeclarationError: for one that is no number in its range.
    """
    s = _numbers(settings or {})
    world = _world(tuple(s.items()))
    told = world.settings
    flown = simulate(_built(tuple(s.items())), world.ticks, engine="numpy", seed=seed)
    return Flight(
        name=f"sim-{seed}",
        streams={name: flown[name] for name in ("imu", "vicon")},
        truth=flown["truth"],
        info={
            "imu_noise": told["noise"],
            "position_noise": told["position_noise"],
            "attitude_noise": told["attitude_noise"],
            "imu_period_ns": round(1e9 / s["imu.rate"]),
            "vicon_period_ns": round(1e9 / s["vicon.rate"]),
            "still": AT_REST,
        },
        notes=(note("info", f"simulated with seed {seed}: 1 s at rest, then a smooth figure"),),
        experiment=world,
    )


@lru_cache(maxsize=8)
def _world(settings: tuple[tuple[str, float], ...]) -> Experiment:
    s = dict(settings)
    end, period = round(s["duration"] * 1e9), round(1e9 / s["imu.rate"])
    clocks = ("start", end + 1), ("imu", period), ("vicon", round(1e9 / s["vicon.rate"]))
    told: dict[str, Any] = {
        "rate": 1e9 / period,
        "noise": ImuNoise(s["gyro.noise"], s["accelerometer.noise"], s["gyro.walk"], s["accelerometer.walk"]),
        "gyro_bias": s["gyro.bias"],
        "accelerometer_bias": s["accelerometer.bias"],
        "position_noise": s["position.noise"],
        "attitude_noise": s["attitude.noise"],
    }
    return Experiment(figure, {n: ticks(each, until=end + 1, name=n) for n, each in clocks}, told)


@lru_cache(maxsize=8)
def _built(settings: tuple[tuple[str, float], ...]) -> Graph:
    world = _world(settings)
    return figure.build(**clocks_of(world.ticks), **world.settings)


def _numbers(given: Mapping[str, str | float]) -> dict[str, float]:
    known = dict(DEFAULTS)
    for name, text in given.items():
        if name not in known:
            raise UnknownNameError("setting", name, known, path="sim")
        positive = name in ("duration", "imu.rate", "vicon.rate")
        try:
            number = float(text)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number) or number < 0.0 or (positive and number == 0.0):
            raise DeclarationError(
                f"setting {name!r} is not usable",
                path="sim",
                expected="a positive number" if positive else "a number that is not negative",
                got=repr(text),
                fix=f"for example {name}={DEFAULTS[name]:g}",
            )
        known[name] = number
    worlds.check_samples(known, ("imu.rate", "vicon.rate"), "sim")
    return known
