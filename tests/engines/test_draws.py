"""Draws made ahead: whoever asks, however often, gets those of the site at that time."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.data.tape import Tape
from flowgraph.engines.python.draws import Ahead
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.random import seed_words, site

TIME = np.cumsum(np.random.default_rng(0).integers(1, 10**9, 900))
KEY = np.arange(900) % 3 + 1


@pytest.mark.parametrize("kind", ["normal", "uniform"])
@pytest.mark.parametrize("shape", [(), (3,), (0,), (40, 9), (3000, 3)])
@pytest.mark.parametrize("patterns", [frozenset({1, 2, 3}), frozenset({2}), None])
def test_draws_made_ahead_are_those_of_the_site(kind, shape, patterns):
    one, seed = site("a", kind, "n", shape), seed_words(5)
    ahead = Ahead(one, Tape(TIME, KEY, ()).times(patterns or ()), seed)
    often = 1 if shape != (3000, 3) else 40
    for stride in (often, 30, often):  # used at each tick, seldom, and at each again
        for k in range(1, 400, stride):  # with times at which nothing is expected to be drawn
            found, plain = ahead(int(TIME[k])), one.numbers(int(TIME[k]), seed, xp=NUMPY)
            assert np.shape(found) == shape
            np.testing.assert_array_equal(found, plain)
            assert not shape or found.flags.c_contiguous


def test_another_seed_makes_other_draws():
    one, seed = site("a", "normal", "n", (4,)), seed_words(5)
    ahead = Ahead(one, TIME, seed)
    ahead(int(TIME[0]))
    seed[:] = seed_words(6)
    ahead.forget()
    np.testing.assert_array_equal(ahead(int(TIME[1])), one.numbers(int(TIME[1]), seed_words(6), xp=NUMPY))
