"""Data frames and masked arrays: exact times, missing values, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Scalar, Series, Stream, arrays, find_graph, graph, load_flight, simulate
from flowgraph.blocks.signals import Imu, NavigationState, Pose
from flowgraph.engines.python.run import Run
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

pandas = pytest.importorskip("pandas")

START = 1400000000123456789
TIMES = [START, START + 5, START + 9]


@graph
def through(c: Stream[Scalar]):
    return c.map(lambda v: v)


CLOCKS = {
    "dates": pandas.DatetimeIndex(np.array(TIMES, "datetime64[ns]")),
    "dates of a zone": pandas.DatetimeIndex(np.array(TIMES, "datetime64[ns]"))
    .tz_localize("UTC")
    .tz_convert("Asia/Tokyo"),
    "spans": pandas.to_timedelta(TIMES, unit="ns"),
    "whole numbers": pandas.Index(TIMES),
    "whole numbers that may be missing": pandas.Index(TIMES, dtype="Int64"),
    "unsigned": pandas.Index(np.array(TIMES, np.uint64)),
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_times_are_exact_as_index_and_as_column(clock):
    frame = pandas.DataFrame({"v": [1.0, 2.0, 3.0]}, index=CLOCKS[clock])
    assert Series.from_pandas(frame).time.tolist() == TIMES
    assert Series.from_pandas(frame["v"]).values.tolist() == [1.0, 2.0, 3.0]
    columns = pandas.DataFrame({"t": CLOCKS[clock], "v": [1.0, 2.0, 3.0]})
    series = Series.from_pandas(columns, time="t", name="c")
    assert series.time.tolist() == TIMES
    assert simulate(through.build(), {"c": series}).output.value.tolist() == [1.0, 2.0, 3.0]


def test_numbers_of_a_unit():
    frame = pandas.DataFrame({"t": [0.5, 1.5], "k": [1, 2], "v": [1, 2]})
    assert Series.from_pandas(frame, columns="v", time="t", unit="s").time.tolist() == [
        500_000_000,
        1_500_000_000,
    ]
    assert Series.from_pandas(frame, columns="v", time="k", unit="ms").time.tolist() == [1_000_000, 2_000_000]
    assert Series.from_pandas(frame, columns=["v", "t"], time="k").values.shape == (2, 2)


WRONG = {
    "rows that are counted": (lambda: pandas.DataFrame({"v": [1.0, 2.0]}), {}, "counts rows: it is no clock"),
    "an index as a file gives it": (
        lambda: pandas.DataFrame({"v": [1.0, 2.0]}, index=pandas.Index([0, 1])), {}, "is no clock"),
    "every second row": (
        lambda: pandas.DataFrame({"v": np.arange(6.0)})[::2], {}, "counts rows: it is no clock"),
    "levels": (
        lambda: pandas.DataFrame({"v": [1.0], "a": [1], "b": [2]}).set_index(["a", "b"]), {}, "of 2 levels"),
    "floats without a unit": (
        lambda: pandas.DataFrame({"v": [1.0], "t": [0.5]}), {"time": "t"}, "unit=...) says their unit"),
    "texts": (lambda: pandas.DataFrame({"v": [1.0], "t": ["noon"]}), {"time": "t"}, "pandas.to_datetime"),
    "a date that is missing": (
        lambda: pandas.DataFrame({"v": [1.0, 2.0], "t": pandas.to_datetime(["2014-05-13", None])}),
        {"time": "t"}, "a missing stamp"),
    "beyond": (
        lambda: pandas.DataFrame({"v": [1.0], "t": [START]}), {"time": "t", "unit": "s"}, "within 64 bits"),
    "words": (lambda: pandas.DataFrame({"v": ["a"], "t": [5]}), {"time": "t"}, "holds no numbers"),
    "two of a name": (
        lambda: pandas.DataFrame([[1.0, 2.0, 3]], columns=["v", "v", "t"]), {"time": "t"}, "is ambiguous"),
}  # fmt: skip


def test_an_index_of_evenly_spaced_stamps_is_a_clock_where_its_unit_is_said():
    frame = pandas.DataFrame({"v": np.arange(3.0)}, index=pandas.RangeIndex(0, 30, 10))
    assert Series.from_pandas(frame, columns="v", unit="ms").time.tolist() == [0, 10_000_000, 20_000_000]
    with pytest.raises(DataError, match="counts rows"):
        Series.from_pandas(frame.reset_index(drop=True), columns="v", unit="ms")


@pytest.mark.parametrize("what", WRONG)
def test_what_is_no_recording_is_refused(what):
    make, more, part = WRONG[what]
    with pytest.raises(DataError) as caught:
        Series.from_pandas(make(), **more)
    for word in (part, "expected:", "got:", "fix:"):
        assert word in str(caught.value)


def test_names_that_are_not_there():
    frame = pandas.DataFrame({"t": [1], "v": [1.0]})
    with pytest.raises(UnknownNameError, match="no column is called 'w'"):
        Series.from_pandas(frame, time="t", columns=["w"])
    with pytest.raises(UnknownNameError, match="no unit of time is called 'year'"):
        Series.from_pandas(frame, time="t", unit="year")
    with pytest.raises(UnknownNameError, match="no column is called 'gyro'"):
        Series.from_pandas(frame, Imu, time="t")
    with pytest.raises(DataError, match="no columns are given for 'specific_force'"):
        Series.from_pandas(frame, Imu, columns={"gyro": ["v", "v", "v"]}, time="t")
    with pytest.raises(DeclarationError, match="go by its fields"):
        Series.from_pandas(frame, Imu, columns=["v"], time="t")
    with pytest.raises(DeclarationError, match="columns by field are of a signal"):
        Series.from_pandas(frame, columns={"gyro": "v"}, time="t")


@pytest.mark.parametrize("missing", ["Float64", "float64", object])
def test_missing_values_are_nan_and_go_by_the_rule(missing):
    values = pandas.array([1.0, None, 3.0], dtype=missing) if missing != "float64" else [1.0, np.nan, 3.0]
    frame = pandas.DataFrame({"t": TIMES, "v": values})
    series = Series.from_pandas(frame, time="t", name="c")
    assert np.isnan(series.values[1])
    with pytest.raises(DataError, match="a value is not finite"):
        simulate(through.build(), {"c": series})
    dropped = arrays(series.time, series.values, not_finite="absent")
    assert dropped.time.tolist() == [TIMES[0], TIMES[2]]


@pytest.mark.parametrize("signal", [Imu, Pose, NavigationState])
def test_a_signal_comes_back_from_its_frame(signal):
    shape = {"attitude": 4}
    parts = {f: np.random.default_rng(1).normal(size=(3, shape.get(f, 3))) for f in signal._fields}
    series = Series(TIMES, signal(**parts))
    frame = series.to_pandas()
    assert frame.index.name == "time"
    again = Series.from_pandas(frame, signal)
    assert again.time.tolist() == TIMES
    for field, values in parts.items():
        assert again[field].tolist() == values.tolist()
    first = signal._fields[0]
    assert [c for c in frame.columns if c.startswith(first)] == [f"{first}.{a}" for a in "xyz"]
    chosen = {f: [c for c in frame.columns if c.startswith(f + ".")] for f in parts}
    assert Series.from_pandas(frame, signal, columns=chosen)[first].tolist() == parts[first].tolist()


def test_a_result_is_frames():
    case = find_graph("kalman").case(load_flight("sim", settings={"duration": "0.3"}))
    result = simulate(case.graph, case.inputs)
    frames = result.to_pandas()
    assert list(frames) == list(result.series)
    for name, frame in frames.items():
        series = result[name]
        assert frame.index.tolist() == series.time.tolist()
        assert frame.shape[1] == sum(int(np.prod(a.shape[1:])) for a in series.leaves.values())
    leaf, array = next((n, a) for n, a in result["belief"].leaves.items() if a.ndim == 3)
    assert frames["belief"][f"{leaf}.1.2"].tolist() == array[:, 1, 2].tolist()


# -- masked arrays -------------------------------------------------------------------------------------

HIDDEN = np.ma.array([1.0, 999.0, 3.0], mask=[False, True, False])


@pytest.mark.parametrize(
    "values",
    [
        HIDDEN,
        HIDDEN.astype(np.float32),
        np.ma.masked_equal([1.0, 999.0, 3.0], 999.0),
        np.ma.array(HIDDEN, hard_mask=True),
        [1.0, np.ma.masked, 3.0],
    ],
)
def test_a_masked_entry_goes_as_nan_does(values):
    with pytest.raises(DataError, match="a value is not finite"):
        simulate(through.build(), {"c": (np.arange(3), values)})
    dropped = arrays(np.arange(3), values, not_finite="absent")
    assert simulate(through.build(), {"c": dropped}).output.value.tolist() == [1.0, 3.0]
    kept = arrays(np.arange(3), values, not_finite="keep")
    assert np.isnan(kept.values).tolist() == [False, True, False]


def test_masks_in_signals_lists_and_tuples():
    rows = np.ma.array(np.ones((2, 3)), mask=np.array([[0, 0, 0], [0, 1, 0]], bool))
    series = Series([0, 1], Imu(gyro=rows, specific_force=np.ma.array([[1, 2, 3]] * 2, mask=rows.mask)))
    assert np.isnan(series["gyro"]).sum() == np.isnan(series["specific_force"]).sum() == 1
    assert np.isnan(Series([0, 1], [rows[0], rows[1]]).values).sum() == 1
    assert np.isnan(Series([0, 1], (rows, rows))["1"]).sum() == 1


def test_live_events_and_iterables_have_masks_too():
    run = Run(through.build())
    run.push(0, c=np.ma.array(1.0))
    with pytest.raises(DataError, match="a value is not finite"):
        run.push(1, c=np.ma.masked)
    events = [(0, HIDDEN[0]), (1, HIDDEN[1])]
    with pytest.raises(DataError, match="a value is not finite"):
        simulate(through.build(), {"c": iter(events)})


def test_only_what_is_real_can_be_masked():
    for time, values in (
        (np.ma.array([0, 1], mask=[False, True]), np.zeros(2)),
        ([0, 1], np.ma.array([1, 2], mask=[False, True])),
        ([0, 1], np.ma.array([True, False], mask=[False, True])),
    ):
        with pytest.raises(DataError, match="a masked entry is no real number"):
            Series(time, values)
    assert Series([0, 1], np.ma.array([1, 2])).values.tolist() == [1, 2]  # a mask that hides nothing
