"""Inputs: what a source verifies as events arrive, and the rules that a user may name."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    Array,
    ClockError,
    DataError,
    DeclarationError,
    Flight,
    Scalar,
    Series,
    Signal,
    Stream,
    TypeMismatchError,
    UnknownNameError,
    aperiodic,
    arrays,
    graph,
    periodic,
    real,
    simulate,
    ticks,
    timing_of,
)
from tests.support import pairs, scalars


class Fix(Signal):
    place: Array = real(2, unit="m")
    weight: Array = real()


@graph
def copy(x: Stream[Scalar]):
    return x.map(lambda v: v)


@graph
def weights(fix: Stream[Fix]):
    return fix.map(lambda f: f.weight)


def run(times, values=None, clock=None, *, lazily=False):
    series = scalars(times, values)
    inputs = {"x": iter(pairs(series)) if lazily else series}
    return simulate(copy.build(**({} if clock is None else {"x": clock})), inputs)


LAZILY = pytest.mark.parametrize("lazily", [False, True])


@LAZILY
def test_stamps_out_of_order_are_refused_with_their_place(lazily):
    with pytest.raises(DataError, match=r"x, event .*time goes backwards") as error:
        run([0, 20, 10], lazily=lazily)
    assert error.value.got == "20 ns, then 10 ns"
    assert "sort" in str(error.value.fix)


@LAZILY
def test_two_events_at_one_time_are_refused(lazily):
    with pytest.raises(DataError, match="two events at one time") as error:
        run([0, 10, 10], lazily=lazily)
    assert 'duplicates="last"' in str(error.value.fix)


@LAZILY
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(lazily, bad):
    with pytest.raises(DataError, match=r"x, .*: a value is not finite") as error:
        run([0, 10, 20], [1.0, bad, 2.0], lazily=lazily)
    assert "t = 10 ns" in str(error.value.got)
    assert 'not_finite="absent"' in str(error.value.fix)


def test_a_bad_row_of_a_struct_is_found_in_any_field():
    place = np.zeros((3, 2))
    place[2, 1] = np.nan
    with pytest.raises(DataError, match=r"fix, row 2 \(1 in all\)"):
        simulate(weights.build(), {"fix": Series([0, 1, 2], Fix(place, np.zeros(3)))})


@pytest.mark.parametrize(("rule", "kept"), [("first", [1.0, 2.0, 4.0]), ("last", [1.0, 3.0, 4.0])])
def test_rules_for_duplicates(rule, kept):
    made = arrays([0, 10, 10, 20], np.array([1.0, 2.0, 3.0, 4.0]), duplicates=rule)
    assert [v for _, v in pairs(simulate(copy.build(), {"x": made}).output)] == kept


def test_rule_for_values_that_are_not_finite():
    made = arrays([0, 10, 20], np.array([1.0, np.nan, 3.0]), not_finite="absent")
    assert pairs(simulate(copy.build(), {"x": made}).output) == [(0, 1.0), (20, 3.0)]


def test_without_a_rule_arrays_change_nothing():
    made = arrays([0, 10, 10], np.array([1.0, np.nan, 3.0]))
    assert len(made) == 3


def test_rules_of_an_empty_recording():
    assert len(arrays(np.zeros(0, int), np.zeros(0), duplicates="first", not_finite="absent")) == 0


@pytest.mark.parametrize("rule", [{"duplicates": "drop"}, {"not_finite": "zero"}])
def test_unknown_rules_list_the_valid_ones(rule):
    with pytest.raises(UnknownNameError, match="no rule for"):
        arrays([0], np.zeros(1), **rule)


@LAZILY
def test_the_period_is_verified(lazily):
    assert run([3, 13, 23], clock=periodic(10), lazily=lazily).ticks == 3
    with pytest.raises(ClockError, match=r"x, event .*do not keep the declared period") as error:
        run([0, 10, 21], clock=periodic(10), lazily=lazily)
    assert "11 ns" in str(error.value.got)
    assert "jitter" in str(error.value.fix)


@LAZILY
def test_a_gap_is_not_a_period(lazily):
    with pytest.raises(ClockError, match="declared period"):
        run([0, 10, 30], clock=periodic(10), lazily=lazily)


@LAZILY
def test_jitter_allows_what_it_says(lazily):
    clock = periodic(100, jitter=5)
    assert run([0, 105, 200], clock=clock, lazily=lazily).ticks == 3
    with pytest.raises(ClockError, match="declared period") as error:
        run([0, 106], clock=clock, lazily=lazily)
    assert "100 ns +- 5 ns" in str(error.value.expected)


@LAZILY
def test_the_phase_is_verified(lazily):
    clock = periodic(10, phase=3)
    assert run([13, 23], clock=clock, lazily=lazily).ticks == 2
    assert run([-7, 3], clock=clock, lazily=lazily).ticks == 2
    with pytest.raises(ClockError, match=r"x, event 0: the data do not keep the declared phase") as error:
        run([14, 24], clock=clock, lazily=lazily)
    assert "10 ns plus 3 ns" in str(error.value.expected)


@LAZILY
def test_the_highest_rate_is_verified(lazily):
    clock = aperiodic(max_rate=100)
    assert run([0, 10_000_000], clock=clock, lazily=lazily).ticks == 2
    with pytest.raises(ClockError, match="closer than the declared highest rate") as error:
        run([0, 9_999_999], clock=clock, lazily=lazily)
    assert "100 Hz" in str(error.value.expected)


@pytest.mark.parametrize(
    ("times", "clock"),
    [
        ([3, 13, 23], periodic(10, phase=3)),
        ([0, 1000, 2001, 3000], periodic(1000, jitter=1)),
        ([0, 10, 500], aperiodic(max_rate=1e8)),
        ([0], aperiodic()),
        ([], aperiodic()),
    ],
)
def test_the_clock_of_a_recording_is_one_that_it_keeps(times, clock):
    found = timing_of(scalars(times))
    assert found == clock
    assert run(times, clock=found).ticks == len(times)


def test_the_clock_of_a_recording_with_duplicates_is_for_the_run_to_refuse():
    series = scalars([5, 5, 5])
    with pytest.raises(DataError, match="two events at one time"):
        simulate(copy.build(x=timing_of(series)), {"x": series})


def test_float_times_are_refused_everywhere():
    for inputs in (
        {"x": (np.array([0.0, 1.0]), np.zeros(2))},
        {"x": iter([(0.0, 1.0)])},
        {"x": iter([(True, 1.0)])},
    ):
        with pytest.raises(DataError, match="x: times must be integer nanoseconds") as error:
            simulate(copy.build(), inputs)
        assert "round" in str(error.value.fix)


@pytest.mark.parametrize(
    ("inputs", "error", "words"),
    [
        ({}, DataError, "copy: source 'x' has no data"),
        ({"x": scalars([0]), "y": scalars([0])}, UnknownNameError, "no source is called 'y'"),
        ({"x": 3.0}, DataError, "given something that holds no events"),
        ({"x": [3.0]}, DataError, "x: an event is not a pair"),
        ({"x": [(0, np.zeros(2))]}, TypeMismatchError, "source x: the shape"),
        ({"x": ([0], np.zeros((1, 2)))}, TypeMismatchError, "the shape of the data of x"),
        ({"x": ([0], np.array([True]))}, TypeMismatchError, "the dtype of the data of x"),
        ({"x": ([0, 1], np.zeros(3))}, DataError, "x: field 'value' does not have one value a time stamp"),
        ({"x": Series([0], Fix(np.zeros((1, 2)), np.zeros(1)))}, TypeMismatchError, "another type"),
    ],
)
def test_inputs_that_do_not_fit(inputs, error, words):
    for engine in ("python", "reference"):
        with pytest.raises(error, match=words):
            simulate(copy.build(), inputs, engine=engine)


def test_arrays_where_a_struct_is_wanted_say_how_to_pack_them():
    with pytest.raises(TypeMismatchError, match="the data of source 'fix' are of another type") as error:
        simulate(weights.build(), {"fix": scalars([0])})
    assert "Fix(...)" in str(error.value.fix)


def test_integers_are_taken_as_reals():
    out = simulate(copy.build(), {"x": ([0, 1], np.array([3, 4]))}).output
    assert out.value.dtype == np.float64
    assert pairs(simulate(copy.build(), {"x": [(0, 3)]}).output) == [(0, 3.0)]


def test_a_flight_may_hold_more_than_a_graph_reads():
    flight = Flight("f", {"x": scalars([0]), "camera": scalars([0, 1])})
    assert simulate(copy.build(), flight).ticks == 1
    with pytest.raises(DataError, match="source 'x' has no data"):
        simulate(copy.build(), Flight("f", {}))


def test_the_users_arrays_are_not_changed_by_a_run():
    values = np.arange(4.0)
    simulate(copy.build(), {"x": (np.arange(4), values)})
    assert values.tolist() == [0.0, 1.0, 2.0, 3.0]


def test_ticks_that_are_none_are_refused():
    for period in (0, "0s", -5):
        with pytest.raises(DeclarationError, match="period: period is too short(.*\\n)*.*1 ns or more"):
            ticks(period, until="1s")
    with pytest.raises(DeclarationError, match="until: until is too short"):
        ticks("5ms", until=-5)
    with pytest.raises(DataError, match="ticks.start: times must be integer"):
        ticks("5ms", until="1s", start=0.5)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="ticks.until: this time does not fit 64 bits"):
        ticks("100ms", until="1s", start=2**63 - 10)
    with pytest.raises(
        DeclarationError, match=r"too many ticks[\s\S]*1,000,000,000,000: one each 1 ns[\s\S]*1000ns"
    ):
        ticks(1, until="1000s")
    assert not len(ticks("5ms", until=0))
    assert ticks("5ms", until="10ms", start="1s").time.tolist() == [1_000_000_000, 1_005_000_000]


def test_seconds_that_are_no_numbers_are_refused():
    with pytest.raises(DataError, match="fix: time: this is no array of numbers"):
        Series.from_seconds(["a", "b"], np.zeros(2), name="fix")
