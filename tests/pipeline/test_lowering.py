"""Lowering: what becomes of a graph's parts, and the places that refusals name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import (
    LoweringError,
    Scalar,
    Stream,
    block,
    delay,
    every,
    graph,
    latest,
    lower,
    match,
    merge,
    periodic,
    real,
    sink,
    zip,
)
from flowgraph.pipeline.program import specialise


@block
def add(a, b):
    return a + b


@block
def corrected(x: Scalar, z: Scalar | None) -> Scalar:
    return x if z is None else x + z


@graph
def loop(x: Stream[Scalar], z: Stream[Scalar]):
    """A loop with an option."""
    belief = delay(1.0, name="belief")
    held = latest(x, init=0.0, name="held")
    now = corrected(add(belief, held, at=x | z), z)
    belief.feed(now)
    return {"now": now}


def test_a_graph_is_lowered_once():
    built = loop.build()
    assert lower(built) is lower(built)


def test_ports_registers_and_stages_keep_their_names():
    pipeline = lower(loop.build(x=periodic("5ms")))
    assert (pipeline.name, pipeline.doc) == ("loop", "A loop with an option.")
    assert [p.name for p in pipeline.inputs] == ["x", "z"]
    assert [p.name for p in pipeline.outputs] == ["now"]
    assert pipeline.inputs[0].clock == "x: 200 Hz"
    assert {(r.path, r.role) for r in pipeline.registers} == {("belief", "delay"), ("held", "latest")}
    assert {"add", "corrected", "held", "belief"} <= {s.path for s in pipeline.stages}


def test_registers_carry_reset_shape_unit_and_frame():
    metres = real(3, unit="m", frame="world")

    @graph
    def g(x: Stream[metres]):  # type: ignore[valid-type]
        return x.delay(np.array([1.0, 2.0, 3.0]), name="memory").at(x)

    (register,) = lower(g.build()).registers
    (cell,) = register.cells
    assert (cell.shape, cell.dtype, cell.unit, cell.frame) == ((3,), "real", "m", "world")
    assert cell.reset.tolist() == [1.0, 2.0, 3.0]


def test_values_are_assigned_once_and_before_use():
    pipeline = lower(loop.build())
    known = {pipeline.time, *pipeline.constants}
    known |= {leaf.value for p in pipeline.inputs for leaf in p.leaves} | {p.present for p in pipeline.inputs}
    known |= {c.read for r in pipeline.registers for c in r.cells}
    for i in pipeline.instructions:
        assert set(i.args) <= known
        assert i.out not in known
        known.add(i.out)
    assert {c.write for r in pipeline.registers for c in r.cells} <= known
    assert {s.enable for s in pipeline.stages} <= known


def test_instructions_name_the_line_of_the_block():
    lines = {i.line for i in lower(loop.build()).instructions if i.op == "add"}
    assert lines == {
        f"{__name__}:{add.step.__code__.co_firstlineno + 2}",
        f"{__name__}:{corrected.step.__code__.co_firstlineno + 2}",
    }


def test_specialising_folds_presence_away():
    pipeline = lower(loop.build())
    nothing, only_x, both = (specialise(pipeline, key) for key in (0, 1, 3))
    assert nothing.instructions == ()
    assert nothing.writes == tuple(c.read for r in pipeline.registers for c in r.cells)
    assert nothing.outputs == ((None, ()),)
    assert [i.op for i in only_x.instructions] == ["add"]
    assert [i.op for i in both.instructions] == ["add", "add"]
    assert {"where", "logical_or"} <= {i.op for i in specialise(pipeline, None).instructions}


def test_totals_and_latency():
    @graph
    def g(x: Stream[real(3)]):  # type: ignore[valid-type]
        return x.map(lambda v: (v + v) * v)

    pipeline = lower(g.build())
    totals = pipeline.totals()
    assert (totals["instructions"], totals["operations"], totals["critical_path"]) == (2, 6, 2)
    assert pipeline.latency() == {"x": 2}


def test_queues_have_constant_sizes_and_name_their_fault():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return {
            "m": match(x, y, tolerance=1, size=3, name="m"),
            "z": zip(every(3, x), every(3, x, phase=1), name="z"),
        }

    pipeline = lower(g.build())
    assert {(f.path, f.bound) for f in pipeline.faults} == {("m", 3), ("z", 1)}
    cells = {c.name: c.shape for r in pipeline.registers for c in r.cells if r.path == "m.state"}
    assert cells["a.items.0"] == (4,)


def test_a_host_block_inside_is_refused_by_name():
    @block(host=True)
    def camera(x: Scalar) -> Scalar:
        return x

    @graph
    def part(x: Stream[Scalar]):
        return camera(x)

    @graph
    def g(x: Stream[Scalar]):
        return part(x)

    with pytest.raises(LoweringError, match="part/camera: a host block cannot be lowered") as error:
        lower(g.build())
    assert "outside the lowered graph" in str(error.value.fix)


def test_a_sink_is_a_host_block():
    @graph
    def g(x: Stream[Scalar]):
        sink(x, print, name="printer")
        return x

    with pytest.raises(LoweringError, match="printer: a host block cannot be lowered"):
        lower(g.build())


def test_a_step_that_cannot_be_recorded_names_path_and_line():
    @block
    def odd(x: Scalar, z: Scalar | None) -> Scalar:
        if z is None:
            return x
        return x if x > 0.0 else z

    @graph
    def g(x: Stream[Scalar]):
        return odd(x, every(2, x))

    line = odd.step.__code__.co_firstlineno + 4
    with pytest.raises(LoweringError) as error:
        lower(g.build())
    assert error.value.path == f"odd ({__name__}:{line})"


def test_a_merge_of_arrays_selects_by_presence():
    @graph
    def g(x: Stream[real(2, 2)], y: Stream[real(2, 2)]):  # type: ignore[valid-type]
        return merge(x, y, tie="right")

    pipeline = lower(g.build())
    assert {i.spec.shape for i in pipeline.instructions if i.op == "where"} == {(2, 2)}
    time = np.array([0, 10])
    data: Any = {"x": (time, np.zeros((2, 2, 2))), "y": (time[1:], np.ones((1, 2, 2)))}
    assert pipeline.run(data).output.value[:, 0, 0].tolist() == [0.0, 1.0]
