"""Engines agree on random steps over arrays: each has its own way of going through many lanes."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import simulate, simulate_many
from flowgraph.engines.python import strips
from tests.arrays import GIVEN, cloud
from tests.support import same

OTHERS = ["c", "numpy", "xla"]


def agrees(engine: str, seed: int, size: int) -> None:
    built = cloud(seed, size)
    same(
        simulate(built, GIVEN, engine="reference"),
        simulate(built, GIVEN, engine=engine),
        exact=engine == "python",
    )


@pytest.fixture
def short(monkeypatch):
    """Strips of few lanes, which a small cloud has several of."""
    monkeypatch.setattr(strips, "LEAST", 40)
    monkeypatch.setattr(strips, "LANES", 24)
    strips.parts.cache_clear()
    yield
    strips.parts.cache_clear()


@pytest.mark.parametrize("size", [97, 200])
@pytest.mark.parametrize("seed", range(25))
def test_python_in_strips_has_the_bits_of_the_reference(seed, size, short):
    agrees("python", seed, size)


@pytest.mark.parametrize(("engine", "count"), [("c", 22), ("numpy", 22), ("xla", 5)])
@pytest.mark.parametrize(("first", "size"), [(0, 130), (1000, 600)])
def test_the_others_agree(engine, count, first, size):
    for seed in range(first, first + (4 if first else count)):
        agrees(engine, seed, size)


def test_lanes_agree_with_single_runs():
    for seed in range(2000, 2008):
        built = cloud(seed, 130)
        alone = simulate(built, GIVEN, engine="reference")
        many = simulate_many(built, GIVEN, range(5), engine="c")
        for name, series in alone.series.items():
            for leaf, array in series.leaves.items():
                np.testing.assert_allclose(many[name].run(3).leaves[leaf], array, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("engine", OTHERS)
def test_the_others_agree_at_length(engine):
    for seed in range(3000, 3040):
        agrees(engine, seed, 50 + 37 * (seed % 20))
