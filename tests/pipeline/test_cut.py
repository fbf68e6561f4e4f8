"""The cut between the host and the pipeline: what goes where, one answer in each engine, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    ClockError,
    DataError,
    LoweringError,
    Pipeline,
    Scalar,
    Stream,
    block,
    collect,
    delay,
    every,
    find_graph,
    graph,
    latest,
    load_flight,
    lower,
    simulate,
    simulate_many,
    sink,
    when,
)
from flowgraph.blocks.signals import Imu, Tags
from flowgraph.data.inputs import clocks_of
from flowgraph.engines.c.harness import write_events
from flowgraph.engines.state import load_state, save_state
from flowgraph.errors import PipelineError
from flowgraph.graphs import ins_ukf_pose, tag_pose
from tests.graphs.estimation import compare
from tests.support import MS, same, scalars

CUT_ENGINES = ("reference", "xla", "c")


@block(host=True)
def camera(x: Scalar) -> Scalar | None:
    """Every value but those from a table: no array-API operation."""
    return when(float(x) not in {3.0, 4.0}, np.asarray(2.0 * float(x)))


@block(host=True)
def looked_up(x: Scalar) -> Scalar:
    return {0.0: 1.0}.get(float(x), float(x) + 0.5)


@block
def double(x: Scalar) -> Scalar:
    return 2.0 * x


@block
def mixed(a: Scalar, b: Scalar) -> Scalar:
    return a + b


def whole(seen: list[float]):
    """A camera on every second image, a filter, and a sink and a table after it."""

    @graph
    def flight(imu: Stream[Scalar], image: Stream[Scalar]):
        found = camera(double(every(2, image), name="scaled"), name="camera")
        memory = delay(0.0, name="memory")
        held = latest(found, init=0.0, at=imu | found, name="held")
        control = latest(imu, init=0.0, at=imu | found, name="control")
        out = mixed(mixed(control, held, name="sum"), memory, name="out")
        memory.feed(out * 0.5)
        sink(out, lambda v: seen.append(float(v)), name="display")
        collect(found, "found")
        collect(looked_up(out, name="table"), "table")
        return {"out": out}

    return flight.build()


def data():
    return {
        "imu": scalars(np.arange(20) * 5 * MS, np.sin(np.arange(20.0))),
        "image": scalars(np.arange(1, 9) * 11 * MS, np.arange(8.0) * 0.75),
    }


def test_the_pipeline_says_what_stays_on_the_host(tmp_path):
    pipeline = lower(whole([]))
    sides = {h.path: h.side for h in pipeline.host}
    assert {
        "scaled": "before",
        "camera": "before",
        "display": "after",
        "table": "after",
    }.items() <= sides.items()
    by_path = {h.path: h for h in pipeline.host}
    assert by_path["camera"].feeds == ("camera",)
    assert by_path["scaled"].feeds == ()
    assert by_path["table"].reads == ("out",)
    assert by_path["camera"].line.startswith(f"{__name__}:")
    assert {p.name for p in pipeline.inputs} == {"imu", "camera"}
    assert not {"scaled", "camera", "display", "table"} & {s.path for s in pipeline.stages}
    text = pipeline.listing()
    assert "on the host, before: camera (camera), feeds camera" in text
    assert "on the host, after: table (looked_up), reads out" in text
    read = Pipeline.load(pipeline.save(tmp_path / "p"))
    assert read.host == pipeline.host
    plain = pipeline.to_json()
    del plain["host"]
    assert Pipeline.from_json(plain).host == ()
    plain["host"] = [{"path": "camera", "side": "beside"}]
    with pytest.raises(PipelineError, match="host"):
        Pipeline.from_json(plain)


@pytest.mark.parametrize("engine", CUT_ENGINES)
def test_each_engine_runs_both_sides(engine):
    """Outputs, times, registers, ticks: as in Python; the display has seen each value in order."""
    if engine == "xla":
        pytest.importorskip("jax")
    here: list[float] = []
    there: list[float] = []
    same(simulate(whole(here), data()), simulate(whole(there), data(), engine=engine), exact=False)
    assert len(here) > 20
    np.testing.assert_allclose(there, here, rtol=1e-12)


def test_a_run_goes_on_from_its_state(tmp_path):
    built, events = whole([]), data()
    split = 47 * MS
    early = {n: s[s.time <= split] for n, s in events.items()}
    late = {n: s[s.time > split] for n, s in events.items()}
    half = simulate(built, early, engine="reference")
    save_state(half.state, tmp_path / "state.npz")
    rest = simulate(built, late, engine="reference", state=load_state(tmp_path / "state.npz"))
    python = simulate(built, late, state=simulate(built, early).state)
    same(python, rest, exact=False)
    started = simulate(built, events, engine="reference", init={"memory": 3.0})
    same(simulate(built, events, init={"memory": 3.0}), started, exact=False)


def test_many_runs_have_the_host_in_each():
    built, events = whole([]), data()
    one = simulate(built, events)
    batch = simulate_many(built, events, [1, 2], engine="c")
    for k in range(2):
        np.testing.assert_allclose(batch["out"].run(k)["value"], one["out"]["value"], rtol=1e-12)


@pytest.mark.parametrize("engine", ["reference", "numpy"])
def test_what_the_accelerated_part_has_to_say_is_said(engine):
    @graph
    def g(x: Stream[Scalar]):
        return {"odd": x.map(lambda v: v**0.5), "table": looked_up(double(x))}

    built, given = g.build(), {"x": scalars(np.arange(4) * MS, np.array([1.0, 2.0, -1.0, 3.0]))}
    python, found = (simulate(built, given, engine=e, diverged="count") for e in ("python", engine))
    assert "odd are not finite, the first at t = 2000000 ns" in found.notes[0]
    assert (found.notes, found.stats) == (python.notes, python.stats)
    batch = simulate_many(built, given, [1, 2], engine=engine, keep=["odd"], diverged="count")
    assert list(batch.diverged) == [0, 1]
    assert not simulate_many(built, given, [1], engine=engine, keep=["table"], diverged="count").diverged


def test_a_pipeline_alone_needs_what_the_host_makes():
    built, events = whole([]), data()
    pipeline, found = lower(built), simulate(built, events)
    with pytest.raises(DataError, match=r"input 'camera' has no data[\s\S]*made on the host by camera"):
        pipeline.run({"imu": events["imu"]})
    alone = pipeline.run({"imu": events["imu"], "camera": found["found"]})
    np.testing.assert_array_equal(alone["out"]["value"], found["out"]["value"])


def test_values_of_the_host_at_the_clock_of_a_source():
    """The block has the source's own clock, and the source is read behind the cut as well."""

    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return mixed(looked_up(x), x), every(2, looked_up(y, name="other")) * 2.0

    events = {"x": scalars(range(5)), "y": scalars(range(2, 9))}
    built = g.build()
    same(simulate(built, events), simulate(built, events, engine="reference"))


@block(host=True)
def corners(x: Scalar) -> tuple[Scalar, Scalar]:
    return {0.0: 1.0}.get(float(x), float(x)), float(x) + 0.5


def test_inputs_of_one_clock_come_together(tmp_path):
    """Two outputs of a host block that the pipeline reads: without the graph, stamps must agree as well."""

    @graph
    def g(imu: Stream[Scalar], image: Stream[Scalar]):
        left, right = corners(image, name="corners")
        return mixed(imu, latest(mixed(left, right), init=0.0), name="out")

    built = g.build()
    events = {"imu": scalars(range(12)), "image": scalars(range(1, 12, 2))}
    pipeline = Pipeline.load(lower(built).save(tmp_path / "p"))
    first, second = (p.name for p in pipeline.inputs if p.name != "imu")
    times, seen = events["image"].time, events["image"]["value"]
    values = {first: scalars(times, seen), second: scalars(times, seen + 0.5)}
    alone = pipeline.run({"imu": events["imu"], **values})
    np.testing.assert_array_equal(alone["output"]["value"], simulate(built, events)["output"]["value"])
    for wrong in (values[second][:-1], scalars(times + 1, np.zeros(len(times)))):
        with pytest.raises(ClockError, match="have one clock and come apart") as caught:
            pipeline.run({"imu": events["imu"], **values, second: wrong})
        assert {repr(first), repr(second)} <= set(caught.value.message.split())
        assert caught.value.fix
        with pytest.raises(ClockError, match="come apart"):
            write_events(pipeline, {"imu": events["imu"], **values, second: wrong}, tmp_path / "e.csv")


# -- one graph from the tags to the belief -----------------------------------------------------------------


@pytest.mark.slow
def test_pnp_before_the_filter_in_one_graph():
    """Tags and IMU in, belief out: PnP stays on the host, the filter runs in XLA and in C."""
    made = load_flight("course", seed=1, settings={"duration": "0.4"})
    inputs = made.need("composed", "imu", "tags")
    alone = find_graph("ins_ukf_pose").case(made)
    settings = alone.graph.settings
    tap_seen: list[float] = []

    @graph
    def composed(imu: Stream[Imu], tags: Stream[Tags], *, start, noise, R):
        pose = tag_pose(
            tags,
            tag_map=made.info["tag_map"],
            camera=made.info["camera"],
            mount=made.info["mount"],
            pixel_noise=made.info.get("pixel_noise", 0.5),
        )["pose"]
        out = ins_ukf_pose(imu, pose, start=start, noise=noise, R=R)
        out["belief"].tap(lambda b: tap_seen.append(float(b.position[2])))
        return out

    built = composed.build(
        **clocks_of(inputs),
        sizes={"tags": inputs["tags"]["ids"].shape[1]},
        **{n: settings[n] for n in ("start", "noise", "R")},
    )
    pipeline = lower(built)
    assert {(h.path.split("/")[-1].split("(")[0], h.side) for h in pipeline.host} == {
        ("pnp", "before"),
        ("tap", "after"),
    }
    assert len(pipeline.inputs) == 2
    assert any("pnp" in p.name for p in pipeline.inputs)
    python = simulate(built, inputs)["belief"]
    compare(python, simulate(alone.graph, alone.inputs)["belief"])
    for engine in ("xla", "c"):
        if engine == "xla":
            pytest.importorskip("jax")
        tap_seen.clear()
        compare(python, simulate(built, inputs, engine=engine)["belief"])
        np.testing.assert_allclose(tap_seen, python["position"][:, 2], atol=1e-9)


# -- refusals ----------------------------------------------------------------------------------------------


def refused(body, *words: str) -> None:
    @graph
    def g(x: Stream[Scalar]):
        return body(x)

    with pytest.raises(LoweringError) as error:
        lower(g.build())
    text = str(error.value)
    for word in (*words, "expected:", "got:", "fix:"):
        assert word in text, text


def test_a_host_block_between_accelerated_blocks_is_refused():
    """`first` feeds the host and an accelerated block, so it cannot go to the host with it."""

    def body(x):
        first = double(x, name="first")
        return mixed(looked_up(first, name="inner"), first, name="last")

    line = looked_up.step.__code__.co_firstlineno
    refused(
        body,
        "inner: a host block has accelerated blocks on both sides",
        "first before it and last after it",
        f"{__name__}:{line}",
        'engine="python"',
    )


def test_a_host_block_in_a_cycle_is_refused():
    def body(x):
        memory = delay(0.0, name="memory")
        out = mixed(looked_up(memory, at=x, name="inner"), x, name="last")
        memory.feed(out)
        return mixed(out, x, name="result")

    line = looked_up.step.__code__.co_firstlineno
    refused(
        body,
        "inner: a host block is in a cycle with accelerated blocks",
        "last, which it reads and feeds",
        f"{__name__}:{line}",
        'engine="python"',
    )


def test_a_graph_of_host_blocks_alone_is_refused():
    line = looked_up.step.__code__.co_firstlineno
    refused(
        lambda x: looked_up(x, name="alone"), "alone: a host block cannot be lowered", f"{__name__}:{line}"
    )
