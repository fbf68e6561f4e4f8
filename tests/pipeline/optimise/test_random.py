"""The optimiser on random graphs with every kind of join, memory and clock, and on random arithmetic."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import simulate
from flowgraph.pipeline.optimise import PASSES, optimise
from tests.engines.test_engines import RANDOM, RECIPES, TIMES, random_data, random_graph
from tests.pipeline.optimise.programs import play, record
from tests.support import same

CHOICES = st.sets(st.sampled_from(sorted(PASSES)))


@settings(RANDOM, max_examples=60)
@given(RECIPES, TIMES, TIMES, st.integers(0, 1000), CHOICES)
def test_any_choice_of_passes_agrees_on_random_graphs(recipe, times_x, times_y, seed, passes):
    built, data = random_graph(recipe), random_data(times_x, times_y, seed)
    plain = simulate(built, data, engine="reference")
    same(plain, simulate(built, data, engine="reference", passes=passes), exact=False)


STEPS = st.lists(st.tuples(st.integers(0, 13), st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=8)


def arithmetic(steps):
    """Steps on 3 by 3 matrices, with the zeros and identities that the passes look for."""
    kinds = [
        lambda xp, a, b: a + b,
        lambda xp, a, b: a - b,
        lambda xp, a, b: a * b,
        lambda xp, a, b: a @ b,
        lambda xp, a, b: a @ b @ a.mT,
        lambda xp, a, b: a @ (b + b.mT) @ a.mT,
        lambda xp, a, b: a + 0.0,
        lambda xp, a, b: 1.0 * b,
        lambda xp, a, b: np.eye(3) + np.eye(3, k=2) * a[0, 1],
        lambda xp, a, b: xp.concat([a[:1], b[1:]], axis=0),
        lambda xp, a, b: xp.stack([a[:, 0], b[:, 1], a[2]], axis=1),
        lambda xp, a, b: xp.where(a > b, a, b.mT),
        lambda xp, a, b: xp.broadcast_to(xp.sum(a, axis=0, keepdims=True), (3, 3)) - xp.triu(b),
        lambda xp, a, b: xp.reshape(xp.reshape(a, (9,))[::-1], (3, 3)) * 0.5,
    ]

    def step(xp, x, y):
        values = [x, y]
        for kind, i, j in steps:
            made = kinds[kind](xp, values[i % len(values)], values[j % len(values)])
            values.append(made / (1.0 + xp.max(xp.abs(made))))  # so that nothing grows out of sight
        return tuple(values)

    return record(step, (3, 3), (3, 3), memory=(1,), symmetric=(1,))


@settings(RANDOM, max_examples=80)
@given(STEPS, st.integers(0, 1000), CHOICES)
def test_any_choice_of_passes_agrees_on_random_arithmetic(steps, seed, passes):
    program = arithmetic(steps)
    random = np.random.default_rng(seed)
    half = random.normal(size=(3, 3))
    values = random.normal(size=(3, 3)), half + half.T
    short = optimise(program, passes)
    for a, b in zip(play(program, *values), play(short, *values), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
