"""Ticks in turns in XLA come out as by a switch; a cloud whose rows are taken apart as in the interpreter."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import find_graph, lower, simulate_many
from flowgraph.blocks.flights import simulated
from flowgraph.engines.xla import scan
from flowgraph.engines.xla.namespace import JaxNamespace
from flowgraph.engines.xla.turns import in_turns
from flowgraph.pipeline.optimise.rows import LEAST_LANES

jax = pytest.importorskip("jax")

MANY = LEAST_LANES + 60


@settings(deadline=None, max_examples=40)
@given(st.lists(st.integers(0, 2), max_size=9), st.integers(0, 3))
def test_each_tick_is_of_its_pattern_and_the_first_of_none_is_the_end(patterns, idle):
    numbers = np.array([*patterns, *[3] * idle], np.int32)
    if not len(numbers):
        return
    given = np.arange(len(numbers), dtype=np.int32) + 1
    steps = [
        lambda c, time, x, true, k=k: ((c[0] * 2 + k * x[0], c[1]), (c[0] + time, jax.numpy.asarray(true)))
        for k in range(3)
    ]
    cells = (jax.numpy.int32(1), jax.numpy.float32(7.0))
    (last, kept), (made, true) = in_turns(jax, steps, cells, numbers, 10 * given, (given,))
    expected, now = np.zeros(len(numbers), np.int32), 1
    for n, k in enumerate(patterns):
        expected[n] = now + 10 * given[n]
        now = now * 2 + k * int(given[n])
    assert (int(last), float(kept)) == (now, 7.0)
    np.testing.assert_array_equal(made, expected)
    assert true.tolist() == [n < len(patterns) for n in range(len(numbers))]


def test_what_is_materialised_goes_past_a_branch_where_that_is_worth_it():
    def operations(size, true):
        made = jax.make_jaxpr(lambda x: JaxNamespace(jax, true).materialise(x))(np.zeros(size))
        return {e.primitive.name for e in made.jaxpr.eqns} & {"cond", "optimization_barrier"}

    assert operations(LEAST_LANES, jax.numpy.asarray(True)) == {"cond"}
    assert operations(LEAST_LANES - 1, jax.numpy.asarray(True)) == {"optimization_barrier"}
    assert operations(LEAST_LANES, None) == {"optimization_barrier"}


def compiled(case):
    """The scans that were made for a case."""
    return list(lower(case.graph).__dict__["_batched"].values())


@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-9), ("float32", 2e-3)])
def test_a_large_cloud_is_that_of_the_interpreter(dtype, bound):
    case = find_graph("rbpf_indoor").case(simulated.load(settings={"duration": 0.4}), particles=MANY)
    seeds = [0, 4, 7]
    theirs = simulate_many(case.graph, case.inputs, seeds, engine="reference", dtype=dtype)
    ours = simulate_many(case.graph, case.inputs, seeds, engine="xla", dtype=dtype, runs_at_once=2)
    assert all(s._wide and s.branches is not None for s in compiled(case))
    assert ours["ancestors"].resampled.any()
    for name, series in theirs.series.items():
        for leaf, array in series.leaves.items():
            found = ours.series[name].leaves[leaf]
            assert found.shape == array.shape
            if array.dtype.kind != "f":
                np.testing.assert_array_equal(found, array)
            else:
                np.testing.assert_allclose(found, array, rtol=bound, atol=bound)


def test_a_small_cloud_and_another_device_keep_the_switch():
    flight = simulated.load(settings={"duration": 0.1})
    for particles, processor, wide in ((20, True, False), (MANY, False, False), (MANY, True, True)):
        case = find_graph("rbpf_indoor").case(flight, particles=particles)
        with patch.object(scan, "on_processor", lambda processor=processor: processor):
            made = scan.Scan(lower(case.graph), (1, 2, 3), np.dtype("float64"), 64)
        assert made._wide is wide
