"""What grows with a live run: columns, and counts of durations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flowgraph.blocks.signals import Imu
from flowgraph.data.columns import Columns
from flowgraph.data.percentiles import Durations
from flowgraph.types import ArrayType, struct_type


@pytest.mark.parametrize("count", [0, 1, 64, 65, 300])
def test_columns_hold_what_was_put_in(count):
    columns, rng = Columns(struct_type(Imu), "imu"), np.random.default_rng(count)
    rows = [(rng.normal(size=3), rng.normal(size=3)) for _ in range(count)]
    for k, row in enumerate(rows):
        columns.add(10 * k, row)
    series = columns.series()
    assert series.time.tolist() == [10 * k for k in range(count)]
    np.testing.assert_array_equal(
        series["gyro"].reshape(count, 3), np.array([g for g, _ in rows]).reshape(count, 3)
    )
    columns.add(10 * count, (np.ones(3), np.ones(3)))
    assert len(series) == count
    scalars = Columns(ArrayType((), "int64"), "n")
    scalars.add(0, (3,))
    assert scalars.series()["value"].tolist() == [3]


def test_percentiles_of_durations_are_right_to_three_per_cent():
    rng = np.random.default_rng(1)
    for scale in (1e3, 1e6, 1e9):
        times, kept = (rng.lognormal(0.0, 1.0, 4000) * scale).astype(int), Durations()
        for ns in times.tolist():
            kept.add(ns)
        for share in (1.0, 50.0, 99.0, 99.9, 100.0):
            right = np.percentile(times, share, method="inverted_cdf") * 1e-9
            assert right * 0.999 <= kept.percentile(share) <= right * 1.03
        assert kept.longest == times.max()
        assert (kept.count, kept.total) == (4000, times.sum())


def test_there_is_no_percentile_of_nothing_and_the_longest_ends_the_scale():
    kept = Durations()
    assert math.isnan(kept.percentile(50.0))
    kept.add(0)
    assert kept.percentile(50.0) == 1e-9
    kept.add(10**15)
    assert kept.percentile(100.0) <= 1e6
