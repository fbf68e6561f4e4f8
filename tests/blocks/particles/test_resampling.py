"""Resampling schemes: unbiased, in the order of variance that theory gives, and alike in every engine."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Scalar, Series, Signal, Stream, block, graph, real, simulate
from flowgraph.blocks.particles import SCHEMES, ancestor_index, draw_ancestors, start_cloud, take_ancestors
from flowgraph.blocks.signals import Ancestors
from flowgraph.errors import UnknownNameError
from flowgraph.recorder.random import NumpyDraw, seed_words
from flowgraph.types import Array

N = 20
DRAWS = 4000


def a_weight(seed: int = 0, n: int = N) -> np.ndarray:
    w = np.random.default_rng(seed).gamma(0.5, size=n)
    return w / w.sum()


def draw(time: int) -> NumpyDraw:
    return NumpyDraw("test", seed_words(5), time)


def indices(weight: np.ndarray, scheme: str, draws: int = DRAWS) -> np.ndarray:
    return np.array([ancestor_index(weight, scheme=scheme, draw=draw(t), xp=np) for t in range(draws)])


def counts(weight: np.ndarray, scheme: str) -> np.ndarray:
    """How many copies each particle got, (draws, n)."""
    return np.array([np.bincount(row, minlength=len(weight)) for row in indices(weight, scheme)])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_particle_gets_n_w_copies_on_average(scheme):
    weight = a_weight()
    found = counts(weight, scheme)
    assert np.all(found.sum(axis=1) == N)
    deviation = np.sqrt(np.maximum(found.var(axis=0), 1e-3) / DRAWS)
    assert np.all(np.abs(found.mean(axis=0) - N * weight) < 5.0 * deviation)


def test_the_schemes_vary_in_the_order_that_theory_gives():
    weight = a_weight()
    spread = {scheme: counts(weight, scheme).var(axis=0).sum() for scheme in SCHEMES}
    assert spread["multinomial"] > 1.2 * spread["residual"]
    assert spread["residual"] > 1.2 * spread["stratified"]
    assert spread["residual"] > 1.2 * spread["systematic"]
    # multinomial counts have variance n w (1 - w)
    assert spread["multinomial"] == pytest.approx(np.sum(N * weight * (1.0 - weight)), rel=0.05)


@pytest.mark.parametrize("scheme", ["systematic", "residual"])
def test_no_particle_loses_more_than_a_fraction_of_a_copy(scheme):
    weight = a_weight()
    found = counts(weight, scheme)
    assert np.all(found >= np.floor(N * weight))
    if scheme == "systematic":
        assert np.all(found <= np.ceil(N * weight))


@pytest.mark.parametrize("scheme", ["systematic", "residual"])
def test_equal_weights_keep_every_particle(scheme):
    for n in (8, 10, 1000):
        found = indices(np.full(n, 1.0 / n), scheme, draws=20)
        np.testing.assert_array_equal(np.sort(found, axis=1), np.broadcast_to(np.arange(n), (20, n)))


class Extreme:
    """A draw whose uniform numbers are all the lowest or the highest there is."""

    def __init__(self, value: float) -> None:
        self.value = value

    def uniform(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        return np.full(shape, self.value)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("u", [0.0, 1.0 - 2.0**-24])
@pytest.mark.parametrize("n", [1, 3, 1000])
def test_the_index_is_in_range_and_never_of_a_particle_without_weight(scheme, u, n):
    weight = a_weight(1, n)
    weight[n // 2 + 1 :] = 0.0
    weight = weight / weight.sum()
    found = ancestor_index(weight, scheme=scheme, draw=Extreme(u), xp=np)
    assert found.min() >= 0
    assert found.max() <= n // 2
    first = np.zeros(n)
    first[0] = 1.0
    np.testing.assert_array_equal(ancestor_index(first, scheme=scheme, draw=Extreme(u), xp=np), 0)


def test_another_scheme_is_refused_by_name():
    with pytest.raises(UnknownNameError, match="systematic"):
        ancestor_index(a_weight(), scheme="sistematic", draw=draw(0), xp=np)


def test_a_cloud_with_even_weights_is_left_alone():
    cloud = start_cloud(N)
    cloud = cloud.replace(log_weight=np.log(a_weight()), position=np.arange(3.0 * N).reshape(3, N))
    size = np.float64(0.5 * N)
    kept = draw_ancestors.step(cloud, size, below=0.5, draw=draw(0), xp=np)
    assert not kept.resampled
    np.testing.assert_array_equal(kept.index, np.arange(N))
    np.testing.assert_array_equal(take_ancestors.step(cloud, kept, xp=np).log_weight, cloud.log_weight)
    drawn = draw_ancestors.step(cloud, size, below=0.51, draw=draw(0), xp=np)
    assert drawn.resampled
    after = take_ancestors.step(cloud, drawn, xp=np)
    np.testing.assert_array_equal(after.position, cloud.position[:, drawn.index])
    np.testing.assert_array_equal(after.log_weight, -np.log(N))


class Twenty(Signal):
    """Weights of twenty particles."""

    weight: Array = real(N)


@block
def choose(weights: Twenty, *, scheme: str, draw, xp) -> Ancestors:
    """Ancestors for weights as they come."""
    index = ancestor_index(weights.weight, scheme=scheme, draw=draw, xp=xp)
    return Ancestors(index=xp.astype(index, xp.int32), resampled=xp.asarray(True))


@graph
def choosing(weights: Stream[Twenty], always: Stream[Scalar] | None = None):
    """Every scheme at once."""
    return {scheme: choose(weights, scheme=scheme, draws=scheme, name=scheme) for scheme in SCHEMES}


@pytest.mark.parametrize("engine", ["reference", "xla"])
def test_the_engines_choose_alike_also_at_ties(engine):
    if engine == "xla":
        pytest.importorskip("jax")
    rows = [a_weight(k) for k in range(30)]
    rows += [np.full(N, 1.0 / N), np.repeat([0.1, 0.0], 10), np.eye(N)[0], np.eye(N)[-1]]
    rows += [np.repeat([0.25, 0.125, 0.625, 0.0], [2, 4, 0, 14])]  # edges fall on places: ties
    weight = np.array(rows)
    inputs = {"weights": Series(np.arange(len(weight)) * 10**9, Twenty(weight=weight))}
    built = choosing.build()
    here, there = simulate(built, inputs, seed=3), simulate(built, inputs, seed=3, engine=engine)
    for scheme in SCHEMES:
        np.testing.assert_array_equal(here[scheme]["index"], there[scheme]["index"], err_msg=scheme)
