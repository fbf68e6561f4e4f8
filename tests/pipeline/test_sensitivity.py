"""A pipeline with its own forward derivatives gives what differences of whole runs give."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Scalar, Stream, block, delay, graph, lower
from flowgraph.engines.options import RunOptions
from flowgraph.engines.playback import play, run_pipeline
from flowgraph.engines.subject import LoadedPipeline
from flowgraph.pipeline.sensitivity import CHANGE, sensitivity


@block
def swing(x: Scalar, push: Scalar, *, dt, xp) -> tuple[Scalar, Scalar]:
    """A pendulum, pushed: what it moves to, and the root of its energy."""
    moved = x + dt * (xp.sin(2.0 * x) - 0.3 * x) + 0.1 * push
    return moved, xp.sqrt(moved * moved + 1.0)


@graph
def pendulum(push: Stream[Scalar], *, start: float):
    x = delay(np.float64(start), name="x")
    moved, size = swing(x, push)
    x.feed(moved)
    return {"x": moved, "size": size, "count": push.map(lambda v: v > 0.0)}


TIME = np.arange(60) * 10**8
PUSH = np.random.default_rng(3).normal(size=60)


def outputs(start: float, push: np.ndarray):
    result = run_pipeline(lower(pendulum.build(start=start)), {"push": (TIME, {"value": push})})
    return {n: result[n]["value"] for n in ("x", "size")}


@pytest.mark.parametrize("engine", ["reference", pytest.param("c", marks=pytest.mark.slow)])
def test_changes_of_a_start_and_of_an_input_are_those_of_differences(engine):
    wave = np.sin(np.arange(60.0))
    made = sensitivity(
        lower(pendulum.build(start=0.4)), 2, {("x", "value")}, ["x", "size"], {("push", "value")}
    )
    first = [
        np.array([1.0, 0.0]) if c.name == "value" + CHANGE else c.reset
        for r in made.registers
        for c in r.cells
    ]
    change = np.stack([np.zeros(60), wave], axis=1)
    given = {"push": (TIME, {"value": PUSH, "value" + CHANGE: change})}
    result = play(LoadedPipeline(made, first), given, RunOptions(engine=engine))
    h = 1e-6
    for k, (a, b) in enumerate(
        [
            (outputs(0.4 + h, PUSH), outputs(0.4 - h, PUSH)),
            (outputs(0.4, PUSH + h * wave), outputs(0.4, PUSH - h * wave)),
        ]
    ):
        for name in ("x", "size"):
            np.testing.assert_allclose(
                result[name]["value" + CHANGE][:, k], (a[name] - b[name]) / (2 * h), rtol=1e-6, atol=1e-7
            )
    apart = 0.0 if engine == "reference" else 1e-14  # compiled code may add in another order
    np.testing.assert_allclose(result["x"]["value"], outputs(0.4, PUSH)["x"], rtol=apart, atol=0.0)


def test_what_does_not_change_is_not_computed_twice():
    plain = lower(pendulum.build(start=0.4))
    still = sensitivity(plain, 3, set(), ["x"])
    assert len(still.instructions) == len(plain.instructions)
    assert not any(c.name.endswith(CHANGE) for r in still.registers for c in r.cells)
    moving = sensitivity(plain, 3, {("x", "value")}, ["x"])
    changing = [(c.name, c.shape) for r in moving.registers for c in r.cells if c.name.endswith(CHANGE)]
    assert changing == [("value" + CHANGE, (3,))]
    leaves = {p.name: [leaf.name for leaf in p.leaves] for p in moving.outputs}
    assert leaves == {"x": ["value", "value" + CHANGE], "size": ["value"], "count": ["value"]}
