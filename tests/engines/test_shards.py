"""Runs and particles shared out among devices: four of one processor, which JAX must be told of first."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from flowgraph import (
    DeclarationError,
    Scalar,
    Stream,
    block,
    delay,
    graph,
    simulate,
    simulate_many,
)
from flowgraph.engines.options import RunOptions

pytest.importorskip("jax")

LIBRARY = """
import numpy as np
from flowgraph import (
    Array, DeclarationError, Scalar, Signal, Stream, block, delay, find_graph, graph, latest, load_flight,
    lower, real, simulate, simulate_many,
)
from flowgraph.blocks.particles.resampling import ancestor_index
from flowgraph.engines.xla.devices import Devices
from flowgraph.engines.xla.scan import Scan
from flowgraph.pipeline.optimise import ARRAYS


class Points(Signal):
    "Points on a line, one a particle."

    place: Array = real("particles")


@block
def followed(before: Points, seen: Scalar, *, draw, xp) -> Points:
    "Points that have walked, drawn anew by how near they are to what is seen."
    walked = before.place + draw.normal("step", before.place.shape)
    near = xp.exp(-0.5 * (walked - seen) ** 2) + 1e-12
    chosen = ancestor_index(near / xp.sum(near), scheme="systematic", draw=draw, xp=xp)
    return Points(place=xp.take(walked, chosen, axis=-1))


@block
def middle(points: Points, *, xp) -> Scalar:
    return xp.mean(points.place)


@graph
def follower(seen: Stream[Scalar], rare: Stream[Scalar], *, size):
    points = delay(Points(place=np.zeros(size)), name="points")
    after = followed(points, seen)
    points.feed(after)
    return {"points": after, "middle": middle(after), "rare": rare.filter(lambda x: x > 0.0)}


@graph
def doubled(seen: Stream[Scalar], rare: Stream[Scalar]):
    return {"out": seen.map(lambda x: 2.0 * x) + latest(rare, init=0.5)}


def given(seed):
    rare = np.random.default_rng(seed).normal(size=5)
    return {"seen": (np.arange(20), np.sin(np.arange(20.0) + seed)), "rare": (np.arange(5) * 3, rare)}


def same(ours, theirs):
    for name, series in ours.items():
        for leaf, array in series.leaves.items():
            other = theirs[name].leaves[leaf]
            assert array.shape == other.shape and array.dtype == other.dtype, (name, leaf)
            if array.dtype.kind == "f":
                assert np.abs(array - other).max() <= 1e-9 * max(1.0, np.abs(other).max()), (name, leaf)
            else:
                assert np.array_equal(array, other), (name, leaf)
"""

EQUAL = """
built = follower.build(size=48)

# five runs: in chunks of two on one device; of three, of four, and of two by two on several
for inputs, shards in (
    (given, ({"runs": 3}, {"runs": 2, "particles": 2})), (given(0), ({"runs": 4}, {"particles": 4})),
):
    one = simulate_many(built, inputs, range(5), runs_at_once=2)
    kept = len(set(one["points"].place[0, -1].round(9).tolist()))
    assert 5 < kept < 48, kept  # some particles were taken more than once
    for shard in shards:
        many = simulate_many(built, inputs, range(5), runs_at_once=2, shard=shard)
        same(many.series, one.series)
        for k in range(5):
            assert np.array_equal(many["rare"].run(k).value, one["rare"].run(k).value)

alone = simulate(built, given(3), engine="xla", seed=3)
parted = simulate(built, given(3), engine="xla", seed=3, shard={"particles": 4})
same(parted.series, alone.series)
places = (run.state["registers"]["points"]["place"] for run in (alone, parted))
assert np.allclose(*places, rtol=1e-9, atol=1e-9)

# what goes over all ticks at once is shared out likewise
single = doubled.build()
for inputs in (given, given(0)):
    one = simulate_many(single, inputs, range(4), engine="xla")
    many = simulate_many(single, inputs, range(4), engine="xla", shard={"runs": 2})
    same(many.series, one.series)
    for seed in range(4):
        alone = simulate(single, inputs if isinstance(inputs, dict) else inputs(seed))
        same({"out": many["out"].run(seed)}, alone.series)
assert all(scan._parts is not None for scan in lower(single).__dict__["_batched"].values())

# registers lie apart, and runs tell one another nothing
pipeline = lower(built)
for shard, expected in (({"runs": 4}, (1, 48)), ({"particles": 4}, (4, 12))):
    devices = Devices(pipeline, shard)
    scan = Scan(pipeline, (3,), np.dtype("float64"), 8, runs=4, passes=ARRAYS, devices=devices)
    cells = [np.stack([c.reset] * 4) for r in pipeline.registers for c in r.cells]
    seeds = np.zeros((4, 2), np.uint32)
    columns = [[np.zeros((8, *leaf.shape)) for leaf in port.leaves] for port in pipeline.inputs]
    scan.compile(cells, seeds, columns)
    text = scan._compiled.as_text()
    told = any(word in text for word in ("all-gather", "all-reduce", "all-to-all", "-permute"))
    assert told == ("particles" in shard), shard
    with scan.jax.enable_x64(True):
        after, _ = scan._compiled(tuple(cells), seeds, scan._buffers(columns).arrays)
    shards = after[0].addressable_shards
    assert len({part.device for part in shards}) == 4
    assert {part.data.shape for part in shards} == {expected}, shard


def refused(built, **options):
    try:
        simulate(built, given(0), engine="xla", **options)
    except DeclarationError as error:
        return str(error)
    raise AssertionError("not refused")


told = refused(follower.build(size=10), shard={"particles": 5})
assert "there are not so many devices" in told and "4 or fewer" in told, told
told = refused(built, seeds=[0], shard={"runs": 4, "particles": 2})
assert "=8, set before JAX is imported" in told, told
told = refused(follower.build(size=50), shard={"particles": 4})
assert "50 particles are not shared out evenly" in told and "with 52, or ask for 2" in told, told
"""

FILTERS = """
flight = load_flight("sim", settings={"duration": "2"})
for name, settings, shards in (
    ("rbpf_indoor", {"particles": 200}, ({"runs": 3}, {"particles": 4}, {"runs": 2, "particles": 2})),
    ("rbpf_indoor", {"particles": 600}, ({"particles": 4},)),  # so many are played in turns, row by row
    ("ins_eskf", {}, ({"runs": 4},)),
):
    made = find_graph(name).case(flight, **settings)
    one = simulate_many(made.graph, made.inputs, range(5), runs_at_once=4)
    if name == "rbpf_indoor":
        assert one["ancestors"].resampled.sum() > 5
    for shard in shards:
        same(simulate_many(made.graph, made.inputs, range(5), runs_at_once=4, shard=shard).series, one.series)

from tests.bench import gpu

rows = gpu.main(["--particles", "52", "--seconds", "0.1", "--repeats", "1"])
assert [(r["devices"], r["shared"], r["runs"]) for r in rows] == [
    (1, None, 1), (4, "particles", 1), (4, "runs", 4)
]
assert all(0 < r["of_bandwidth"] < 1 and r["us_per_tick"] > 0 for r in rows)
"""


def on_four_devices(program: str) -> None:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    root = str(Path(__file__).parents[2])
    here = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": root}
    with TemporaryDirectory() as folder:
        file = Path(folder) / "program.py"  # a block is recorded from a file
        file.write_text(LIBRARY + program)
        done = subprocess.run(
            [sys.executable, str(file)], env=here, capture_output=True, text=True, check=False
        )
    assert done.returncode == 0, done.stderr


def test_four_devices_give_what_one_gives():
    on_four_devices(EQUAL)


@pytest.mark.slow
def test_filters_on_four_devices_give_what_one_gives():
    on_four_devices(FILTERS)


@graph
def summed(x: Stream[Scalar]):
    total = delay(0.0, name="total")
    after = total + x
    total.feed(after)
    return after


GIVEN = {"x": ([0, 1], [1.0, 2.0])}


def test_one_device_is_a_share_too():
    built = summed.build()
    assert simulate_many(built, GIVEN, [0, 1, 2], shard={"runs": 1}).series["output"].value.tolist() == [
        [1.0, 3.0]
    ] * 3  # fmt: skip
    assert simulate(built, GIVEN, engine="xla", shard={}).output.value.tolist() == [1.0, 3.0]


def test_what_cannot_be_shared_out_is_refused():
    built = summed.build()
    with pytest.raises(DeclarationError, match="a run by itself is no runs"):
        simulate(built, GIVEN, engine="xla", shard={"runs": 1})
    with pytest.raises(DeclarationError, match="no axis of this name") as caught:
        simulate(built, GIVEN, engine="xla", shard={"particles": 1})
    assert (caught.value.got, caught.value.expected) == ("particles", "runs")
    with pytest.raises(DeclarationError, match="there are not so many devices"):
        simulate_many(built, GIVEN, [0], shard={"runs": 1000})
    for engine in ("python", "reference", "numpy", "c"):
        with pytest.raises(DeclarationError, match="shares nothing out"):
            simulate(built, GIVEN, engine=engine, shard={"runs": 2})
    for wrong in (4, ["runs"], {"runs": 0}, {"runs": True}, {"runs": 2.0}, {1: 2}):
        with pytest.raises(DeclarationError, match="a number of devices for each axis"):
            RunOptions(engine="xla", shard=wrong)  # type: ignore[arg-type]


@block(host=True)
def printed(x: Scalar) -> Scalar:
    return x


@graph
def hosted(x: Stream[Scalar]):
    return printed(x.map(lambda v: 2.0 * v))


def test_a_graph_with_a_host_block_shares_no_runs_out():
    """Its runs go one by one, so that there are none to share."""
    with pytest.raises(DeclarationError, match="a run by itself is no runs") as caught:
        simulate_many(hosted.build(), GIVEN, [0], shard={"runs": 1})
    assert "with host blocks a graph runs one by one" in str(caught.value.fix)
