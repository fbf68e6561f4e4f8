"""Studies and batches of graphs with host blocks: the host has its part in each run, in every engine."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Case,
    LoweringError,
    Scalar,
    Stream,
    block,
    clocks_of,
    delay,
    find_graph,
    graph,
    latest,
    load_flight,
    lower,
    simulate,
    simulate_many,
)
from flowgraph.blocks.signals import Imu, Pose
from flowgraph.data import registry
from flowgraph.pipeline import digests
from flowgraph.study import Study, execution, run_study

pytest.importorskip("pyarrow")

FLIGHT: dict[str, Any] = {"duration": 1.2, "imu.rate": 50, "vicon.rate": 10}
ENGINES = ("reference", "xla", "c")


@block(host=True)
def sighted(pose: Pose, *, draw: Any, grain: float) -> Scalar:
    """No array-API operation: a height from the text of a number, and noise of its own."""
    noise = float(draw.normal("sight", (1,))[0])
    return np.asarray(float(f"{float(pose.position[2]):.3f}") + grain * noise)


@block
def follow(before: Scalar, imu: Imu, seen: Scalar, *, draw: Any, gain: float, xp: Any) -> Scalar:
    wander = 1e-3 * draw.normal("wander", (3,)) + imu.gyro
    return before + gain * (seen - before) + 0.01 * xp.sum(wander)


@block(host=True)
def told(x: Scalar) -> Scalar:
    return np.asarray(round(float(x), 6))


@graph
def mixed(imu: Stream[Imu], vicon: Stream[Pose], *, gain: float, grain: float) -> dict[str, Any]:
    """A camera on the host, a filter, and a display's rounding on the host after it."""
    seen = latest(sighted(vicon, grain=grain), init=0.0, at=imu, name="seen")
    memory = delay(0.0, name="memory")
    height = follow(memory, imu, seen, gain=gain)
    memory.feed(height)
    return {"height": height, "told": told(height)}


@mixed.on_flight
def for_flight(flight: Any, *, gain: float = 0.2, grain: float = 0.01) -> Case:
    inputs = flight.need("mixed", "imu", "vicon")
    built = mixed.build(**clocks_of(inputs), gain=gain, grain=grain)
    return Case(built, inputs, lambda r: {n: float(np.mean(s["value"])) for n, s in r.series.items()})


def needs(engine: str) -> None:
    if engine == "xla":
        pytest.importorskip("jax")
    if engine == "c" and shutil.which("cc") is None:
        pytest.skip("needs a C compiler")


def case(seed: int, **settings: Any) -> Case:
    return mixed.case(
        load_flight("sim", seed=seed, settings={n: str(v) for n, v in FLIGHT.items()}), **settings
    )


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("engine", ENGINES)
def test_each_run_of_a_batch_is_what_a_single_run_gives(engine, dtype):
    needs(engine)
    cases = [case(k) for k in range(3)]
    init = [{"memory": 0.5 * k} for k in range(3)]
    graph_, inputs = cases[0].graph, [c.inputs for c in cases]
    batch = simulate_many(graph_, inputs, [7, 8, 9], engine=engine, dtype=dtype, init=init)
    assert set(batch.series) == {"height", "told"}
    for k in range(3):
        alone = simulate(graph_, inputs[k], engine=engine, dtype=dtype, init=init[k], seed=7 + k)
        for name in batch.series:
            np.testing.assert_array_equal(batch[name].value[k], alone[name]["value"])
    few = simulate_many(graph_, inputs, [7, 8, 9], engine=engine, dtype=dtype, init=init, keep=["told"])
    assert set(few.series) == {"told"}
    np.testing.assert_array_equal(few["told"].value, batch["told"].value)


@pytest.mark.parametrize("engine", ENGINES)
def test_float32_is_computed_between_the_cuts_alone(engine):
    """The host sees and gives float64; the filter rounds every value to float32."""
    needs(engine)
    made = case(0)
    exact = simulate(made.graph, made.inputs, seed=3)
    found = simulate(made.graph, made.inputs, engine=engine, dtype="float32", seed=3)
    height = found["height"]["value"]
    assert height.dtype == np.float64
    np.testing.assert_array_equal(height, height.astype(np.float32))
    off = np.abs(height - exact["height"]["value"])
    assert 0.0 < off.max() < 1e-5
    np.testing.assert_array_equal(found["told"]["value"], [round(float(x), 6) for x in height])
    assert not np.array_equal(found["told"]["value"], found["told"]["value"].astype(np.float32))


@pytest.fixture
def installed(monkeypatch):
    """`mixed` beside the installed graphs."""
    real = registry._entries

    class Entry:
        name = "mixed"

        def load(self):
            return mixed

    monkeypatch.setattr(
        registry,
        "_entries",
        lambda group: [*real(group), *([Entry()] if group == "flowgraph.graphs" else [])],
    )


def study(engine: str, **more: Any) -> Study:
    parameters = {**FLIGHT, "gain": [0.1, 0.4]}
    return Study(graphs=["mixed"], data=["sim"], seeds=3, engine=engine, parameters=parameters, **more)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_study_of_a_graph_with_host_blocks(engine, installed, tmp_path):
    """As in Python, whatever the chunk; in float32 near it."""
    needs(engine)
    python = run_study(study("python"), tmp_path / "python")
    found = run_study(study(engine, chunk=4), tmp_path / "found")
    small = run_study(study(engine, dtype="float32", chunk=1), tmp_path / "small")
    assert len(python.rows) == 6
    assert not [*python.failed, *found.failed, *small.failed]
    assert len({row["height"] for row in python.rows}) == 6
    for a, b, c in zip(python.rows, found.rows, small.rows, strict=True):
        for name in ("height", "told"):
            assert b[name] == pytest.approx(a[name], rel=1e-9, abs=1e-12)
            assert c[name] == pytest.approx(a[name], rel=1e-5)
        assert c["height"] != b["height"]
        assert a["ticks"] == b["ticks"] == c["ticks"]


def test_a_changed_host_block_is_another_key(installed, monkeypatch):
    """The pipeline does not know it; its setting and its module's code are in the key all the same."""
    described = digests.python_digest(case(0).graph)
    assert described == digests.python_digest(case(1).graph) != ""
    assert described != digests.python_digest(case(0, grain=0.5).graph)
    assert described == digests.python_digest(case(0, gain=0.5).graph)  # that is in the pipeline
    assert digests.python_digest(case(0).graph, every=True) != digests.python_digest(
        case(0, gain=0.5).graph, every=True
    )
    first = {r.key for r in execution.plan(study("reference")).runs}
    assert {r.key for r in execution.plan(study("reference")).runs} == first
    code = digests.code_digest
    monkeypatch.setattr(
        digests,
        "code_digest",
        lambda f: "changed" if getattr(f, "__name__", "") == "told" else code(f),
    )
    assert not first & {r.key for r in execution.plan(study("reference")).runs}


def test_a_setting_that_holds_itself_counts_by_its_kind():
    """Such as the figure that a display draws on."""

    class Figure:
        def __init__(self):
            self.axes = [self]

    @block(host=True)
    def show(x: Scalar, *, on: Any) -> Scalar:
        return x

    @graph
    def shown(x: Stream[Scalar], *, on: Any):
        return {"x": show(x, on=on)}

    described = digests.python_digest(shown.build(on=Figure()))
    assert described == digests.python_digest(shown.build(on=Figure()))
    assert described != digests.python_digest(shown.build(on=object))


@pytest.mark.parametrize("engine", ENGINES)
def test_a_graph_of_host_blocks_alone_is_refused_run_by_run(engine, tmp_path):
    """PnP alone has nothing to accelerate: each row names the block and the engine that runs it."""
    pytest.importorskip("cv2")
    made = find_graph("tag_pose").case(load_flight("course", settings={"duration": "0.3"}))
    with pytest.raises(LoweringError, match="pnp: a host block cannot be lowered"):
        lower(made.graph)
    with pytest.raises(LoweringError, match='engine="python"'):
        simulate_many(made.graph, made.inputs, [0, 1], engine=engine)
    poses: dict[str, Any] = {
        "graphs": ["tag_pose"],
        "data": ["course"],
        "seeds": 2,
        "parameters": {"duration": 0.3},
    }
    found = run_study(Study(**poses, engine=engine), tmp_path / engine)
    assert len(found.failed) == 2
    assert all("pnp: a host block cannot be lowered" in row["error"] for row in found.rows)
    assert all('engine="python"' in row["error"] for row in found.rows)
    python = run_study(Study(**poses), tmp_path / "python")
    assert not python.failed
    assert all(row["position_rmse_m"] < 0.05 for row in python.rows)
