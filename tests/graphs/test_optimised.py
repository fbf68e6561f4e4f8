"""Every graph of the library computes the same with the optimiser and with each of its passes left out."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    DeclarationError,
    Result,
    UnknownNameError,
    lower,
    simulate,
    simulate_many,
)
from flowgraph.pipeline.optimise import DEFAULT, PASSES, optimise, without
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import specialise
from tests.graphs.estimation import compare
from tests.graphs.library import LIBRARY, library_case

VARIED = ("kalman", "ins_eskf", "quaternion_ukf", "rbpf_indoor")
"""A graph of each kind."""

REWRITING = [name for name in PASSES if name not in ("reuse", "layout")]


@cache
def plain(name: str) -> Result:
    case = library_case(name)
    return simulate(case.graph, case.inputs, engine="reference")


def agrees(name: str, passes: tuple[str, ...], engine: str = "reference") -> None:
    case = library_case(name)
    found = simulate(case.graph, case.inputs, engine=engine, passes=passes)
    assert list(found.series) == list(plain(name).series)
    for output, series in plain(name).series.items():
        compare(series, found[output])


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_optimised_it_gives_the_same(name):
    agrees(name, DEFAULT)


@pytest.mark.slow
@pytest.mark.parametrize("left_out", REWRITING)
@pytest.mark.parametrize("name", VARIED)
def test_each_pass_can_be_left_out(name, left_out):
    agrees(name, without(left_out))


@pytest.mark.slow
@pytest.mark.parametrize("alone", REWRITING)
@pytest.mark.parametrize("name", VARIED)
def test_each_pass_does_alone(name, alone):
    agrees(name, (alone,))


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_xla_plays_the_optimised_list(name):
    agrees(name, without("unroll"), engine="xla")  # unrolled it takes minutes to compile


def programs(name: str) -> list[Any]:
    """One for each pattern of present sources; where there are many, for each alone and all together."""
    pipeline: Pipeline = lower(library_case(name).graph)
    n = len(pipeline.inputs)
    keys = range(1, 2**n) if n <= 3 else [*(1 << k for k in range(n)), 2**n - 1]
    return [specialise(pipeline, key) for key in (*keys, None)]


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_the_list_stays_in_single_assignment_form(name):
    for program in programs(name):
        found = optimise(program)
        known = set(program.specs) - {i.out for i in program.instructions} | set(found.constants)
        for i in found.instructions:
            assert known.issuperset(i.args)
            assert i.out not in known
            assert found.specs[i.out] == i.spec
            known.add(i.out)
        assert known.issuperset(found.writes)


def test_less_is_left_of_the_work():
    """Of the scalar operations of a tick, with one for a multiplication and addition of a matrix product."""
    (kalman,) = programs("kalman")[:1]
    assert optimise(kalman, without("unroll")).work < 0.6 * kalman.work
    eskf = programs("ins_eskf")[6]  # all sources present
    assert optimise(eskf, without("unroll")).work < 0.4 * eskf.work


def test_a_run_that_sets_a_covariance_otherwise_goes_without_symmetry():
    case = library_case("kalman")
    belief = case.graph.registers[0][1]
    assert belief.path == "belief"
    start = belief.initial
    skew = np.asarray(start.covariance) + np.triu(np.full((6, 6), 0.5), k=1)
    init = {"belief": type(start)(mean=start.mean, covariance=skew)}
    first = {n: s[:3] for n, s in case.inputs.items()}  # type: ignore[union-attr]
    found = [
        simulate(case.graph, first, engine="reference", init=init, passes=p)["belief"] for p in ((), DEFAULT)
    ]
    np.testing.assert_allclose(found[0]["covariance"], found[1]["covariance"], rtol=1e-9, atol=1e-12)


def test_the_python_engine_has_no_list_to_optimise():
    case = library_case("kalman")
    with pytest.raises(DeclarationError, match="the Python engine runs the blocks themselves"):
        simulate(case.graph, case.inputs, passes=DEFAULT)
    with pytest.raises(UnknownNameError, match="no pass is called 'magic'"):
        simulate(case.graph, case.inputs, engine="reference", passes=["magic"])


@pytest.mark.parametrize("engine", ["reference", "xla"])
def test_many_runs_take_passes_too(engine):
    case = library_case("kalman")
    pytest.importorskip("jax")
    runs = simulate_many(case.graph, case.inputs, [0, 1], engine=engine, passes=without("unroll"))
    for output, series in plain("kalman").series.items():
        for leaf, values in series.leaves.items():
            np.testing.assert_allclose(runs[output][leaf][0], values, rtol=1e-9, atol=1e-9)
