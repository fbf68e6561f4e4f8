"""Recorded signals: integer times, fields by name, parts, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Array, DataError, Flight, Series, Signal, UnknownNameError, real


class Point(Signal):
    place: Array = real(3, unit="m")
    weight: Array = real(unit="kg")


class Pair(Signal):
    left: Point
    right: Point


def a_series(n: int = 4) -> Series:
    return Series(np.arange(n) * 10, Point(np.arange(3.0 * n).reshape(n, 3), np.arange(n)), name="points")


def test_a_lone_array_is_called_value():
    series = Series([0, 5], np.array([1.0, 2.0]))
    assert list(series.leaves) == ["value"]
    np.testing.assert_array_equal(series.value, [1.0, 2.0])


def test_fields_by_attribute_item_and_dotted_name():
    points = a_series()
    np.testing.assert_array_equal(points.weight, points["weight"])
    both = Series(points.time, Pair(points.values, points.values))
    np.testing.assert_array_equal(both["right.place"], points.place)
    assert list(both.leaves) == ["left.place", "left.weight", "right.place", "right.weight"]


def test_integers_become_reals_where_reals_are_declared():
    assert a_series().weight.dtype == np.float64


def test_types_keep_units_and_lose_the_time_axis():
    kinds = dict(a_series().type.fields)  # type: ignore[union-attr]
    assert kinds["place"] == real(3, unit="m")


def test_one_value_a_slice_and_a_mask():
    points = a_series()
    assert isinstance(points[1], Point)
    assert points[1].weight == 1.0
    assert points[1:3].time.tolist() == [10, 20]
    assert points[points.weight > 1].time.tolist() == [20, 30]
    assert points[1:3].name == "points"


def test_iteration_gives_single_values():
    assert [p.weight for p in a_series(3)] == [0.0, 1.0, 2.0]
    nested = Series(a_series(2).time, Pair(a_series(2).values, a_series(2).values))
    assert [p.right.weight for p in nested] == [0.0, 1.0]
    assert list(Series([0, 1], np.array([3.0, 4.0]))) == [3.0, 4.0]


def test_from_seconds_rounds_each_once():
    assert Series.from_seconds([0.1, 0.3, 1e-9], np.zeros(3)).time.tolist() == [100_000_000, 300_000_000, 1]


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e10])
def test_from_seconds_refuses_what_int64_cannot_hold(bad):
    with pytest.raises(DataError, match=r"imu: a time is not finite, or beyond"):
        Series.from_seconds([0.0, bad], np.zeros(2), name="imu")


def test_float_times_are_refused():
    with pytest.raises(DataError, match="imu: times must be integer nanoseconds") as error:
        Series([0.0, 0.5], np.zeros(2), name="imu")
    assert "float64" in str(error.value.got)
    assert "from_seconds" in str(error.value.fix)


def test_lengths_that_differ_are_refused_by_field():
    with pytest.raises(
        DataError, match=r"points: field 'weight' does not have one value a time stamp"
    ) as error:
        Series([0, 1], Point(np.zeros((2, 3)), np.zeros(3)), name="points")
    assert error.value.expected == "shape (2,)"
    assert error.value.got == "shape (3,)"


def test_an_unknown_field_lists_the_fields():
    with pytest.raises(UnknownNameError, match="no field is called 'wieght'") as error:
        a_series()["wieght"]
    assert error.value.valid == ["place", "weight"]
    assert "did you mean 'weight'" in str(error.value)
    with pytest.raises(AttributeError, match="wieght"):
        _ = a_series().wieght


def test_seconds_start_at_zero_and_an_empty_series_is_fine():
    assert a_series().seconds.tolist() == pytest.approx([0, 1e-8, 2e-8, 3e-8])
    empty = a_series()[:0]
    assert len(empty) == 0
    assert empty.seconds.shape == (0,)
    assert "empty" in repr(empty)


def test_a_flight_is_only_its_parts():
    flight = Flight("x", {"points": a_series()})
    assert flight.truth is None
    assert flight.info == {}


@pytest.mark.parametrize(
    ("parts", "place"),
    [
        ({"streams": {"imu": [1, 2]}}, "x: imu"),
        ({"streams": None}, "x: streams"),
        ({"streams": {}, "truth": np.zeros(3)}, "x: truth"),
        ({"streams": {"truth": None}}, "x: truth"),
    ],
)
def test_what_is_no_series_is_refused_where_it_stands(parts, place):
    with pytest.raises(DataError, match="a flight is made of series") as error:
        Flight("x", **parts)
    assert error.value.path == place


def test_what_a_graph_needs_of_a_flight():
    flight = Flight("walk", {"imu": a_series(), "vicon": a_series(0)})
    assert list(flight.need("ekf", "imu")) == ["imu"]
    with pytest.raises(DataError, match="lacks what ekf needs") as missing:
        flight.need("ekf", "imu", "gps")
    assert "imu, gps" in str(missing.value)
    with pytest.raises(DataError, match="'vicon' is empty"):
        flight.need("ekf", "imu", "vicon")


@pytest.mark.parametrize("time", [[], (), np.zeros(0), np.zeros(0, np.int32)])
def test_no_times_are_whole_nanoseconds_of_any_kind(time):
    none = Series(time, np.zeros((0, 3)))
    assert len(none) == 0
    assert none.time.dtype == np.int64
