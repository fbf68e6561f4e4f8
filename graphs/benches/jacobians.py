"""What a Jacobian by hand saves: each step of the library that has one, beside the same with a derived one.

The pairs are in `jacobian_pairs` and the modules beside it. A row says what a step costs by hand and derived,
in operations, in C and in Python, and how far the two are apart: so it tells which pays for its lines.
Two rows are whole filters: what `filtered` makes of a model, beside a filter whose every step is by hand.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import (
    Array,
    Report,
    Series,
    Signal,
    Stream,
    UnknownNameError,
    block,
    find_graph,
    graph,
    lower,
    periodic,
    real,
    simulate,
)
from flowgraph.blocks.filtering import MeasurementModel, extended, filtered
from flowgraph.blocks.geometry.rotations import rotate
from flowgraph.blocks.inertial.alignment import start_belief
from flowgraph.blocks.models.inertial_pose import (
    INERTIAL,
    INERTIAL_BIASED,
    inertial_motion,
    pose_seen,
    stacked,
)
from flowgraph.blocks.models.pose import start_pose
from flowgraph.blocks.models.unscented_pose import start_state
from flowgraph.blocks.signals import Gaussian, Imu, Pose, Position
from flowgraph.graphs.benches.jacobian_clouds import CLOUD_PAIRS
from flowgraph.graphs.benches.jacobian_inertial import INERTIAL_PAIRS
from flowgraph.graphs.benches.jacobian_pairs import DT, LEVER, NOISE, SIGMA, Pair, Step, drawn
from flowgraph.graphs.benches.jacobian_poses import POSE_PAIRS
from flowgraph.language.checks import need_count
from flowgraph.language.graph import Graph
from flowgraph.pipeline.costs import Costs
from flowgraph.pipeline.optimise import COMPILED

__all__ = ["FILTERS", "PAIRS", "apart", "jacobians"]

PAIRS: dict[str, Pair] = {**POSE_PAIRS, **INERTIAL_PAIRS, **CLOUD_PAIRS}
"""By the block with the Jacobian, or by the observer that `update_extended` is given."""

FILTERS = ("ekf", "ins_eskf")
"""Graphs of the library that stand beside `filtered` of the same model."""


class Given(Signal):
    """What a step is taken from: a belief and a reading."""

    mean: Array = real("n")
    covariance: Array = real("t", "t")
    reading: Array = real("k")


@block
def stepped(given: Given, *, step: Step, dt: float, xp: Any) -> Gaussian:
    """One step of a pair."""
    return step(given.mean, given.covariance, given.reading, dt, xp)


@graph
def alone(given: Stream[Given], *, step: Step):
    """A step, and nothing else."""
    return {"belief": stepped(given, step=step)}


@graph
def derived_pose(imu: Stream[Imu], vicon: Stream[Pose], *, start: Gaussian):
    """What `ekf` does, of models."""
    seen = pose_seen(SIGMA, SIGMA, space=INERTIAL, lever=LEVER)
    return filtered(
        inertial_motion(NOISE, space=INERTIAL), {seen: vicon}, control=imu, start=start, method=extended()
    )


@graph
def derived_navigation(imu: Stream[Imu], position: Stream[Position], *, start: Gaussian):
    """What `ins_eskf` does, of models."""
    place = lambda x, xp: x.position + rotate(x.attitude, xp.asarray(LEVER, dtype=x.position.dtype), xp=xp)
    seen = MeasurementModel(INERTIAL_BIASED, place, noise=[SIGMA**2] * 3)
    motion = inertial_motion(NOISE, space=INERTIAL_BIASED)
    return filtered(motion, {seen: position}, control=imu, start=start, method=extended())


def jacobians(
    *, of: str = "all", ticks: int = 2000, runs: int = 5, engine: str = "c", seed: int = 0
) -> Report:
    """Steps with a Jacobian by hand beside the same with a derived one: operations, time, and difference.

    Args:
        of: a block with a Jacobian, a filter (ekf, ins_eskf), or all.
        ticks: that a step is timed over; a hundredth of them in Python.
        runs: of which the quickest counts; by hand and derived take turns.
        engine: that is timed beside Python.
        seed: of the states and readings.

    Returns:
        A row a step: `jacobian`, `graphs` that take it, `operations` and `derived_operations` (scalar, of a
        tick), `c_us` and `derived_c_us` (of `engine`), `python_us` and `derived_python_us`, `difference` (of
        means relative to max(1, |x|), of covariances to the deviations; None of a filter) and its `bound`.

    Raises:
        UnknownNameError: for a block that is not there; DeclarationError: for a number out of range.
    """
    known = [*PAIRS, *(f"filter {name}" for name in FILTERS)]
    if of != "all" and of not in known:
        raise UnknownNameError("step", of, ["all", *known], path="jacobians.of")
    for name, value in (("ticks", ticks), ("runs", runs)):
        need_count("jacobians", name, value, least=1)
    rows = []
    for name in known if of == "all" else [of]:
        if name in PAIRS:
            rows.append(_row(name, PAIRS[name], ticks, runs, engine, seed))
        else:
            rows.append(_filter_row(name.removeprefix("filter "), ticks, runs, engine, seed))
    return Report(rows, {}, (f"{ticks} ticks, the quickest of {runs} runs",))


def apart(pair: Pair, rng: np.random.Generator) -> float:
    """How far a step by hand and the derived one are apart, from one drawn belief."""
    given = drawn(pair, rng)
    by_hand, derived = (step(*given, DT, np) for step in (pair.by_hand, pair.derived))
    mean = np.abs(by_hand.mean - derived.mean).max() / max(1.0, np.abs(derived.mean).max())
    deviation = np.sqrt(np.diag(derived.covariance))
    wide = np.abs(by_hand.covariance - derived.covariance) / np.outer(deviation, deviation)
    return float(max(mean, wide.max()))


def _row(name: str, pair: Pair, ticks: int, runs: int, engine: str, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    difference = max(apart(pair, rng) for _ in range(20))
    some = [drawn(pair, rng) for _ in range(ticks)]
    given = Given(*(np.stack(column) for column in zip(*some, strict=True)))
    sizes = {"n": pair.space.size, "t": pair.space.tangent, "k": len(some[0][2])}
    series = {"given": Series(np.arange(ticks, dtype=np.int64) * int(DT * 1e9), given)}
    both = [alone.build(step=step, sizes=sizes) for step in (pair.by_hand, pair.derived)]
    return _compared(name, pair.graphs, both, series, ticks, runs, engine, difference, pair.bound)


def _filter_row(name: str, ticks: int, runs: int, engine: str, seed: int) -> dict[str, Any]:
    """A body at rest that is looked at every twentieth tick."""
    rng = np.random.default_rng(seed)
    steps = np.arange(ticks, dtype=np.int64) * int(DT * 1e9)
    force = rng.normal(np.array([0.0, 0.0, 9.81]), 1.0, (ticks, 3))
    imu = Imu(gyro=rng.normal(size=(ticks, 3)), specific_force=force)
    place = 0.01 * rng.normal(size=(len(steps[::20]), 3))
    noise: dict[str, Any] = {"noise": NOISE, "position_noise": SIGMA, "lever": LEVER}
    at = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    clocks: dict[str, Any] = {"imu": periodic("5ms")}
    if name == "ekf":
        level = np.tile(at[1], (len(place), 1))
        inputs = {"imu": Series(steps, imu), "vicon": Series(steps[::20], Pose(place, level))}
        clocks["vicon"] = periodic("100ms")
        by_hand = find_graph(name).build(start=start_pose(*at), attitude_noise=SIGMA, **noise, **clocks)
        derived = derived_pose.build(start=start_state(*at), **clocks)
    else:
        inputs = {"imu": Series(steps, imu), "position": Series(steps[::20], Position(place))}
        clocks["position"] = periodic("100ms")
        start = start_belief(*at)
        by_hand = find_graph(name).build(start=start, **noise, **clocks)
        derived = derived_navigation.build(start=stacked(start), **clocks)
    return _compared(f"filter {name}", (name,), [by_hand, derived], inputs, ticks, runs, engine, None, None)


def _compared(
    name: str, graphs: tuple[str, ...], both: list[Graph], inputs: dict[str, Series], ticks: int, runs: int,
    engine: str, difference: float | None, bound: float | None,
) -> dict[str, Any]:  # fmt: skip
    counts = [sum(Costs(lower(g), 2 ** len(inputs) - 1, COMPILED).operations.values()) for g in both]
    c = [np.inf, np.inf]
    for _ in range(runs):
        for k, g in enumerate(both):
            c[k] = min(c[k], simulate(g, inputs, engine=engine).wall_s / ticks)
    few = max(ticks // 100, 2)
    start = {port: s[s.time <= few * int(DT * 1e9)] for port, s in inputs.items()}
    python = [np.inf, np.inf]
    for _ in range(min(runs, 3)):
        for k, g in enumerate(both):
            result = simulate(g, start, engine="python")
            python[k] = min(python[k], result.wall_s / result.ticks)
    return {
        "jacobian": name,
        "graphs": ", ".join(graphs),
        "operations": counts[0],
        "derived_operations": counts[1],
        "c_us": 1e6 * c[0],
        "derived_c_us": 1e6 * c[1],
        "python_us": 1e6 * python[0],
        "derived_python_us": 1e6 * python[1],
        "difference": difference,
        "bound": bound,
    }
