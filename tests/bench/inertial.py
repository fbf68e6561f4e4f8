"""One tick of `ins_eskf`: in each engine, and as a hand-written NumPy loop of the same equations.

The hand-written loop (`direct_eskf.py`) is what a careful person writes for this one filter: it is handed
ticks that are merged already, fills its matrices in place and does its quaternions in Python floats. The
blocks do neither: the same lines take batches and are traced.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Graph, Result, Series, simulate, timing_of
from flowgraph.blocks.flights import simulated
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.signals import Belief, Position
from flowgraph.graphs.ins_eskf import ins_eskf
from tests.bench import direct_eskf
from tests.bench.rows import Row, interleaved, seconds


def case(duration: float) -> tuple[Graph, dict[str, Series], dict[str, Any]]:
    """The filter on a simulated flight's IMU and position: graph, inputs, and the direct loop's arguments."""
    flight = simulated.load(settings={"duration": duration})
    imu, vicon, truth = flight.streams["imu"], flight.streams["vicon"], flight.truth
    assert truth is not None
    inputs = {"imu": imu, "position": Series(vicon.time, Position(position=vicon.position), name="position")}
    start = start_belief(
        truth.position[0], truth.attitude[0], specific_force=imu.specific_force[0], spread=StartSpread()
    )
    noise, spread = flight.info["imu_noise"], flight.info["position_noise"]
    sources: dict[str, Any] = {name: timing_of(series) for name, series in inputs.items()}
    built = ins_eskf.build(**sources, start=start, noise=noise, position_noise=spread)
    time, imu_index, position_index = direct_eskf.ticks(imu.time, vicon.time)
    direct = {
        "time": time,
        "imu_index": imu_index,
        "position_index": position_index,
        "imu": np.concatenate([imu.gyro, imu.specific_force], axis=-1),
        "positions": vicon.position,
        "start": tuple(getattr(start, name) for name in Belief._fields),
        "densities": (noise.gyro, noise.accelerometer, noise.gyro_bias, noise.accelerometer_bias),
        "position_noise": spread,
        "lever": (0.0, 0.0, 0.0),
    }
    return built, inputs, direct


def check(result: Result, states: np.ndarray, covariances: np.ndarray) -> None:
    """Fail unless an engine and the direct loop give the same estimate."""
    belief = result["belief"]
    found = np.concatenate([belief[name] for name in Belief._fields[:5]], axis=-1)
    np.testing.assert_allclose(found, states, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(belief["covariance"], covariances, rtol=0.0, atol=1e-9)


def against_numpy(*, duration: float = 20.0, repeats: int = 9) -> list[Row]:
    """Microseconds a tick of the whole `simulate` call, against the hand-written loop."""
    built, inputs, direct = case(duration)
    states, covariances, _ = direct_eskf.run(**direct)
    check(simulate(built, inputs), states, covariances)
    scale = 1e6 / len(states)
    ours, peer, ratio = interleaved(
        lambda: seconds(lambda: simulate(built, inputs)) * scale,
        lambda: seconds(lambda: direct_eskf.run(**direct)) * scale,
        repeats,
    )
    bound, met = "ratio <= 1.2", ratio <= 1.2
    return [Row("ins_eskf, python", ours, peer, "us/tick", "direct NumPy", ratio, bound, met)]


def engines(*, duration: float = 20.0, repeats: int = 5) -> list[Row]:
    """Microseconds a tick of the loops of the other engines, against the Python engine's."""
    built, inputs, direct = case(duration)
    states, covariances, _ = direct_eskf.run(**direct)
    rows = []
    for engine in ("xla", "reference"):
        check(simulate(built, inputs, engine=engine), states, covariances)
        loop = lambda name: lambda: simulate(built, inputs, engine=name).wall_s * 1e6 / len(states)
        ours, peer, ratio = interleaved(loop(engine), loop("python"), repeats)
        rows.append(Row(f"ins_eskf, {engine}", ours, peer, "us/tick", "python engine", ratio))
    return rows
