"""Ticks of which most is computed at once in XLA come out as tick by tick, however they lie in chunks."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    Scalar,
    Series,
    Stream,
    apply,
    graph,
    latest,
    lower,
    periodic,
    real,
    scan,
    simulate,
    simulate_many,
)
from flowgraph.engines.xla import engine
from flowgraph.engines.xla.scan import Scan
from tests.support import same, scalars

pytest.importorskip("jax")

CHUNK = 8


@graph
def held(a: Stream[Scalar], b: Stream[Scalar], v: Stream[real(3)]):  # type: ignore[valid-type]
    """Two inputs that are held, one of them a vector, one of them handed through as well."""
    last = latest(b.map(lambda x: x + 0.5), init=-7.0)
    weight = latest(v.map(lambda u: 2.0 * u), init=np.ones(3))
    return {"sum": apply(lambda x, y, w: 2.0 * x + y * w[1], a, last, weight), "given": v, "known": b}


@graph
def folded(a: Stream[Scalar], b: Stream[Scalar], v: Stream[real(3)]):  # type: ignore[valid-type]
    """A fold with work before it and after it, and its value where another stream fires."""
    fold = scan(a.map(lambda x: 3.0 * x - x * x), lambda y, x: 0.9 * y + x, init=0.25)
    out = apply(lambda y, u: y * u + y * u * u, fold, latest(v, init=np.ones(3)))
    return {"out": out, "seldom": latest(fold, init=1.0, at=b), "far": a.filter(lambda x: x > 0.0)}


GRAPHS = {"held": held, "folded": folded}
BUILT = {name: g.build() for name, g in GRAPHS.items()}


@pytest.fixture(autouse=True)
def small_chunks():
    """Recordings of a few dozen ticks have several chunks."""
    with patch.object(engine, "chunk_size", lambda pipeline, ticks: CHUNK):
        yield


def data(a: list[int], b: list[int], v: list[int]) -> dict[str, Series]:
    random = np.random.default_rng(len(a) + 10 * len(b))
    draw = lambda times: scalars(times, random.normal(size=len(times)))
    vectors = Series(np.asarray(v, np.int64), random.normal(size=(len(v), 3)))
    return {"a": draw(a), "b": draw(b), "v": vectors}


@pytest.mark.parametrize("name", GRAPHS)
def test_these_graphs_go_in_parts(name):
    scan_ = Scan(lower(BUILT[name]), (1, 2, 3, 4, 5, 6, 7), np.dtype(float), CHUNK)
    assert scan_._parts is not None
    assert bool(scan_._parts.carried) == (name == "folded")


TIMES = st.lists(st.integers(0, 40), unique=True, max_size=30).map(sorted)


@pytest.mark.parametrize("name", GRAPHS)
@settings(deadline=None, max_examples=40)
@given(TIMES, TIMES, TIMES)
def test_any_times_give_what_the_reference_gives(name, a, b, v):
    inputs = data(a, b, v)
    same(
        simulate(BUILT[name], inputs, engine="reference"),
        simulate(BUILT[name], inputs, engine="xla"),
        exact=False,
    )


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("every", [1, 2, 3, 5, 8, 9, 40])
@pytest.mark.parametrize("first", [0, 1, 7, 8, 17])
def test_even_times_do_wherever_chunks_end(name, every, first):
    inputs = data([*range(40)], [*range(first, 40, every)], [*range(0, 40, 4)])
    same(
        simulate(BUILT[name], inputs, engine="reference"),
        simulate(BUILT[name], inputs, engine="xla"),
        exact=False,
    )


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("cut", [3, 8, 20])
def test_a_run_goes_on_from_what_was_held(name, cut):
    """The last value of an input that does not come again is in the state, and stays."""
    inputs = data([*range(30)], [1, 2], [0, 5])
    early = {n: s[: int((s.time < cut).sum())] for n, s in inputs.items()}
    late = {n: s[int((s.time < cut).sum()) :] for n, s in inputs.items()}
    options: Any = {"engine": "xla"}
    begun = simulate(BUILT[name], early, **options)
    rest = simulate(BUILT[name], late, state=begun.state, **options)
    whole = simulate(BUILT[name], inputs, engine="reference")
    for output, series in whole.series.items():
        joined = np.concatenate([begun[output]["value"], rest[output]["value"]])
        np.testing.assert_allclose(joined, series["value"], rtol=1e-12, atol=1e-12)


def test_float32_stays_float32():
    usual = data([*range(20)], [12], [15])
    narrow = simulate(BUILT["held"], usual, engine="xla", dtype="float32")
    found = narrow["sum"]["value"]
    np.testing.assert_array_equal(found, found.astype(np.float32))
    np.testing.assert_allclose(
        narrow["sum"]["value"], simulate(BUILT["held"], usual)["sum"]["value"], rtol=1e-5
    )


def test_what_an_earlier_recording_left_is_not_seen():
    """Numbers before an input's first value may be anything, even such as overflow."""
    huge = {**data([*range(20)], [0, 9], [3]), "b": scalars([0, 9], [1e300, 1e300])}
    usual = data([*range(20)], [12], [15])
    simulate(BUILT["held"], huge, engine="xla", diverged="count")
    same(simulate(BUILT["held"], usual), simulate(BUILT["held"], usual, engine="xla"), exact=False)


@pytest.mark.parametrize("name", GRAPHS)
def test_many_runs_do_as_single_ones(name):
    """With the same inputs for all, and with other values at the same times for each."""
    recordings = [data([*range(25)], [3, 4, 20], [0, 9]) for _ in range(3)]
    for k, some in enumerate(recordings):
        some["b"] = scalars(some["b"].time, some["b"]["value"] + k)
    for inputs in (recordings[0], lambda seed: recordings[seed]):
        many = simulate_many(BUILT[name], inputs, [0, 1, 2], engine="xla")
        for seed in range(3):
            one = simulate(BUILT[name], recordings[seed] if callable(inputs) else inputs, engine="reference")
            for output, series in one.series.items():
                np.testing.assert_allclose(
                    many[output].run(seed)["value"], series["value"], rtol=1e-12, atol=1e-12
                )


def test_long_recordings_take_buffers_in_turns():
    """The next chunk is filled in while XLA plays one: neither sees the other's numbers."""
    built = BUILT["held"]
    times = range(0, 3000)
    inputs = data([*times], [*times[::3]], [*times[5::7]])
    expected = simulate(built, inputs)
    for _ in range(3):
        same(expected, simulate(built, inputs, engine="xla"), exact=False)


def test_a_run_that_is_left_leaves_the_next_alone():
    """Whoever stops taking chunks has used up no buffer of another."""
    built = BUILT["held"]
    inputs = data([*range(40)], [3, 9], [4])
    expected = simulate(built, inputs, engine="xla")
    scans = [s for s in lower(built).__dict__.get("_scans", {}).values()]
    with patch.object(Scan, "_handed", side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
        simulate(built, inputs, engine="xla")
    same(expected, simulate(built, inputs, engine="xla"), exact=False)
    assert all(len(s._free) <= 2 for s in scans)


def test_a_periodic_source_may_be_short_of_the_others():
    g = held.build(a=periodic(1), b=periodic(5), v=periodic(3))
    inputs = data([*range(33)], [*range(0, 10, 5)], [*range(0, 33, 3)])
    same(simulate(g, inputs, engine="reference"), simulate(g, inputs, engine="xla"), exact=False)
