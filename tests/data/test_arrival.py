"""When values arrive and when they were true: series, settings, the stamps that a graph asks for."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    Flight,
    Run,
    Scalar,
    Series,
    Stream,
    apply,
    batched,
    delayed,
    graph,
    latest,
    load_flight,
    lower,
    reorder,
    replayed,
    simulate,
    stamp_of,
    timeouts,
)
from flowgraph.data.arrival import with_stamps
from flowgraph.errors import DataError, DeclarationError, UnknownNameError
from tests.support import all_engines

MS = 1_000_000


@graph
def aged(imu: Stream[Scalar], fix: Stream[Scalar]):
    age = apply(lambda s, *, t, xp: xp.astype(t - s, xp.float64), stamp_of(fix), name="age")
    return {"age": age, "both": age + fix, "held": latest(fix, init=0.0).at(imu, name="held")}


IMU = Series(np.arange(40) * 5 * MS, np.arange(40.0))
FIX = Series(np.arange(8) * 20 * MS, np.arange(8.0), name="fix")


def test_a_delayed_series_keeps_the_times_at_which_it_was_true():
    late = delayed(FIX, "35ms")
    assert (late.time - late.stamp == 35 * MS).all()
    assert (late.stamp == FIX.time).all()
    assert (late[2:5].stamp == FIX.time[2:5]).all()
    assert late.is_late
    assert not FIX.is_late
    assert FIX.stamp is FIX.time
    further = delayed(late, np.full(8, 5 * MS))
    assert (further.time - further.stamp == 40 * MS).all()


def test_random_delays_are_drawn_by_seed_and_reorder():
    late = delayed(FIX, ("0ms", "100ms"), seed=3)
    again = delayed(FIX, ("0ms", "100ms"), seed=3)
    assert (late.time == again.time).all()
    assert (late.time != delayed(FIX, ("0ms", "100ms"), seed=4).time).any()
    assert (np.diff(late.time) > 0).all()
    assert (np.diff(late.stamp) < 0).any()
    assert sorted(late.stamp.tolist()) == FIX.time.tolist()
    assert (FIX.value[late.stamp // (20 * MS)] == late.value).all()


def test_values_that_would_arrive_together_arrive_one_after_the_other():
    together = delayed(FIX, np.maximum(100 * MS - FIX.time, 0))
    assert together.time[:6].tolist() == [100 * MS + k for k in range(6)]


def test_a_graph_that_asks_is_told_in_all_engines():
    late = delayed(FIX, ("0ms", "100ms"), seed=3)
    found = all_engines(aged.build(), {"imu": IMU, "fix": late})
    assert (found["age"].value == late.time - late.stamp).all()
    assert (found["both"].value == late.time - late.stamp + late.value).all()
    on_time = simulate(aged.build(), {"imu": IMU, "fix": FIX})
    assert not on_time["age"].value.any()
    pair = simulate(aged.build(), {"imu": IMU, "fix": (FIX.time, FIX.value)})
    assert not pair["age"].value.any()


def test_a_pipeline_alone_is_told_too():
    late = delayed(FIX, "35ms")
    found = lower(aged.build()).run({"imu": IMU, "fix": late}, engine="reference")
    assert (found["age"].value == 35 * MS).all()


def test_a_graph_that_does_not_ask_has_nothing_more():
    @graph
    def plain(fix: Stream[Scalar]):
        return fix.map(lambda v: 2 * v)

    built = plain.build()
    assert list(built.sources) == ["fix"]
    assert len(lower(built).inputs) == 1
    late = delayed(FIX, "35ms")
    assert (simulate(built, {"fix": late}).output.time == late.time).all()


def test_the_diagram_names_the_stamps():
    text = aged.build().text()
    assert "fix.stamp" in text
    assert "with fix: when it was true" in text


def test_live_events_say_when_they_were_true():
    run = Run(aged.build())
    run.push(10, fix=1.0)
    run.push(20, fix=2.0, **{"fix.stamp": 13})
    assert run.result()["age"].value.tolist() == [0.0, 7.0]
    for wrong, said in (
        ({"fix": 1.0, "fix.stamp": 31}, "after it arrived"),
        ({"imu": 1.0, "fix.stamp": 3}, "without"),
    ):
        with pytest.raises(DataError, match=said):
            run.push(30, **wrong)
    run.push(30, fix=3.0)
    assert run.ticks == 3


def test_a_flight_of_any_kind_can_be_late():
    plain = load_flight("sim", settings={"duration": "2"})
    late = load_flight("sim", settings={"duration": "2", "vicon.latency": "0.1"})
    vicon = late.streams["vicon"]
    assert (vicon.stamp == plain.streams["vicon"].time).all()
    assert (vicon.time - vicon.stamp == 10**8).all()
    assert not late.streams["imu"].is_late
    assert "info: vicon: each value arrives 0.1 s after it was true" in late.notes
    random = load_flight("sim", settings={"duration": "2", "vicon.latency": "0.1:0.4"}).streams["vicon"]
    gone = random.time - random.stamp
    assert 10**8 <= gone.min() < gone.max() <= 4 * 10**8


def test_what_is_no_latency_is_refused():
    for given in ("-0.1", "fast", "0.3:0.1", "1:2:3", "nan", "1_0"):
        with pytest.raises(DeclarationError, match=r"vicon.latency"):
            load_flight("sim", settings={"duration": "1", "vicon.latency": given})
    with pytest.raises(UnknownNameError, match="leica"):
        load_flight("sim", settings={"duration": "1", "leica.latency": "0.1"})
    with pytest.raises(DeclarationError, match="this is no latency"):
        delayed(FIX, ("2ms", "1ms"))


def test_stamps_that_cannot_be_are_refused():
    with pytest.raises(DataError, match="true only after it arrived"):
        Series(FIX.time, FIX.value, stamp=FIX.time + 1)
    with pytest.raises(DataError, match="not one a value"):
        Series(FIX.time, FIX.value, stamp=FIX.time[1:])
    with pytest.raises(DataError, match="asks when the values of 'fix' were true"):
        with_stamps(["fix", "fix.stamp"], {"fix": iter(())})


def test_only_what_arrives_has_stamps():
    @graph
    def asks(fix: Stream[Scalar]):
        return stamp_of(fix.map(lambda v: v))

    with pytest.raises(DeclarationError, match="only what arrives has stamps"):
        asks.build()


def test_reorder_holds_all_back_until_they_are_in_order():
    late = delayed(FIX, ("0ms", "30ms"), seed=3)
    held = reorder({"imu": IMU, "fix": late}, "30ms")
    assert (held["fix"].stamp == FIX.time).all()
    assert (held["fix"].time == FIX.time + 30 * MS).all()
    assert (held["fix"].value == FIX.value).all()
    assert (held["imu"].time == IMU.time + 30 * MS).all()
    assert held.late == {"imu": 0, "fix": 0}
    on_time = simulate(aged.build(), {"imu": IMU, "fix": FIX})
    found = simulate(aged.build(), held)
    assert (found["held"].value == on_time["held"].value).all()
    assert (found["held"].time == on_time["held"].time + 30 * MS).all()


def test_what_comes_later_than_is_waited_for_is_left_out_and_counted():
    late = delayed(FIX, np.where(np.arange(8) == 2, 50, 10) * MS)
    held = reorder({"fix": late}, "20ms")
    assert held.late == {"fix": 1}
    assert held["fix"].value.tolist() == [0, 1, 3, 4, 5, 6, 7]
    twice = Series([10, 20, 30], [1.0, 2.0, 3.0], stamp=[5, 5, 30])
    assert reorder({"fix": twice}, 100)["fix"].value.tolist() == [1.0, 3.0]
    with pytest.raises(DeclarationError, match="held back for less than no time"):
        reorder({"fix": FIX}, -1)
    assert len(reorder({"fix": FIX[:0]}, 5)["fix"]) == 0


def test_timeouts_are_ticks_of_their_own():
    s = Series(np.array([0, 10, 50, 55]) * MS, np.zeros(4))
    assert (timeouts(s, "15ms").time // MS).tolist() == [25]
    assert (timeouts(s, "15ms", until=100 * MS).time // MS).tolist() == [25, 70]
    assert (timeouts(s, "5ms", until=100 * MS).time // MS).tolist() == [5, 15, 60]
    assert len(timeouts(s[:0], "5ms")) == 0


def test_a_stream_that_never_comes_has_its_timeout():
    s = Series(np.array([10, 50]) * MS, np.zeros(2))
    assert (timeouts(s[:0], "15ms", until=100 * MS).time // MS).tolist() == [15]
    assert (timeouts(s[:0], "15ms", start=-40 * MS, until=100 * MS).time // MS).tolist() == [-25]
    assert len(timeouts(s[:0], "15ms", until=14 * MS)) == 0
    assert (timeouts(s, "15ms", start=-10 * MS).time // MS).tolist() == [5, 25]
    assert (timeouts(s, "15ms", start=0).time // MS).tolist() == [25]
    assert (timeouts(s, "15ms", start=20 * MS, until=70 * MS).time // MS).tolist() == [35, 65]
    assert len(timeouts(s, 2**63 - 1, until=2**63 - 1)) == 0  # no sum is beyond int64
    assert timeouts(s, "1ms", until=-5).time.tolist() == []


@pytest.mark.parametrize("after", [0, -5, "0s"])
def test_a_timeout_after_no_time_is_refused(after):
    with pytest.raises(DeclarationError, match="a timeout comes after some time"):
        timeouts(FIX, after)


@pytest.mark.parametrize("given", [[0.1] * 8, [0] * 7 + [0.5], [float("nan")] * 8, [True] * 8])
def test_latencies_in_an_array_are_whole_nanoseconds(given):
    with pytest.raises(DeclarationError, match="latencies in an array are integer nanoseconds"):
        delayed(FIX, np.array(given))


def test_an_array_of_any_whole_numbers_delays():
    late = delayed(FIX, np.full(8, 5 * MS, np.uint32))
    assert (late.time - late.stamp == 5 * MS).all()
    assert (delayed(FIX[:0], "5ms").time == FIX[:0].time).all()
    with pytest.raises(DeclarationError, match="beyond what int64 nanoseconds hold"):
        delayed(FIX, np.full(8, 2**63, np.uint64))


@pytest.mark.parametrize(
    "moved",
    [
        lambda: delayed(Series([9 * 10**18], [1.0]), "1000000000s"),
        lambda: delayed(Series([2**63 - 7], [1.0]), ("0ns", "100ns")),
        lambda: replayed(FIX, start=2**63 - 5),
        lambda: replayed(delayed(FIX, "5ms"), start=-(2**63) + 5),
    ],
)
def test_no_time_wraps_around(moved):
    with pytest.raises(DeclarationError, match="a time would be beyond what int64 nanoseconds hold"):
        moved()


def test_what_is_made_of_late_values_is_late():
    late = delayed(FIX, ("0ms", "100ms"), seed=3)
    doubled = batched(late, lambda v: 2 * v)
    assert (doubled.time == late.time).all()
    assert (doubled.stamp == late.stamp).all()
    assert (simulate(aged.build(), {"imu": IMU, "fix": doubled})["age"].value == late.time - late.stamp).all()
    assert not batched(FIX, lambda v: 2 * v).is_late


def test_a_recording_is_worked_on_whole_and_played_again():
    smooth = batched(FIX, lambda v: v - v.mean())
    assert smooth.value.sum() == 0.0
    again = replayed(delayed(smooth, "5ms"), start=10**9)
    assert again.time[0] == 10**9
    assert (np.diff(again.time) == np.diff(FIX.time)).all()
    assert (again.time - again.stamp == 5 * MS).all()
    assert not replayed(FIX, start=0).is_late


def test_what_is_no_recording_is_refused():
    for wrong in ([1, 2], None, (IMU.time, np.zeros(40))):
        for refused in (
            lambda w: delayed(w, "5ms"),
            lambda w: timeouts(w, "5ms"),
            lambda w: batched(w, abs),
            lambda w: replayed(w, start=0),
        ):
            with pytest.raises(DataError, match="this is no series(.*\\n)*.*expected: +a Series"):
                refused(wrong)
    with pytest.raises(DataError, match="reorder.imu: this is no series"):
        reorder({"imu": iter([(0, 1.0)])}, "5ms")
    with pytest.raises(DataError, match="reorder: these are no streams by name"):
        reorder(IMU, "5ms")  # type: ignore[arg-type]


def test_a_flight_is_reordered_as_its_streams():
    flight = Flight("late", {"fix": delayed(FIX, ("0ms", "60ms"))})
    assert (reorder(flight, "60ms")["fix"].stamp == FIX.time).all()
    assert reorder(flight, "60ms").late == {"fix": 0}


def test_times_that_are_none_are_refused():
    for wrong in (0.5, 1e4, True):
        with pytest.raises(DataError, match="replayed.start: times must be integer nanoseconds"):
            replayed(FIX, start=wrong)  # type: ignore[arg-type]
        with pytest.raises(DataError, match="timeouts.until: times must be integer nanoseconds"):
            timeouts(FIX, "5ms", until=wrong)  # type: ignore[arg-type]
        with pytest.raises(DataError, match="timeouts.start: times must be integer nanoseconds"):
            timeouts(FIX, "5ms", start=wrong)  # type: ignore[arg-type]
    with pytest.raises(DeclarationError, match="beyond what int64 nanoseconds hold"):
        reorder({"fix": Series([2**63 - 5], np.ones(1))}, "1s")
