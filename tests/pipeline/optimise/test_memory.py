"""Buffers are shared only where no one still needs what is in them, and lanes lie side by side."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import find_graph, load_flight, lower
from flowgraph.pipeline.optimise import optimise
from flowgraph.pipeline.optimise.memory import plan
from flowgraph.pipeline.program import specialise
from tests.pipeline.optimise.programs import record


def chain(xp, x):
    """Each array is needed by the next product only."""
    for _ in range(6):
        x = xp.linalg.cholesky(x)
    return x


def test_a_chain_needs_two_places_for_any_number_of_arrays():
    program = record(chain, (4, 4))
    assert len(plan(program).buffers) == 2
    assert len(plan(program, ("loops",)).buffers) == 6
    assert plan(program).bytes == 2 * 16 * 8


def test_a_place_grows_where_that_is_less_than_another():
    def growing(xp, x):
        small = xp.linalg.cholesky(x)
        wide = xp.concat([small, small])
        return xp.concat([xp.concat([wide, wide]) @ xp.sum(wide, axis=0)[:, None], np.ones((1, 1))])

    program = record(growing, (4, 4))
    assert plan(program).bytes < plan(program, ("loops",)).bytes


def test_what_a_loop_keeps_to_itself_needs_no_place():
    program = record(lambda xp, x: xp.sum(xp.exp(x + 1.0) * 2.0), (50,))
    assert len(plan(program).place) == 1
    assert len(plan(program, ("reuse",)).place) == 3


def test_a_reshape_is_where_its_argument_is():
    program = record(lambda xp, x: xp.reshape(xp.linalg.cholesky(x), (16,)), (4, 4))
    (place,) = set(plan(program).place.values())
    assert place == 0
    (reshape,) = [i for i in program.instructions if i.op == "reshape"]
    assert plan(program).view == {reshape.out: (reshape.args[0], 0)}


def test_the_axis_of_particles_is_innermost():
    program = record(lambda xp, x: (x + 1.0).mT, (50, 3), lanes=(50,))
    found = plan(program)
    assert found.order[0] == (1, 0)
    (out,) = program.outputs[0][1]
    assert found.order[out] == (0, 1)
    assert len(set(found.place.values())) == 1  # so the transpose moves nothing
    assert plan(program, ("reuse",)).order == {}


@pytest.mark.parametrize("name", ["ins_eskf", "ekf", "rbpf_indoor"])
@pytest.mark.parametrize("passes", [("loops", "reuse", "layout"), ("reuse",)])
def test_no_two_values_share_a_place_at_one_time(name, passes):
    """Played with the buffers as the only memory: each value is still there at its last use."""
    settings = {"particles": 40} if name == "rbpf_indoor" else {}
    case = find_graph(name).case(load_flight("sim", settings={"duration": "1"}), **settings)
    program = optimise(specialise(lower(case.graph), 3))
    found = plan(program, passes)
    step = list(range(len(program.instructions)))
    for group in found.loops:
        step[group.start : group.stop] = [group.start] * (group.stop - group.start)
    inside: dict[int, int] = {}  # what is in a place
    born: dict[int, int] = {}

    def root(value):
        while value in found.view:
            value = found.view[value][0]
        return value

    for n, i in enumerate(program.instructions):
        for a in i.args:
            if root(a) in found.place:
                assert inside[found.place[root(a)]] == root(a), f"%{a} is gone when %{i.out} needs it"
        whole = root(i.out)
        if whole not in found.place or any(i.out in loop.local for loop in found.loops):
            continue
        place = found.place[whole]
        if inside.get(place) != whole:
            assert born.get(place) != step[n], "two values of one loop in one place"
            inside[place], born[place] = whole, step[n]
    for v in (*program.writes, *(x for _, leaves in program.outputs for x in leaves)):
        assert root(v) not in found.place or inside[found.place[root(v)]] == root(v)
    assert found.bytes < 0.8 * plan(program, ()).bytes


def test_parts_of_a_stack_are_made_where_it_will_be():
    def step(xp, x):
        rows = [xp.cumulative_sum(x[k], axis=0) for k in range(3)]
        return xp.stack(rows) @ rows[0]

    program = record(step, (3, 50), lanes=(50,))
    found = plan(program)
    stack = next(i for i in program.instructions if i.op == "stack")
    assert [found.view[a] for a in stack.args] == [(stack.out, 50 * k) for k in range(3)]
    assert {found.view[i.out] for i in program.instructions if i.op == "getitem"} == {
        (0, 0),
        (0, 50),
        (0, 100),
    }
    assert [b.size for b in found.buffers] == [150, 3]


@pytest.mark.parametrize(
    ("index", "begin"),
    [
        ((1,), 12),
        ((1, 2), 20),
        ((slice(1, None),), 12),
        ((0, slice(1, 3)), 4),
        ((slice(None), 1), None),
        ((slice(None), slice(1, 2)), None),
        ((slice(None, None, -1),), None),
        ((slice(None, None, 2),), None),
    ],
)
def test_whole_rows_are_views(index, begin):
    program = record(lambda xp, x: xp.cumulative_sum(x[index], axis=-1), (2, 3, 4))
    (item,) = [i for i in program.instructions if i.op == "getitem"]
    assert plan(program).view.get(item.out) == (None if begin is None else (0, begin))
    if begin is not None:
        x = np.arange(24.0).reshape(2, 3, 4)
        part = x.reshape(-1)[begin : begin + int(np.prod(item.spec.shape))].reshape(item.spec.shape)
        np.testing.assert_array_equal(part, x[index])
