"""The one loop of pipelines: turns around a ring, in NumPy, in a description, in C and in XLA."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    LoweringError,
    Pipeline,
    Signal,
    Stream,
    block,
    delay,
    graph,
    lower,
    real,
    simulate,
)
from flowgraph.errors import PipelineError
from flowgraph.pipeline.costs.operations import depth, operations
from flowgraph.recorder.loop import Loop
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.replay import Body
from flowgraph.recorder.specs import Spec
from flowgraph.recorder.trace import Trace
from tests.support import all_engines


class Happened(Signal):
    """What happened at each place of a ring."""

    rows: Array = real(5, 3)


def instruction(value: int, op: str, args: list[int], shape: list[int], **attrs: Any) -> dict[str, Any]:
    return {"value": value, "op": op, "args": args, "shape": shape, "dtype": "real", "line": "here"} | (
        {"attrs": attrs} if attrs else {}
    )


PART = instruction(2, "getitem", [1], [2], index=[[1, 3, None]])
ADDED = {"constants": [], "instructions": [PART, instruction(3, "add", [0, 2], [2])], "result": 3}
HALVED = {
    "constants": [{"value": 4, "shape": [], "dtype": "real", "data": 0.5}],
    "instructions": [instruction(3, "multiply", [0, 4], [2])],
    "result": 3,
}
BODY = Body({"cases": [ADDED, HALVED]})
RING = np.arange(10.0).reshape(5, 2)
ROWS = np.array([[0, 1, 10], [1, 2, 20], [0, 3, 30], [1, 4, 40], [7, 5, 50.0]])


def by_hand(history: np.ndarray, first: int, count: int) -> np.ndarray:
    found = history.copy()
    for k in range(first, first + count):
        before, row = found[(k - 1) % 5], ROWS[k % 5]
        found[k % 5] = before + row[1:] if row[0] < 1 else 0.5 * before
    return found


@pytest.mark.parametrize(("first", "count"), [(0, 0), (0, 1), (3, 4), (4, 5), (2, 1)])
def test_turns_go_around_the_ring_in_all_engines(first, count):
    """Once where the history lies, and once beside it, where it is read elsewhere too."""

    @block
    def turned(history: Any, happened: Any, *, loop: Any, first: int, count: int, xp: Any):
        rows = happened.rows
        at = xp.astype(rows[0, 0] * 0.0, xp.int32)
        return loop(history, rows, at + np.int32(first), at + np.int32(count), xp=xp)

    @graph
    def kept(rows: Stream[Happened]):
        history = delay(RING, name="history")
        new = turned(history, rows, loop=Loop(BODY), first=first, count=count)
        history.feed(new)
        beside = turned(history, rows, loop=Loop(BODY), first=first, count=count, name="beside")
        other = delay(RING, name="other")
        alone = turned(other, rows, loop=Loop(BODY), first=first, count=count, name="alone")
        other.feed(alone)
        return {"new": new, "beside": beside, "alone": alone}

    found = all_engines(kept.build(), {"rows": (np.arange(2), Happened(rows=np.stack([ROWS, ROWS])))})
    once = by_hand(RING, first, count)
    for name in ("new", "beside", "alone"):
        np.testing.assert_array_equal(found[name].value, [once, by_hand(once, first, count)])


def recorded(body: Any, rows: Spec | None = None) -> Any:
    trace = Trace()
    at, history = trace.input(Spec((), "int32")), trace.input(Spec((5, 2), "real"))
    return trace.apply("replay", history, trace.input(rows or Spec((5, 3), "real")), at, at, body=body)


def changed(**parts: Any) -> Body:
    case = copy.deepcopy(ADDED) | parts
    return Body({"cases": [case]})


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (Body({"cases": []}), "has no case"),
        (Body({}), "malformed"),
        (changed(result=9), "a turn of replay gives None"),
        (
            changed(result=2, instructions=[instruction(2, "getitem", [1], [3], index=[[0, 3, None]])]),
            "gives Spec",
        ),
        (changed(instructions=[instruction(3, "fly", [0], [2])]), "cannot do fly"),
        (changed(instructions=[instruction(3, "replay", [0], [2])]), "cannot do replay"),
        (changed(instructions=[instruction(3, "add", [0, 8], [2])]), "cannot do add"),
        (changed(instructions=[instruction(3, "add", [0, 0], [3])]), "add in a turn of replay gives"),
        (3, "is no mapping"),
    ],
)
def test_a_body_that_is_none_is_refused(body, said):
    with pytest.raises(LoweringError, match=said):
        recorded(body)


def test_arguments_that_do_not_fit_are_refused():
    with pytest.raises(LoweringError, match="a row for each place"):
        recorded(BODY, rows=Spec((4, 3), "real"))
    with pytest.raises(LoweringError, match="history and rows of reals"):
        recorded(BODY, rows=Spec((5, 3), "int32"))


def test_a_turn_that_was_changed_in_a_file_is_refused(tmp_path):
    @block
    def turned(happened: Happened, *, loop: Any, xp: Any) -> Array:
        rows = happened.rows
        at = xp.astype(rows[0, 0], xp.int32)
        return loop(RING + rows[0, 0], rows, at, at + np.int32(2), xp=xp)

    @graph
    def made(rows: Stream[Happened]):
        return turned(rows, loop=Loop(BODY))

    built = made.build()
    plain = lower(built).to_json()
    inputs = {"rows": (np.arange(1), Happened(rows=ROWS[None]))}
    wanted = simulate(built, inputs).output.value
    np.testing.assert_array_equal(Pipeline.from_json(plain).run(inputs).output.value, wanted)
    broken = copy.deepcopy(plain)
    for stage in broken["stages"]:
        for i in stage["instructions"]:
            if i["op"] == "replay":
                i["attrs"]["body"]["cases"][0]["result"] = 77
    with pytest.raises(PipelineError, match="does not fit its arguments"):
        Pipeline.from_json(broken)


def test_a_replay_costs_its_longest_turn_for_each_place():
    trace = Trace()
    history, rows = trace.input(Spec((5, 2), "real")), trace.input(Spec((5, 3), "real"))
    at = trace.input(Spec((), "int32"))
    trace.apply("replay", history, rows, at, at, body=BODY)
    specs = {0: history.spec, 1: rows.spec, 2: at.spec}
    (i,) = trace.instructions
    assert dict(operations(i, specs)) in ({"add": 10}, {"multiply": 10})
    assert depth(i, specs) == 5


def test_numbers_play_at_once():
    loop = Loop(BODY)
    found = loop(RING, ROWS, np.int32(3), np.int32(4), xp=NUMPY)
    np.testing.assert_array_equal(found, by_hand(RING, 3, 4))
    assert RING.tolist() == np.arange(10.0).reshape(5, 2).tolist()
