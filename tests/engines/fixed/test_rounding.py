"""Which values need bits: an order by what the rounding of one alone does."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from flowgraph import Scalar, Stream, block, boolean, graph, real
from flowgraph.engines.fixed.abreast import Recorded
from flowgraph.engines.fixed.rounding import decisions, estimates, impacts
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.pipeline.program import specialise
from flowgraph.recorder.random import seed_words
from tests.engines.fixed.test_fixed import sizes_of

Flag = Annotated[Any, boolean()]
Few = Annotated[Any, real(4)]


@block
def gather(kept: Scalar, x: Few, *, xp) -> tuple[Scalar, tuple[Scalar, Scalar, Flag]]:
    """Something that is kept, something that is only looked at, and a decision by what was kept."""
    now = 0.75 * kept + xp.sum(x * x)
    return now, (now, xp.sum(xp.sin(x)), kept > 2.0)


@gather.init
def _(x):
    return 0.0


@graph
def gathering(x: Stream[Few]):
    """One block."""
    now, aside, above = gather(x)
    return {"now": now, "aside": aside, "above": above}


def _made():
    built = gathering.build()
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 4))
    inputs = {"x": (np.arange(60, dtype=np.int64) * 1_000_000, x)}
    subject = LoweredGraph(built, dtype="fixed")
    start = subject.start(RunOptions())
    tape = subject.tape(inputs, start.last)
    sizes = sizes_of(built, inputs)
    flight = Recorded(sizes.pipeline, tape, start.cells, seed_words(0))
    return flight, sizes.formats(16)


def _of(flight, op):
    return {i.out for i in flight.pipeline.instructions if i.op == op}


def test_a_decision_is_made_of_the_real_values_that_are_compared():
    flight, _ = _made()
    program = specialise(flight.pipeline, 1)
    found = decisions(program)
    (greater,) = (i for i in program.instructions if i.op == "greater")
    assert found == {greater.out: greater.args}
    assert estimates(1, [0])(program) == {n: (n,) for n in program.outputs[1][1]}


def test_what_does_not_bear_on_what_is_judged_does_nothing():
    flight, formats = _made()
    values = sorted(formats.fractions)
    by_decision = impacts(flight, formats.fractions, values, [decisions])
    by_aside = impacts(flight, formats.fractions, values, [estimates(1, [0])])
    both = impacts(flight, formats.fractions, values, [decisions, estimates(1, [0])])
    (sine,) = _of(flight, "sin")
    squares = _of(flight, "multiply")
    assert by_decision[sine] == 0.0 < by_aside[sine] <= 1.0
    assert all(by_aside[n] == 0.0 < by_decision[n] for n in squares)
    assert max(by_decision.values()) == max(by_aside.values()) == 1.0
    assert both == {n: max(by_decision[n], by_aside[n]) for n in values}


def test_what_is_coarser_does_more():
    flight, formats = _made()
    (add,) = _of(flight, "add")
    values = sorted(formats.fractions)
    coarse = {n: f - 12 * (n == add) for n, f in formats.fractions.items()}
    fine, rough = (impacts(flight, f, values, [decisions]) for f in (formats.fractions, coarse))
    assert rough[add] == 1.0
    others = [n for n in values if n != add and fine[n] > 0.0]
    assert others
    assert all(rough[n] < 0.01 * fine[n] for n in others)


def test_what_is_kept_is_followed_until_it_is_judged():
    """The decision is made by what was kept, so that nothing of its own tick bears on it but the register."""
    flight, formats = _made()
    squares, values = _of(flight, "multiply"), sorted(formats.fractions)
    found = impacts(flight, formats.fractions, values, [decisions])
    assert all(found[n] > 0.0 for n in squares)
    first = replace(flight, tape=flight.tape.first(1))  # nothing comes after it
    found = impacts(first, formats.fractions, values, [decisions])
    assert all(found[n] == 0.0 for n in squares)
