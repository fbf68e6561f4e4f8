"""Fixed point: the interpreter is the definition, C is equal to the bit, and what does not fit is counted."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Annotated, Any

import numpy as np
import pytest

from flowgraph import (
    DataError,
    DeclarationError,
    LoweringError,
    Scalar,
    Series,
    Stream,
    block,
    graph,
    lower,
    real,
    simulate,
    simulate_many,
)
from flowgraph.engines.fixed import rules
from flowgraph.engines.fixed.abreast import Recorded
from flowgraph.engines.fixed.ranges import Sizes
from flowgraph.engines.options import RunOptions
from flowgraph.engines.reference import Interpreter
from flowgraph.engines.subject import LoweredGraph
from flowgraph.pipeline.format_files import with_formats
from flowgraph.pipeline.formats import Formats
from flowgraph.pipeline.plain import plain
from flowgraph.pipeline.program import needed, needed_of
from flowgraph.recorder.random import seed_words
from tests.graphs.library import library_case
from tests.support import same

MS = 1_000_000
Two = Annotated[Any, real(2)]
Three = Annotated[Any, real(3)]


def sizes_of(built, inputs):
    return sizes_of_many([(built, inputs)])


def sizes_of_many(flights):
    given = []
    for seed, (built, inputs) in enumerate(flights):
        subject = LoweredGraph(built)
        start = subject.start(RunOptions(seed=seed))
        given.append(
            Recorded(plain(subject.pipeline), subject.tape(inputs, start.last), start.cells, seed_words(seed))
        )
    sizes = Sizes(given[0].pipeline)
    sizes.play(given)
    return sizes


@cache
def formats_of(name, width, duration=0.5):
    case = library_case(name, duration)
    return sizes_of(case.graph, case.inputs).formats(width, 4.0)


@pytest.mark.parametrize(
    ("name", "width", "most"),
    [("kalman", 24, 2e-4), ("complementary", 32, 1e-5),
     pytest.param("ins_eskf", 28, 1e-4, marks=pytest.mark.slow),
     pytest.param("rbpf_indoor", 28, 1e-3, marks=pytest.mark.slow)],
)  # fmt: skip
def test_c_is_equal_to_the_interpreter_and_both_are_near_to_float64(name, width, most):
    case = library_case(name, 0.5)
    formats = formats_of(name, width)
    ours = simulate(case.graph, case.inputs, engine="fixed", formats=formats)
    theirs = simulate(case.graph, case.inputs, engine="c", dtype="fixed", formats=formats)
    same(ours, theirs)  # with the counts
    assert ours.notes == theirs.notes
    assert ours.ticks > 20
    real = simulate(case.graph, case.inputs, engine="reference")
    for leaf, x in ours[case.estimate].leaves.items():
        if leaf in ("position", "attitude"):
            difference = np.abs(x - real[case.estimate][leaf]).max()
            assert 0.0 < difference < most


@block
def mixed(x: Three, *, xp) -> Three:
    """Something of everything that has words."""
    up = xp.where(x > 0.5, xp.sqrt(xp.abs(x)), -xp.exp(x))
    turned = xp.sin(x) * xp.cos(up) + xp.atan2(up, x + 2.0)
    order = xp.take(xp.sort(turned), xp.argsort(x), axis=0)
    count = xp.astype(xp.floor(4.0 * x), xp.int32) % 3
    most = xp.max(turned) - xp.min(x) + xp.sum(x) / 3.0
    steps = xp.cumulative_sum(xp.abs(x)) + xp.asarray(count, dtype=x.dtype)
    most = most + xp.sum(xp.unnormalized_sinc(3.0 * x) - xp.unnormalized_sinc(0.0 * x))
    return order * most + xp.remainder(steps, 1.5) - xp.round(up) + xp.copysign(xp.hypot(x, up), x)


@graph
def everything(x: Stream[Three]):
    """One block."""
    return {"y": mixed(x)}


def _flight(seed=0, scale=1.0):
    rng = np.random.default_rng(seed)
    return {"x": (np.arange(60, dtype=np.int64) * MS, scale * rng.uniform(-1.0, 1.0, (60, 3)))}


def test_operations_are_near_to_floating_point_and_equal_in_c():
    built = everything.build()
    formats = sizes_of(built, _flight()).formats(30, 2.0)
    ours = simulate(built, _flight(), engine="fixed", formats=formats)
    same(ours, simulate(built, _flight(), engine="c", dtype="fixed", formats=formats))
    assert ours.stats["saturations"] == 0
    real = simulate(built, _flight())["y"]["value"]
    assert np.quantile(np.abs(ours["y"]["value"] - real), 0.95) < 1e-6  # a floor may fall on the other side


@pytest.mark.parametrize(("bits", "held"), [((30,), 0), ((29, 32), 44), ((28, 40), 40)])
def test_words_of_several_widths_are_equal_in_c(bits, held):
    built = everything.build()
    sizes = sizes_of(built, _flight())
    plain = sizes.formats(24, 2.0, held)
    some = sorted(plain.fractions)[::3]
    wider = {n: bits[k % len(bits)] for k, n in enumerate(some)}
    formats = sizes.formats(24, 2.0, held, wider)
    assert {formats.width_of(n) for n in formats.fractions} == {24, *bits, *([held] if held else [])}
    ours = simulate(built, _flight(), engine="fixed", formats=formats)
    same(ours, simulate(built, _flight(), engine="c", dtype="fixed", formats=formats))
    narrow = simulate(built, _flight(), engine="fixed", formats=plain)
    assert (ours["y"]["value"] != narrow["y"]["value"]).any()
    assert Formats.from_json(json.loads(json.dumps(formats.to_json()))).to_json() == formats.to_json()


def test_what_is_too_large_is_cut_and_counted_by_name_and_line():
    built = everything.build()
    formats = sizes_of(built, _flight()).formats(24, 1.0)
    ours = simulate(built, _flight(scale=4.0), engine="fixed", formats=formats)
    same(ours, simulate(built, _flight(scale=4.0), engine="c", dtype="fixed", formats=formats))
    assert ours.stats["saturations"] == sum(n for k, n in ours.stats.items() if k.startswith("saturations."))
    at_input = next(n for k, n in ours.stats.items() if "input x.value" in k)
    assert at_input == np.count_nonzero(np.abs(4.0 * _flight()["x"][1]) > 1.0 + 1e-6) > 0
    assert any(
        note.startswith("counted: saturations") and "tests.engines.fixed" in note for note in ours.notes
    )


@block
def ratio(x: Scalar, *, xp) -> Scalar:
    """A guard that only floating point keeps, and one that words keep too."""
    guarded = xp.where(xp.abs(x) < 1e-3, 1.0, 1.0 / x)
    return guarded + x * x / xp.maximum(x * x, 1e-30)


@graph
def ratios(x: Stream[Scalar]):
    """One block."""
    return {"y": ratio(x)}


@block
def inverse(x: Scalar, *, xp) -> Scalar:
    return -1.0 / x


@graph
def inverses(x: Stream[Scalar]):
    """One block."""
    return {"y": inverse(x)}


def test_less_than_nothing_over_zero_is_the_least_word_and_not_an_absent_reading():
    built = inverses.build()
    flight = {"x": (np.arange(3, dtype=np.int64) * MS, np.array([1.0, 0.5, 0.25]))}
    formats = sizes_of(built, flight).formats(20, 2.0)
    worse = {"x": (flight["x"][0], np.array([1.0, 0.0, 0.5]))}
    ours = simulate(built, worse, engine="fixed", formats=formats)
    same(ours, simulate(built, worse, engine="c", dtype="fixed", formats=formats))
    assert np.isfinite(ours["y"]["value"]).all()
    assert ours["y"]["value"][1] < -4.0
    assert ours.stats["saturations"] >= 1


def test_divisions_by_zero_are_counted_where_they_are_taken():
    built = ratios.build()
    flight = {"x": (np.arange(4, dtype=np.int64) * MS, np.array([1.0, 0.0, 0.5, 0.0]))}
    formats = sizes_of(built, flight).formats(20, 2.0)
    ours = simulate(built, flight, engine="fixed", formats=formats)
    same(ours, simulate(built, flight, engine="c", dtype="fixed", formats=formats))
    by_zero = {k: n for k, n in ours.stats.items() if k.startswith("divisions_by_zero.")}
    assert ours.stats["divisions_by_zero"] == 2
    assert list(by_zero.values()) == [2]
    assert ours.stats["saturations"] == 0  # 1 / 0 was not taken
    np.testing.assert_allclose(ours["y"]["value"], [2.0, 1.0, 3.0, 1.0], atol=1e-4)


def test_words_that_become_zero_are_counted():
    built = ratios.build()
    flight = {"x": (np.arange(2, dtype=np.int64) * MS, np.array([1.0, 2e-3]))}
    formats = sizes_of(built, flight).formats(12, 1.0)
    ours = simulate(built, flight, engine="fixed", formats=formats)
    same(ours, simulate(built, flight, engine="c", dtype="fixed", formats=formats))
    assert ours.stats["lost_bits"] >= 1
    assert any(k.startswith("lost_bits.") for k in ours.stats)


@block
def filled(x: Two, *, xp) -> Two:
    """What is not there becomes zero."""
    return 2.0 * xp.where(xp.isnan(x), 0.0, x)


@graph
def absent(x: Stream[Two]):
    """One block."""
    return {"y": filled(x)}


def _gaps(*rows):
    return {"x": Series(np.arange(len(rows), dtype=np.int64) * MS, np.array(rows), gaps=True)}


def test_a_reading_that_is_not_there_is_a_word_of_its_own():
    built = absent.build()
    flight = _gaps([1.0, np.nan], [np.nan, 0.25], [0.5, 0.125])
    formats = sizes_of(built, flight).formats(16, 2.0)
    ours = simulate(built, flight, engine="fixed", formats=formats)
    same(ours, simulate(built, flight, engine="c", dtype="fixed", formats=formats))
    assert ours["y"]["value"].tolist() == [[2.0, 0.0], [0.0, 0.5], [1.0, 0.25]]
    never = sizes_of(built, _gaps([1.0, 1.0])).formats(16, 2.0)
    with pytest.raises(DataError, match="(?s)a reading is NaN that never was one"):
        simulate(built, flight, engine="fixed", formats=never)


def test_a_pattern_that_was_not_seen_is_refused_with_the_place():
    formats = formats_of("kalman", 24)
    some = replace(formats, fractions=dict(list(formats.fractions.items())[:20]))
    kalman = library_case("kalman", 0.5)
    with pytest.raises(LoweringError, match="(?s)a value has no number format"):
        simulate(kalman.graph, kalman.inputs, engine="fixed", formats=some)


def test_without_formats_a_run_says_where_they_come_from():
    case = library_case("kalman", 0.5)
    for engine in ("fixed", "c"):
        with pytest.raises(DeclarationError, match="(?s)no number formats.*flowgraph quantise"):
            simulate(case.graph, case.inputs, engine=engine, dtype="fixed")


def test_formats_are_for_fixed_point_alone():
    case = library_case("kalman", 0.5)
    with pytest.raises(DeclarationError, match="(?s)number formats are for a run in fixed point"):
        simulate(case.graph, case.inputs, engine="reference", formats=formats_of("kalman", 24))


def test_many_runs_in_fixed_point_go_one_by_one():
    built, formats = everything.build(), sizes_of(everything.build(), _flight()).formats(24, 2.0)
    batch = simulate(built, _flight(), engine="c", dtype="fixed", formats=formats, seeds=range(2))
    alone = simulate(built, _flight(), engine="fixed", formats=formats)
    for n in range(2):
        np.testing.assert_array_equal(batch["y"]["value"][n], alone["y"]["value"])
    with pytest.raises(DeclarationError, match="(?s)no number formats"):
        simulate_many(built, _flight(), range(2), engine="c", dtype="fixed")


def test_a_description_with_formats_plays_without_its_graph():
    built, formats = everything.build(), sizes_of(everything.build(), _flight()).formats(24, 2.0)
    pipeline = with_formats(lower(built), formats)
    found = pipeline.run(_flight(), engine="fixed")
    np.testing.assert_array_equal(
        found["y"]["value"], simulate(built, _flight(), engine="fixed", formats=formats)["y"]["value"]
    )


def test_an_operation_without_a_form_is_named(monkeypatch):
    monkeypatch.delitem(rules._REAL, "hypot")
    built = everything.build()
    with pytest.raises(LoweringError, match=r"test_fixed:\d+: hypot has no form in fixed point"):
        simulate(built, _flight(), engine="fixed", formats=sizes_of(built, _flight()).formats(24, 2.0))


@pytest.mark.parametrize("name", ["kalman", "complementary", "orientation_complementary"])
def test_what_some_values_bear_on_is_what_all_are_asked_for(name):
    case = library_case(name, 0.3)
    subject = LoweredGraph(case.graph)
    pipeline = plain(subject.pipeline)
    start = subject.start(RunOptions())
    player = Interpreter(pipeline, start.cells, np.dtype(np.float64), seed_words(0))
    tape = subject.tape(case.inputs, start.last)
    rows = [zip(*s.leaves.values(), strict=True) for s in tape.series]
    partly = 0
    for time, key in zip(tape.time.tolist(), tape.key.tolist(), strict=True):
        given = [next(row) for k, row in enumerate(rows) if key >> k & 1]
        with np.errstate(all="ignore"):
            program, env = player.values(time, key, given)
        player.cells = [env[n] for n in program.writes]
        whole = needed(program, env)
        outs = [i.out for i in program.instructions]
        for n in outs:
            found = needed_of(program, env, [n]).get(n, False)
            wanted = np.broadcast_to(whole.get(n, False), np.shape(env[n]))
            assert (np.broadcast_to(found, np.shape(env[n])) == wanted).all()
            partly += not wanted.all()
    assert partly
