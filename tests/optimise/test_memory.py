"""Buffers are shared only where no one still needs what is in them, and lanes lie side by side."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import find_graph, load_flight, lower
from flowgraph.optimise import optimise
from flowgraph.optimise.memory import plan
from flowgraph.program import specialise
from tests.optimise.programs import record


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
    assert len(plan(program).place) == 2


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
    root: dict[int, int] = {}  # the value whose memory another is a view of
    born: dict[int, int] = {}
    for n, i in enumerate(program.instructions):
        for a in i.args:
            if a in found.place:
                assert inside[found.place[a]] == root[a], f"%{a} is gone when %{i.out} needs it"
        if i.out not in found.place:
            continue
        place = found.place[i.out]
        view = i.op in ("reshape", "matrix_transpose") and found.place.get(i.args[0]) == place
        root[i.out] = root[i.args[0]] if view else i.out
        if not view:
            assert born.get(place) != step[n], "two values of one loop in one place"
            inside[place], born[place] = i.out, step[n]
    for flag, leaves in program.outputs:
        for v in (*leaves, *([] if flag is None else [flag])):
            assert v not in found.place or inside[found.place[v]] == root[v]
    for v in program.writes:
        assert v not in found.place or inside[found.place[v]] == root[v]
    assert found.bytes < 0.8 * plan(program, ()).bytes
