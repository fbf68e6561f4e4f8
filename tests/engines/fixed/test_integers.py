"""The functions of integers, against floating point: within the last place asked for, or a few."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph.engines.fixed import integers as z

WIDTH = 32
RNG = np.random.default_rng(0)


def words(x):
    """The nearest words of full width, their fractions, and the reals that they stand for."""
    f = (WIDTH - 1 - np.frexp(x)[1]).astype(np.int64)
    raw = np.clip(np.rint(np.ldexp(x, f)).astype(np.int64), -(2**31) + 1, 2**31 - 1)
    return raw, f, np.ldexp(raw.astype(float), -f)


def some(signs=True):
    x = 10 ** RNG.uniform(-6, 1, 4000)
    return words(x * RNG.choice([-1.0, 1.0], 4000) if signs else x)


def finest(want):
    return 30 - np.frexp(want)[1].astype(np.int64)


def error(got, out, want):
    """The largest error, in units of the last place that was asked for."""
    return np.max(np.abs(np.ldexp(got.astype(float), -out) - want) * np.ldexp(1.0, out))


@pytest.mark.parametrize("seed", range(2))
def test_products_quotients_and_roots_are_rounded_to_the_last_place(seed):
    (a, f, x), (b, g, y) = some(), some()
    out = finest(x * y)
    assert error(z.product(a, b, f + g - out), out, x * y) <= 0.5
    out = finest(x / y)
    assert error(z.quotient(a, b, out - f + g), out, x / y) <= 1.0
    out = finest(np.sqrt(np.abs(x)))
    assert error(z.square_root(np.abs(a), f, out), out, np.sqrt(np.abs(x))) <= 1.0


FUNCTIONS: dict[str, tuple[Any, Any, float]] = {
    "sine": (lambda a, f, out: z.sine(a, f, out), np.sin, 4.0),
    "cosine": (lambda a, f, out: z.sine(a, f, out, ahead=1), np.cos, 4.0),
    "sinc": (z.sinc, lambda x: np.sin(x) / x, 6.0),
    "angle": (lambda a, f, out: z.angle(a, a[::-1], f, f[::-1], out), lambda x: np.arctan2(x, x[::-1]), 1.0),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_at_28_bits_behind_the_point(name):
    run, true, most = FUNCTIONS[name]
    a, f, x = some()
    out = np.full_like(f, 28)
    assert error(run(a, f, out), out, true(x)) <= most


def test_small_angles_keep_their_own_precision():
    a, f, x = words(10 ** RNG.uniform(-9, -2, 1000))
    out = finest(np.sin(x))
    assert error(z.sine(a, f, out), out, np.sin(x)) <= 4.0


def test_a_ratio_of_a_sine_to_its_angle_is_one_at_zero_and_falls_from_there():
    x = np.array([0.0, 2e-9, 1e-3, -0.5, 0.7, 0.79, -1.5, 3.1])
    raw, f, x = np.ldexp(x, 29).astype(np.int64), np.int64(29), np.ldexp(np.floor(np.ldexp(x, 29)), -29)
    want = np.where(x == 0.0, 1.0, np.sin(x) / np.where(x == 0.0, 1.0, x))
    out = np.int64(30)
    assert z.sinc(raw, f, out)[0] == 1 << 30
    assert error(z.sinc(raw, f, out), out, want) <= 8.0


def test_exponentials_logarithms_and_lengths():
    a, f, x = some()
    out = finest(np.exp(x))
    assert error(z.exponential(a, f, out), out, np.exp(x)) <= 16.0  # exp(10) is 14 powers of two
    b, g, y = some(signs=False)
    out = np.full_like(g, 26)
    assert error(z.logarithm(b, g, out), out, np.log(y)) <= 1.0
    out = finest(np.hypot(x, y))
    assert error(z.length(a, b, f, g, out), out, np.hypot(x, y)) <= 2.0


def test_shifts_round_half_up_and_stop_at_the_limit():
    x = np.array([5, 6, 7, -5, -6, -7])
    assert z.shift(x, np.int64(2)).tolist() == [1, 2, 2, -1, -1, -2]
    assert z.shift(np.array([3, -3]), np.int64(-62)).tolist() == [z.LIMIT, z.LEAST]
    assert z.shift(np.array([1 << 40]), np.int64(63)).tolist() == [0]


def test_what_has_no_value():
    zero, one = np.array([0]), np.array([1])
    assert z.quotient(one, zero, 0).tolist() == [-z.LEAST]
    assert z.quotient(zero, zero, 0).tolist() == [0]
    assert z.quotient(-one, zero, 0).tolist() == [z.LEAST]
    assert z.square_root(-one, 0, 0).tolist() == [0]
    assert z.logarithm(zero, 0, 0).tolist() == [z.LEAST]
    assert z.angle(zero, zero, zero, zero, zero).tolist() == [0]
