"""Readings that show a stuck sensor, spikes or another rate of a clock, and those that only look like it."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Series
from flowgraph.blocks.signals import Gyro, Imu, Position
from flowgraph.data.suspect import suspect_readings

RNG = np.random.default_rng(3)


def gyro(rate: float = 100.0, seconds: float = 20.0, noise: float = 0.01, jitter: float = 0.0) -> Series:
    n = round(rate * seconds)
    t = np.arange(n) / rate
    time = np.round((t + RNG.uniform(-0.5, 0.5, n) * jitter / rate) * 1e9).astype(np.int64)
    turning = np.stack([np.sin(t), np.cos(2 * t), 0.3 * t], axis=-1)
    return Series(time, Gyro(rate=turning + noise * RNG.normal(size=(n, 3))), name="gyro")


def changed(series: Series, rows: slice | np.ndarray, to: np.ndarray) -> Series:
    rate = np.array(series["rate"])
    rate[rows] = to
    return Series(series.time, Gyro(rate=rate), name=series.name, gaps=True)


@pytest.mark.parametrize("jitter", [0.0, 0.2, 0.9])
@pytest.mark.parametrize("rate", [10.0, 100.0, 400.0])
def test_nothing_is_said_of_an_honest_sensor(rate, jitter):
    assert suspect_readings(gyro(rate, 2000.0 / rate, jitter=jitter)) == ()


def test_nothing_is_said_of_few_readings():
    assert suspect_readings(gyro()[:6]) == ()
    assert suspect_readings(gyro()[:0]) == ()


@pytest.mark.parametrize("seconds", [0.3, 2.0])
def test_a_stuck_sensor(seconds):
    series = gyro()
    stuck = changed(series, slice(300, 300 + round(100 * seconds)), series["rate"][299])
    (said,) = suspect_readings(stuck)
    assert said.startswith(f"warning: gyro: the same rate for {seconds:g} s, from 2.99 s")


def test_a_gyro_that_is_stuck_beside_an_accelerometer_that_is_not():
    series, noise = gyro(), RNG.normal(size=(2000, 3))
    rate = np.array(series["rate"])
    rate[500:900] = 0.0
    imu = Series(series.time, Imu(gyro=rate, specific_force=noise), name="imu")
    (said,) = suspect_readings(imu)
    assert said.startswith("warning: imu: the same gyro for 3.99 s, from 5 s")


@pytest.mark.parametrize(("axis", "value"), [(0, None), (2, None), (1, 0.0), (1, 0.7)])
def test_one_axis_that_is_stuck_dead_or_at_its_limit(axis, value):
    series = gyro()
    rate = np.array(series["rate"])
    rate[400:600, axis] = rate[399, axis] if value is None else value
    (said,) = suspect_readings(Series(series.time, Gyro(rate=rate), name="gyro"))
    assert said.startswith(
        f"warning: gyro: the same rate[{axis}] for {2 if value is None else 1.99:g} s, from"
    )
    assert said.endswith("an axis that is stuck or at its limit")


def test_an_axis_that_rests_until_the_body_turns_about_it_is_not_stuck():
    t = np.arange(2000) / 100.0
    turned = np.stack([np.sin(t), np.where(t < 9.0, 0.0, np.cos(t)), 0.0 * t], axis=-1)
    assert suspect_readings(Series((t * 1e9).astype(np.int64), Gyro(rate=turned), name="gyro")) == ()
    counts = np.round(turned + 0.01 * RNG.normal(size=turned.shape), 1)  # as coarse as a cheap unit
    assert suspect_readings(Series((t * 1e9).astype(np.int64), Gyro(rate=counts), name="gyro")) == ()


def test_what_rests_before_it_moves_is_not_stuck():
    t = np.arange(2000) / 100.0
    moved = np.round(0.5 * np.maximum(t - 8.0, 0.0)[:, None] ** 2 * np.array([1.0, 0.5, 0.2]), 4)
    assert suspect_readings(Series((t * 1e9).astype(np.int64), Position(moved), name="mocap")) == ()


def test_a_single_number_may_repeat_and_jump():
    t = np.arange(2000) / 100.0
    for values in (np.maximum(np.sin(t), 0.0), np.sign(np.sin(t)), np.angle(np.exp(3j * t))):
        assert suspect_readings(Series((t * 1e9).astype(np.int64), values, name="x")) == ()


def test_what_is_always_repeated_is_not_stuck():
    rate = np.repeat(RNG.normal(size=(100, 3)), 10, axis=0)  # read ten times as often as it measures
    series = gyro(50.0)
    assert suspect_readings(changed(series, slice(None), rate)) == ()
    assert suspect_readings(changed(series, slice(None), np.zeros(3))) == ()


def test_a_reading_that_comes_twice_is_not_stuck():
    series = gyro()
    rows = np.repeat(np.arange(len(series)), 1 + (np.arange(len(series)) % 20 == 3))
    again = Series(series.time[rows], Gyro(rate=series["rate"][rows]), name="gyro")
    assert suspect_readings(again) == ()


@pytest.mark.parametrize("count", [1, 5])
def test_spikes(count):
    series = gyro()
    rows = 700 + 20 * np.arange(count)
    (said,) = suspect_readings(changed(series, rows, series["rate"][rows] + 3.0))
    assert said.startswith(
        f"warning: gyro: readings of rate stand alone, {count} of them, from 7 s after the first on"
    )


def test_a_jump_and_a_jolt_are_no_spikes():
    series, t = gyro(), np.arange(2000) / 100.0
    jump = np.where(t > 5.0, 10.0, 0.0)[:, None]
    assert suspect_readings(changed(series, slice(None), series["rate"] + jump)) == ()
    jolt = 10.0 * np.exp(-np.maximum(t - 5.0, 0.0) / 0.1) * np.sin(60.0 * (t - 5.0)) * (t > 5.0)
    assert suspect_readings(changed(series, slice(None), series["rate"] + jolt[:, None])) == ()


def test_absent_readings_are_no_spikes():
    series = gyro()
    assert suspect_readings(changed(series, slice(500, 600), np.full(3, np.nan))) == ()


def test_a_smooth_signal_without_noise_has_no_spikes():
    t = np.arange(2000) / 100.0
    moved = np.clip(t - 5.0, 0.0, 1.0)
    place = (moved**3 * (10 - 15 * moved + 6 * moved**2))[:, None] * np.ones(3)
    series = Series((t * 1e9).astype(np.int64), Position(place), name="position")
    assert not any("stand alone" in said for said in suspect_readings(series))


@pytest.mark.parametrize(("rate", "jitter"), [(4.0, 0.0), (100.0, 0.0), (100.0, 0.1), (400.0, 0.3)])
def test_a_clock_that_begins_to_run_fast(rate, jitter):
    series = gyro(rate, max(20.0, 160 / rate), jitter=jitter)
    t = series.time * 1e-9
    begins = 0.3 * t[-1]
    time = series.time + np.round(np.maximum(t - begins, 0.0) * 0.01 * 1e9).astype(np.int64)
    (said,) = suspect_readings(Series(time, Gyro(rate=series["rate"]), name="gyro"))
    assert said.startswith("warning: gyro: comes at ")
    assert "a clock or a rate that changed" in said


@pytest.mark.parametrize("factor", [1.5, 2.0, 10.0])
@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_a_rate_that_leaps(factor, jitter):
    steps = np.where(np.arange(1999) < 1200, 10.0, 10.0 * factor)
    steps *= 1.0 + jitter * RNG.uniform(-0.5, 0.5, 1999)
    time = np.round(np.concatenate([[0.0], np.cumsum(steps)]) * 1e6).astype(np.int64)
    (said,) = suspect_readings(Series(time, Gyro(rate=RNG.normal(size=(2000, 3))), name="gyro"))
    assert float(said.split(" Hz")[0].split()[-1]) == pytest.approx(100.0 / factor, rel=0.02)
    assert "Hz from about 12 s" in said


def test_what_comes_now_and_then_has_no_rate():
    time = np.cumsum(RNG.exponential(0.1, 2000) * 1e9).astype(np.int64)
    assert suspect_readings(Series(time, Gyro(rate=RNG.normal(size=(2000, 3))), name="gyro")) == ()


def test_a_pause_is_no_other_rate():
    series = gyro()
    kept = series[(series.time < 3 * 10**9) | (series.time > 9 * 10**9)]
    assert suspect_readings(kept) == ()
