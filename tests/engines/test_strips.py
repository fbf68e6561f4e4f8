"""Lines over many lanes in strips: to the bit what they are over all, and in memory that is used again."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Scalar, Stream, find_graph, graph, scan, simulate
from flowgraph.blocks.flights import simulated
from flowgraph.engines.python import loop, strips
from flowgraph.engines.python.plan import compiled
from flowgraph.engines.python.strips import Rooms, Strips, Sum, Together, Whole, by_columns, halves, parts
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction
from tests.support import same_state


@pytest.fixture
def short(monkeypatch):
    """Strips of at most 160 lanes: more than NumPy adds in one go."""
    monkeypatch.setattr(strips, "LANES", 160)
    monkeypatch.setattr(strips, "LEAST", 300)
    forget = [parts.cache_clear, by_columns.cache_clear]
    for clear in forget:
        clear()
    yield
    for clear in forget:
        clear()


@pytest.mark.parametrize("count", [12_800, 12_801, 30_000, 50_001, 99_999, 123_456])
def test_strips_are_the_halves_in_which_numpy_adds(count):
    ends = halves(count)
    assert ends[-1] == count
    assert sorted(set(ends)) == ends
    assert max(np.diff([0, *ends])) <= strips.LANES
    whole = np.random.default_rng(count).standard_normal((3, 2, count)) * 1e3
    for array in (whole, whole.transpose(1, 0, 2), whole[:, :1], whole[0, 0]):
        for keepdims in (False, True):
            total = Sum(count, Rooms(), keepdims)
            for at in parts(count):
                total(at, array[at])
            np.testing.assert_array_equal(total.whole, np.add.reduce(array, -1, keepdims=keepdims))


def test_a_sum_of_lanes_that_lie_apart_is_numpys_too():
    count = 40_000
    columns = np.random.default_rng(0).standard_normal((count, 3)).T * 1e3
    total = Sum(count, Rooms(), False)
    for at in parts(count):
        total(at, columns[at] * 1.0)
    np.testing.assert_array_equal(total.whole, np.add.reduce(columns * 1.0, -1))


@pytest.mark.parametrize("turned", [(0, 1, 2), (1, 0, 2), (2, 1, 0), (2, 0, 1)])
def test_what_is_put_together_lies_as_its_parts_do(turned):
    count = 30_001
    whole = np.random.default_rng(0).standard_normal([(4, 3, count)[a] for a in turned])
    array = whole.transpose([turned.index(axis) for axis in range(3)])
    assert array.shape == (4, 3, count)
    held = Together(count, Rooms())
    for at in parts(count):
        part = np.multiply(array[at], 2.0, held.room(at))
        held(at, part)
    np.testing.assert_array_equal(held.whole, array * 2.0)
    assert held.whole.strides == (array * 2.0).strides


def test_a_room_is_used_again_once_nobody_holds_what_lay_there():
    rooms = Rooms()
    first = rooms.take((3, 100), np.float64)
    assert not np.shares_memory(first, rooms.take((3, 100), np.float64))
    kept, where = first[1:, ::2].T, first.ctypes.data
    del first
    again = [rooms.take((300,), np.float64) for _ in range(3)]
    assert not any(np.shares_memory(kept, a) for a in again)
    kept[:] = 7.0
    del kept, again
    assert rooms.take((3, 100), np.float64).ctypes.data == where
    held = rooms.take((2400,), np.bool_)
    rooms.only({2400: 1})
    assert len(rooms._by_size[2400]) == 2  # one that is held, and one
    rooms.only({})
    assert len(rooms._by_size[2400]) == 1
    assert held.shape == (2400,)


@pytest.mark.parametrize(("name", "flight"), [("rbpf_indoor", ""), ("rbpf_outdoor", "thesis")])
@pytest.mark.parametrize("particles", [300, 321, 1000])
def test_a_cloud_in_strips_has_the_bits_of_one_that_is_not(name, flight, particles, short, monkeypatch):
    sensors = {"sensors": "imu,gps,altimeter"} if flight else {}
    flown = simulated.load(flight, settings={"duration": 0.6, **sensors})
    written = []

    def noted(graph, text, *more):
        written.append(text)
        return compiled(graph, text, *more)

    monkeypatch.setattr(loop, "compiled", noted)

    def run(engine):
        case = find_graph(name).case(flown, particles=particles)
        return simulate(case.graph, case.inputs, engine=engine, seed=2)

    found = run("python")
    assert f"for at in parts_{particles}:" in written[0]
    plain = run("reference")
    monkeypatch.setattr(strips, "LEAST", 10**9)
    whole = run("python")
    assert "for at in" not in written[1]
    for stream, series in found.series.items():
        for leaf, values in series.leaves.items():
            np.testing.assert_array_equal(values, whole.series[stream].leaves[leaf])
            np.testing.assert_array_equal(values, plain.series[stream].leaves[leaf])
    same_state(found.state, whole.state)


def test_what_is_collected_stays_though_rooms_are_used_again(short):
    size, ticks = 400, 9

    @graph
    def g(x: Stream[Scalar]):
        rows = scan(x, lambda y, x, xp: xp.sin(y + x) * 2.0 - y, init=np.arange(2.0 * size).reshape(2, size))
        return {"out": rows}

    inputs = {"x": (np.arange(ticks), np.arange(float(ticks)))}
    found, plain = (simulate(g.build(), inputs, engine=e)["out"].value for e in ("python", "reference"))
    np.testing.assert_array_equal(found, plain)
    assert len(np.unique(found[:, 0, 0])) == ticks


def test_a_thousand_strips_after_one_another_are_written_as_one_is(short):
    """Each goes over what a sum of the strip before it was needed for, and over a line left out as if it was
    not there."""
    lines, known, size = list[str](), dict[int, Whole](), 400

    def add(op, *args, axis=None):
        shapes = tuple((size,) if a.startswith(("x", "w")) and a not in sums else () for a in args)
        out, attrs = len(lines), {} if axis is None else {"axis": axis}
        spec = Spec(() if op == "sum" else (size,), "real")
        known[out] = Whole(Instruction(op, (), attrs, out, spec, ""), args, shapes)
        lines.append(f"    w0_{out} = {op}({', '.join(args)})")
        if op == "sum":
            sums.add(f"w0_{out}")
        return f"w0_{out}"

    value, sums = "x0_0", set[str]()
    for _ in range(1100):
        value = add("cos", add("tanh", value))
        lines.append("    pass")
        value = add("sin", value)
        value = add("divide", value, add("sum", value, axis=-1))
    lines.append(f"    c0({value})")
    made = [line for line, _ in Strips(lines, known).made]
    assert sum(line.startswith("    for at in parts_400:") for line in made) == 1100
    assert len(made) < 20 * 1100
