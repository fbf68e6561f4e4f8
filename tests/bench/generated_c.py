"""Generated C beside hand-written code of the same work: Eigen for Kalman, NumPy and our Python for others.

Only the loop over the ticks is timed, in the engine's own library and in the floor's, on data that lies
ready in memory. What both compute must be equal before anything is timed.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Collection, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Array, Graph, Signal, Stream, block, delay, graph, lower, real, simulate
from flowgraph.data.inputs import Inputs, prepare
from flowgraph.data.series import Series
from flowgraph.data.tape import tape
from flowgraph.engines.c.library import Compiled, State
from flowgraph.engines.contract import real_leaves
from flowgraph.pipeline.optimise import COMPILED, DEFAULT, check_passes
from flowgraph.recorder.random import ROUNDS, Site, seed_words, segments
from tests.bench import direct_eskf, direct_rbpf, inertial, particles
from tests.bench.rows import Row, interleaved, missing, seconds, worked

FLOOR = Path(__file__).parent / "floor"
FLAGS = ("-std=c++17", "-O3", "-march=native", "-ffast-math", "-I/usr/include/eigen3", "-fPIC")


def floor(name: str, *defines: str) -> ctypes.CDLL:
    """A hand-written peer, compiled.

    Args:
        name: of its file.
        defines: constants of the compilation, as NAME=VALUE.

    Raises:
        ImportError: without a C++ compiler, or Eigen where it is needed.
    """
    compiler, source = shutil.which("c++"), FLOOR / f"{name}.cpp"
    if compiler is None:
        raise ImportError("a C++ compiler is needed")
    if "<Eigen/" in source.read_text() and not Path("/usr/include/eigen3/Eigen/Dense").exists():
        raise ImportError("Eigen is needed")
    folder = Path(tempfile.mkdtemp(prefix="flowgraph-floor-"))
    try:
        part, made = folder / f"{name}.o", folder / f"{name}.so"
        defined = [f"-D{d}" for d in defines]
        subprocess.run([compiler, *FLAGS, *defined, "-c", "-o", part, source], check=True)
        # Linked without -ffast-math, which would turn small numbers into zero in all of this process.
        subprocess.run([compiler, "-shared", "-o", made, part], check=True)
        return ctypes.CDLL(str(made))
    finally:
        shutil.rmtree(folder)


def loop(
    built: Graph,
    inputs: Inputs,
    passes: Collection[str] | None = None,
    dtype: str = "float64",
    timed: Callable[[Callable[[], object]], float] = seconds,
) -> Callable[[], float]:
    """A call that plays the inputs once in C, after these passes, and returns the seconds `timed` there.

    In that time all outputs come to lie in arrays, one for each leaf.
    """
    pipeline, kind = lower(built, dtype=dtype), np.dtype(dtype)
    events = tape(prepare(built, inputs), built)
    library = Compiled(
        pipeline, kind, events.patterns, passes=check_passes(COMPILED if passes is None else passes)
    )
    rows = library.rows([real_leaves(s, kind) for s in events.series])
    cells = [c.reset for r in pipeline.registers for c in r.cells]
    rooms = [library.room(k, n) for k, (n, _) in enumerate(library.most(events.key))]

    def once() -> float:
        state = State(library, cells, seed_words(0))
        return timed(lambda: library.advance(state, events.time, events.key, rows, rooms))

    return once


class Estimate(Signal):
    mean: Array = real(6)
    covariance: Array = real(6, 6)


@block
def kalman_step(before: Estimate, z: real(3), *, model: Any, xp: Any) -> Estimate:  # type: ignore[valid-type]
    """Predict and update, Joseph form."""
    F, Q, H, R = model
    mean, prior = F @ before.mean, F @ before.covariance @ F.T + Q
    HP = H @ prior
    K = xp.linalg.solve(HP @ H.T + R, HP).mT
    left = np.eye(6) - K @ H
    after = left @ prior @ left.mT + K @ R @ K.mT
    return Estimate(mean=mean + K @ (z - H @ mean), covariance=0.5 * (after + after.mT))


def kalman(*, ticks: int = 2_000, repeats: int = 151) -> list[Row]:
    """Nanoseconds a step of six states and three measurements."""
    step = 0.01
    F = np.eye(6) + step * np.eye(6, k=3)
    model = F, 1e-3 * np.eye(6), np.eye(3, 6), 1e-2 * np.eye(3)
    measured = np.random.default_rng(0).normal(size=(ticks, 3))
    start = Estimate(mean=np.zeros(6), covariance=np.eye(6))

    @graph
    def g(z: Stream[real(3)]):  # type: ignore[valid-type]
        memory = delay(start, name="estimate")
        now = kalman_step(memory, z, model=model)
        memory.feed(now)
        return now

    built, inputs = g.build(), {"z": Series(np.arange(ticks) * 10_000_000, measured)}
    ours = loop(built, inputs)
    scale = 1e9 / ticks
    try:
        peer = floor("kalman").floor_kalman
    except ImportError as error:
        return [missing("Kalman step 6/3, C", ours() * scale, "ns", "Eigen", error)]
    flat = np.concatenate([a.ravel() for a in (*model, start.mean, start.covariance)])
    mean, covariance = np.empty((ticks, 6)), np.empty((ticks, 6, 6))
    peer.argtypes = [ctypes.c_int64, *[ctypes.c_void_p] * 4]
    pointers = [a.ctypes.data for a in (flat, measured, mean, covariance)]
    peer(ticks, *pointers)
    found = simulate(built, inputs, engine="c").output
    np.testing.assert_allclose(found.mean, mean, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=0.0, atol=1e-9)
    a, b, ratio = interleaved(
        lambda: ours() * scale, lambda: seconds(lambda: peer(ticks, *pointers)) * scale, repeats
    )
    return [Row("Kalman step 6/3, C", a, b, "ns", "Eigen -O3", ratio, "ratio <= 1", ratio <= 1.0)]


def eskf(*, duration: float = 20.0, repeats: int = 7) -> list[Row]:
    """Microseconds a tick of `ins_eskf`, against our Python engine and numba's loop."""
    built, inputs, direct = inertial.case(duration)
    found = simulate(built, inputs, engine="c")
    inertial.check(found, *direct_eskf.run(**direct)[:2])
    ours, quickest = loop(built, inputs), loop(built, inputs, DEFAULT)
    scale = 1e6 / len(direct["time"])
    mine = lambda: ours() * scale
    python = lambda: simulate(built, inputs).wall_s * scale
    rows = []
    for name, play in (("ins_eskf, c", ours), ("ins_eskf, c, all passes", quickest)):
        a, b, ratio = interleaved(lambda play=play: play() * scale, python, repeats)  # type: ignore[misc]
        bound, met = "ratio <= 1/50", ratio <= 0.02
        rows.append(Row(name, a, b, "us/tick", "our Python engine", ratio, bound, met))
    try:
        by_numba = import_module("tests.bench.numba_eskf").run
    except ImportError as error:
        return [*rows, missing("ins_eskf, c", mine(), "us/tick", "numba", error)]
    inertial.check(found, *by_numba(**direct))
    a, b, ratio = interleaved(mine, lambda: seconds(lambda: by_numba(**direct)) * scale, repeats)
    return [*rows, Row("ins_eskf, c", a, b, "us/tick", "numba", ratio, "ratio <= 1", ratio <= 1.0)]


def rbpf_by_hand(direct: dict[str, Any]) -> tuple[Callable[[], float], direct_rbpf.History]:
    """A call of the C++ filter that returns the seconds of work it took, and where it leaves its results."""
    n = len(direct["start"].log_weight)
    peer = floor("rbpf", f"PARTICLES={n}", f"ROUNDS={ROUNDS}").floor_rbpf
    ticks, seen = len(direct["time"]), len(direct["poses"])
    names = [
        Site(name, "normal", ()).hash for name in ("rbpf_indoor.attitude/gyro", "rbpf_indoor.resample/place")
    ]
    settings = (
        "gyro_noise",
        "accelerometer_noise",
        "position_noise",
        "attitude_noise",
        "resample_below",
        "still",
    )
    given = [
        *(np.ascontiguousarray(direct[name], np.int64) for name in ("time", "imu_index", "pose_index")),
        *(np.ascontiguousarray(direct[name], np.float64) for name in ("imu", "poses")),
        np.concatenate([np.ravel(field) for field in vars(direct["start"]).values()]),
        np.array([*(direct[name] for name in settings), -9.81]),
        seed_words(direct["seed"]),
        np.array(names, np.uint32),
        *segments(),
    ]
    made = [np.empty((ticks, 10)), np.empty(seen), np.empty(seen, bool), np.empty((seen, n), np.int32)]
    peer.argtypes = [ctypes.c_int64, *[ctypes.c_void_p] * (len(given) + len(made))]
    pointers = [a.ctypes.data for a in (*given, *made)]
    return lambda: worked(lambda: (given, peer(ticks, *pointers))), direct_rbpf.History(*made)


def rbpf(*, particles_: int = 1000, duration: float = 2.55, repeats: int = 9) -> list[Row]:
    """Microseconds of work a tick of `rbpf_indoor`, draws included, against C++ and NumPy loops by hand."""
    built, direct = particles.case(particles_, duration)
    in_numpy = direct_rbpf.run(**direct)
    found = simulate(built.graph, built.inputs, engine="c")
    particles.check(found, in_numpy)
    assert isinstance(built.inputs, Mapping)
    ours = loop(built.graph, dict(built.inputs), timed=worked)
    name, scale = f"rbpf_indoor, {particles_:,} particles, c", 1e6 / len(in_numpy.poses)
    mine = lambda: ours() * scale
    try:
        peer, by_hand = rbpf_by_hand(direct)
    except ImportError as error:
        rows = [missing(name, mine(), "us/tick", "C++", error)]
    else:
        peer()
        particles.check(found, by_hand)
        a, b, ratio = interleaved(mine, lambda: peer() * scale, repeats)
        rows = [Row(name, a, b, "us/tick", "C++ -O3 by hand", ratio, "ratio <= 0.9", ratio <= 0.9)]
    a, b, ratio = interleaved(
        mine, lambda: worked(lambda: direct_rbpf.run(**direct)) * scale, min(repeats, 5)
    )
    rows.append(Row(name, a, b, "us/tick", "direct NumPy", ratio))
    single = simulate(built.graph, built.inputs, engine="c", dtype="float32")
    np.testing.assert_allclose(single.pose.position, found.pose.position, rtol=0.0, atol=5e-2)
    in_single = loop(built.graph, dict(built.inputs), dtype="float32", timed=worked)
    a, b, ratio = interleaved(lambda: in_single() * scale, mine, repeats)
    return [
        *rows,
        Row(f"{name}, float", a, b, "us/tick", "ours in double", ratio, "ratio <= 0.8", ratio <= 0.8),
    ]
