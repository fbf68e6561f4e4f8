"""Random numbers: the published vectors, the distribution, and what the draws do not depend on."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from flowgraph import (
    DeclarationError,
    Scalar,
    Series,
    Stream,
    block,
    graph,
    lower,
    simulate,
)
from flowgraph.recorder import numpy_random
from flowgraph.recorder.namespaces import NUMPY, NumpyNamespace
from flowgraph.recorder.random import Site, normal_from, philox, seed_words, words

PI = ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0")
ONES = ("ffffffff " * 4, "ffffffff " * 2)
ZEROS = ("0 0 0 0", "0 0")
VECTORS = [  # D. E. Shaw Research, Random123, kat_vectors
    (7, *ZEROS, "5f6fb709 0d893f64 4f121f81 4f730a48"),
    (7, *ONES, "5207ddc2 45165e59 4d8ee751 8c52f662"),
    (7, *PI, "4dfccaba 190a87f0 c47362ba b6b5242a"),
    (10, *ZEROS, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    (10, *ONES, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    (10, *PI, "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


def hexes(text: str) -> np.ndarray:
    return np.array([int(word, 16) for word in text.split()], dtype=np.uint32)


@pytest.mark.parametrize(("rounds", "counter", "key", "expected"), VECTORS)
def test_philox_gives_the_published_vectors(rounds, counter, key, expected):
    c = hexes(counter)
    even, odd = philox(c[[0, 2]][:, None], c[[1, 3]][:, None], hexes(key)[:, None], rounds=rounds, xp=NUMPY)
    assert [even[0, 0], odd[0, 0], even[1, 0], odd[1, 0]] == hexes(expected).tolist()


def normals(name: str = "a", time: int = 0, seed: int = 0, n: int = 400_000) -> np.ndarray:
    return Site(name, "normal", (n,)).numbers(time, seed_words(seed), xp=NUMPY)


def test_normals_are_normal():
    z = normals()
    n = len(z)
    assert abs(z.mean()) < 4 / np.sqrt(n)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs(stats.skew(z)) < 4 * np.sqrt(6 / n)
    assert abs(stats.kurtosis(z)) < 4 * np.sqrt(24 / n)
    assert stats.kstest(z, "norm").pvalue > 1e-3


def test_tails_are_as_heavy_as_they_should_be():
    z = np.abs(normals(n=2_000_000, seed=3))
    for limit in (3.0, 4.0, 4.5):
        expected = 2 * stats.norm.sf(limit) * len(z)
        assert abs((z > limit).sum() - expected) < 5 * np.sqrt(expected)


def test_normals_invert_the_distribution_closely_and_symmetrically():
    bits = np.unique(np.geomspace(2, 2**32 - 2, 20001).astype(np.uint64)).astype(np.uint32) & ~np.uint32(1)
    z = normal_from(bits, xp=NUMPY)
    exact = stats.norm.isf(((bits >> 1) | 1) * 2.0**-32)
    assert np.abs(z - exact).max() < 3e-5
    assert np.array_equal(normal_from(bits | np.uint32(1), xp=NUMPY), -z)


def test_uniforms_are_uniform_and_below_one():
    u = Site("u", "uniform", (400_000,)).numbers(5, seed_words(1), xp=NUMPY)
    assert u.min() >= 0
    assert u.astype(np.float32).max() < 1
    assert stats.kstest(u, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(
    "other", [{"name": "b"}, {"time": 5_000_000}, {"seed": 1}, {"seed": 2**63}, {"time": 2**40}]
)
def test_streams_are_uncorrelated(other):
    n = 200_000
    a, b = normals(n=n), normals(n=n, **other)
    assert abs(np.corrcoef(a, b)[0, 1]) < 4 / np.sqrt(n)
    assert abs(np.corrcoef(a[1:], a[:-1])[0, 1]) < 4 / np.sqrt(n)


def test_neighbouring_times_are_uncorrelated_at_one_place():
    site = Site("w", "normal", (4,))
    first = np.array([site.numbers(5_000_000 * k, seed_words(0), xp=NUMPY) for k in range(20_000)])
    correlation = np.corrcoef(np.concatenate([first[1:], first[:-1]], axis=1).T)
    assert np.abs(correlation - np.eye(8)).max() < 5 / np.sqrt(20_000)


@block
def noise(x: Scalar, *, draw) -> Scalar:
    return x * 0.0 + draw.normal("n", (5,))[0]


@block
def uses(x: Scalar, y: Scalar, *, draw, xp) -> Scalar:
    return x + y + xp.sum(draw.normal("other", (2,)))


@graph
def plain(a: Stream[Scalar]):
    return {"noise": noise(a)}


@graph
def with_another_sensor(a: Stream[Scalar], b: Stream[Scalar]):
    return {"b": noise(b.map(lambda x: x + 1.0), draws="second"), "noise": noise(a)}


@graph
def nested(a: Stream[Scalar]):
    return {"noise": plain(a, name="inner")["noise"]}


TIME = np.arange(40) * 5_000_000 + 1_403_636_579_758_560_000
A = Series(TIME, np.zeros(40))


@pytest.mark.parametrize("engine", ["python", "reference", "xla"])
def test_draws_are_the_same_bits_in_every_engine_with_more_sensors_and_when_nested(engine):
    expected = simulate(plain.build(), {"a": A}, seed=9).noise.value
    assert len(np.unique(expected)) == 40
    more = {"a": A, "b": Series(TIME[::4] + 1_000_000, np.zeros(10))}
    assert np.array_equal(simulate(plain.build(), {"a": A}, seed=9, engine=engine).noise.value, expected)
    wide = simulate(with_another_sensor.build(), more, seed=9, engine=engine)
    assert np.array_equal(wide.noise.value, expected)
    assert np.array_equal(simulate(nested.build(), {"a": A}, seed=9, engine=engine).noise.value, expected)


def test_float32_draws_are_the_same_bits_too():
    results = [
        simulate(plain.build(), {"a": A}, engine=e, dtype="float32").noise.value for e in ("reference", "xla")
    ]
    assert np.array_equal(*results)


def test_the_pipeline_names_its_random_sites():
    pipeline = lower(plain.build())
    assert [(r.name, r.kind, r.shape) for r in pipeline.random] == [("noise/n", "normal", (5,))]
    assert "random(noise/n)" in [s.path for s in pipeline.stages]


def test_two_nodes_may_not_share_a_random_stream():
    @graph
    def twice(a: Stream[Scalar]):
        return {"x": noise(a), "y": noise(a)}

    with pytest.raises(DeclarationError, match='draws="noise_2"'):
        twice.build()


@pytest.mark.parametrize("seed", [-1, 2**64, 1.5, True])
def test_seeds_out_of_range_are_refused(seed):
    with pytest.raises(DeclarationError, match="this is no seed") as caught:
        simulate(plain.build(), {"a": A}, seed=seed)
    assert repr(seed) in str(caught.value)


def test_a_draw_of_unknown_size_is_refused():
    @block
    def loose(x: Scalar, *, draw) -> Scalar:
        return draw.normal("n", (x,))[0]

    @graph
    def g(a: Stream[Scalar]):
        return loose(a)

    with pytest.raises(DeclarationError, match="fixed shape"):
        g.build()


def test_names_of_one_hash_are_refused():
    @graph
    def twice(a: Stream[Scalar]):
        return {"x": noise(a, draws="s73886"), "y": noise(a, draws="s140503")}

    with pytest.raises(DeclarationError, match="would draw the numbers of"):
        twice.build()


@pytest.mark.parametrize("kind", ["normal", "uniform"])
@pytest.mark.parametrize("shape", [(), (0,), (1,), (5,), (16,), (17,), (3, 100), (3, 43_691)])
def test_the_ways_of_numpy_give_the_same_numbers(kind, shape):
    """Few are made with Python's integers, many with few passes; another namespace has neither."""
    for time, seed in ((0, 0), (-5, 2**63 + 1), (2**62 + 7, 12345)):
        site, key = Site("a/b", kind, shape), seed_words(seed)
        ours, plain = (site.numbers(time, key, xp=xp) for xp in (NUMPY, NumpyNamespace()))
        assert ours.dtype == plain.dtype
        assert ours.shape == plain.shape
        assert ours.tobytes() == plain.tobytes()


@pytest.mark.parametrize("count", [1, 4, 16, 17, 1000])
def test_words_are_the_same_by_python_s_integers(count):
    few = numpy_random.few_words(count, 77, -3, seed_words(9), 7)
    assert few == words(count, 77, -3, seed_words(9), xp=NUMPY).tolist()
    assert few == numpy_random.words(count, 77, -3, seed_words(9), 7).tolist()
