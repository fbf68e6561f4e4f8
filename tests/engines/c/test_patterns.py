"""Patterns of present inputs that share a reaction: which do, and that it gives what their own would."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest

from flowgraph import Array, Graph, Series, Signal, Stream, block, delay, graph, latest, lower, real, simulate
from flowgraph.blocks.flights import simulated
from flowgraph.data.inputs import prepare
from flowgraph.data.tape import tape
from flowgraph.engines.c import file, generate
from flowgraph.engines.c.patterns import LEAST, Pattern, shared
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.pipeline.program import specialise
from tests.engines.c.support import STRICT, ran
from tests.support import same


def driven(matrix: Any, by: Any, xp: Any) -> Any:
    """Work enough for a reaction of its own."""
    for _ in range(3):
        matrix = 0.1 * matrix @ matrix + by * xp.asarray(np.eye(8)) + 0.1
    return matrix


class Row(Signal):
    x: Array = real(8)


@block
def moved(before: real(8, 8), by: Row, *, xp: Any) -> real(8, 8):  # type: ignore[valid-type]
    return driven(before, by.x, xp)


@block
def aided(before: real(8, 8), by: Row | None, *, xp: Any) -> real(8, 8):  # type: ignore[valid-type]
    return before if by is None else driven(before, by.x, xp)


@block
def twice(a: Row) -> Row:
    return Row(a.x + a.x)


@graph
def held(a: Stream[Row], b: Stream[Row], *, loud: bool = False):
    """At a tick of either the last `a` drives a matrix, which `b`, where it is there, drives again."""
    memory = delay(np.eye(8), name="memory")
    drive = latest(a, init=Row(np.zeros(8)), at=a | b)
    after = aided(moved(memory, drive), b)
    memory.feed(after)
    return {"matrix": after, "raw": twice(a)} if loud else after


def events(n: int = 60) -> dict[str, Series]:
    rng = np.random.default_rng(3)
    times = {name: np.flatnonzero(rng.random(n) < 0.6) for name in "ab"}
    return {name: Series(t, Row(rng.normal(size=(len(t), 8)))) for name, t in times.items()}


def keys_of(built: Graph, keys: list[int]) -> list[tuple[int, ...]]:
    return [p.keys for p in shared(lower(built), keys)]


def test_a_presence_that_decides_about_little_is_data():
    pipeline = lower(held.build())
    assert min(specialise(pipeline, key).work for key in (2, 3)) > LEAST
    assert keys_of(held.build(), [1, 2, 3]) == [(1,), (2, 3)]
    assert shared(pipeline, [1, 2, 3])[1] == Pattern((2, 3), inputs=3, open=1)
    assert generate(pipeline).reactions == ("fg_react_1", "fg_react_3")


def test_an_output_that_is_there_with_one_input_only_keeps_its_patterns_apart():
    """So where it is, is known from the pattern, and its rows need not be looked for."""
    assert keys_of(held.build(loud=True), [1, 2, 3]) == [(1,), (2,), (3,)]


def test_patterns_that_do_not_come_are_shared_with_none():
    assert keys_of(held.build(), [1, 3]) == [(1,), (3,)]


def test_little_work_is_no_burden():
    @graph
    def small(a: Stream[real(3)], b: Stream[real(3)]):  # type: ignore[valid-type]
        return b + latest(a, init=np.zeros(3), at=b)

    assert keys_of(small.build(), [1, 2, 3]) == [(1,), (2,), (3,)]


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize("loud", [False, True])
def test_a_shared_reaction_gives_what_the_reference_gives(loud):
    built, inputs = held.build(loud=loud), events()
    same(simulate(built, inputs, engine="reference"), simulate(built, inputs, engine="c"), exact=False)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_an_input_that_is_absent_may_be_no_address(tmp_path):
    """A program of the user's own passes NULL for what is not there."""
    source = generate(lower(held.build()))
    m = source.names.module
    (tmp_path / f"{m}.h").write_text(source.header)
    (tmp_path / f"{m}.c").write_text(source.source)
    out = source.names.outputs[0]
    (tmp_path / "main.c").write_text(
        f'#include "{m}.h"\n#include <stdio.h>\nstatic {m}_state s; static {m}_b b; static {m}_{out} out;\n'
        f"int main(void) {{\n    {m}_reset(&s, 0);\n"
        f"    return {m}_react(&s, 5, 2, NULL, &b, &out) == 1 ? 0 : 1;\n}}\n"
    )
    done = ran("cc", *STRICT, "-fsanitize=undefined", "-o", "go", "main.c", f"{m}.c", "-lm", cwd=tmp_path)
    assert done.returncode == 0, done.stderr[:2000]
    assert ran(tmp_path / "go").returncode == 0


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_seven_patterns_of_a_navigation_filter_take_four_reactions(tmp_path, monkeypatch):
    settings = {"duration": 1.5, "vicon.rate": 30.0}  # at times of the inertial unit, and between them
    case = ins_eskf.case(simulated.load(settings=settings))
    assert set(tape(prepare(case.graph, case.inputs), case.graph).patterns) == {1, 6, 7}
    made = generate(lower(case.graph))
    assert made.patterns == tuple(range(1, 8))
    assert made.reactions == ("fg_react_1", "fg_react_3", "fg_react_5", "fg_react_7")
    together = simulate(case.graph, case.inputs, engine="c")
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path))
    monkeypatch.setattr(file, "shared", lambda _, keys: [Pattern.of(key) for key in keys])
    assert len(generate(lower(case.graph)).reactions) == 7
    again = ins_eskf.case(simulated.load(settings=settings)).graph
    same(together, simulate(again, case.inputs, engine="c"), exact=False)
