"""Whole-number arithmetic of fixed point: shifts, quotients, roots and functions, in 64 bits.

Every function here uses sums, products, quotients, shifts and comparisons of signed 64-bit integers alone, so
that C and hardware can do the same to the bit. Words (of at most 32 bits) come in; what goes out has the
fraction that is asked for and is not yet fitted to a word. `shift` rounds to the nearest, half upwards.

Sines come from polynomials in the square of the reduced angle, exponentials and logarithms base 2 from a
polynomial and from repeated squaring, angles from CORDIC (J. Volder, 1959).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

LIMIT = 1 << 62
LEAST = 1 - LIMIT
"""The least that arithmetic makes: -2^62 itself is the word of a reading that is not there."""
_ONE = np.int64(1)

Ints = Any  # an int64 array, or a NumPy int64


def shift(x: Ints, by: Ints) -> Ints:
    """x 2^-by: to the right rounded half up, to the left from 1 - 2^62 to 2^62."""
    by = np.asarray(by, dtype=np.int64)
    right = np.clip(by, 0, 62)
    down = np.where(by > 62, 0, (x + ((_ONE << right) >> 1)) >> right)
    if not (by < 0).any():
        return down
    left = np.clip(-by, 0, 62)
    most = np.int64(LIMIT) >> left
    return np.where(by >= 0, down, np.maximum(np.clip(x, -most, most) << left, LEAST))


def bit_length(x: Ints) -> Ints:
    """Of words that are not negative: 0 for 0, else floor(log2 x) + 1. Exact below 2^53."""
    return np.frexp(np.asarray(x, dtype=np.float64))[1].astype(np.int64)


def product(a: Ints, b: Ints, by: Ints) -> Ints:
    """a b 2^-by of two words."""
    return shift(a * b, by)


def quotient(a: Ints, b: Ints, up: Ints) -> Ints:
    """(a / b) 2^up of two words; a quotient by zero is +-(2^62 - 1), of zero by zero zero."""
    over, under = np.abs(a), np.abs(b)
    lift_a, lift_b = 62 - bit_length(over), 31 - bit_length(under)
    safe = np.where(under == 0, _ONE, under << np.maximum(lift_b, 0))
    q = shift((over << np.where(over == 0, 0, lift_a)) // safe, lift_a - lift_b - up)
    q = np.where(under == 0, np.where(over == 0, 0, -LEAST), np.where(over == 0, 0, np.minimum(q, -LEAST)))
    return np.where((a < 0) ^ (b < 0), -q, q)


def root_of(x: Ints) -> Ints:
    """The whole part of the square root of numbers from 0 to 2^62."""
    r = np.sqrt(np.asarray(x, dtype=np.float64)).astype(np.int64)
    for _ in range(2):
        r = r - (r * r > x)
    for _ in range(2):
        r = r + ((r + 1) * (r + 1) <= x)
    return r


def square_root(x: Ints, fraction: Ints, out: Ints) -> Ints:
    """sqrt of words; of what is negative, zero."""
    size = np.maximum(x, 1)
    lift = 62 - bit_length(size)
    lift = lift - ((fraction + lift) & 1)
    return np.where(x <= 0, 0, shift(root_of(size << lift), ((fraction + lift) >> 1) - out))


QUARTER_TURNS = np.int64(round(2.0 / math.pi * 2**31))
SINC = [round((-1) ** k * (math.pi / 2) ** (2 * k) / math.factorial(2 * k + 1) * 2**30) for k in range(6)]
COSINE = [round((-1) ** k * (math.pi / 2) ** (2 * k) / math.factorial(2 * k) * 2**30) for k in range(7)]
QUARTER = np.int64(round(math.pi / 2 * 2**30))


def _horner(coefficients: list[int], u: Ints) -> Ints:
    total = np.int64(coefficients[-1]) + u * 0
    for c in reversed(coefficients[:-1]):
        total = ((total * u + (1 << 29)) >> 30) + c
    return total


def sine(x: Ints, fraction: Ints, out: Ints, *, ahead: int = 0) -> Ints:
    """sin(x), or with `ahead` = 1 cos(x), of words in radians; small angles to their own precision."""
    turns = shift(x * QUARTER_TURNS, fraction + 1)  # quarter turns, 30 bits behind the point
    n = (turns + (1 << 29)) >> 30
    r = turns - (n << 30)
    u = (r * r + (1 << 29)) >> 30
    sinc, cosine = _horner(SINC, u), _horner(COSINE, u)
    small = shift(x * sinc, fraction + 30 - out)
    sin = shift(((r * QUARTER + (1 << 29)) >> 30) * sinc, 60 - out)
    cos = shift(cosine, 30 - out)
    n = n + ahead
    value = np.where(n & 1, cos, np.where((n == 0) & (ahead == 0), small, sin))
    return np.where(n & 2, -value, value)


def sinc(x: Ints, fraction: Ints, out: Ints) -> Ints:
    """sin(x) / x, or 1 at 0, of words in radians."""
    turns = shift(x * QUARTER_TURNS, fraction + 1)
    r = turns - (((turns + (1 << 29)) >> 30) << 30)
    near = shift(_horner(SINC, (r * r + (1 << 29)) >> 30), 30 - out)
    return np.where(r == turns, near, quotient(sine(x, fraction, np.int64(30)), x, out + fraction - 30))


LOG2_E = np.int64(round(math.log2(math.e) * 2**30))
LN_2 = np.int64(round(math.log(2.0) * 2**30))
POWER = [round(math.log(2.0) ** k / math.factorial(k) * 2**30) for k in range(9)]


def exponential(x: Ints, fraction: Ints, out: Ints) -> Ints:
    """exp(x) of words."""
    y = shift(x * LOG2_E, fraction)
    n = (y + (1 << 29)) >> 30
    m = _horner(POWER, y - (n << 30))
    return shift(m, 30 - n - out)


def logarithm(x: Ints, fraction: Ints, out: Ints) -> Ints:
    """ln(x) of words; of zero and less, 1 - 2^62."""
    size = np.maximum(x, 1)
    length = bit_length(size)
    m = shift(size, length - 31)  # 1 <= m < 2, 30 bits behind the point
    y = np.zeros_like(m)
    for k in range(1, 31):
        m = (m * m) >> 30
        big = m >= (1 << 31)
        y = y + np.where(big, _ONE << (30 - k), 0)
        m = m >> big
    value = (length - 1 - fraction) * LN_2 + ((y * LN_2 + (1 << 29)) >> 30)
    return np.where(x <= 0, LEAST, shift(value, 30 - out))


_STEPS = 40
ANGLES = [round(math.atan(2.0**-k) * 2**60) for k in range(_STEPS)]
HALF_TURN = np.int64(round(math.pi * 2**60))


def angle(y: Ints, x: Ints, fraction_y: Ints, fraction_x: Ints, out: Ints) -> Ints:
    """atan2(y, x) of words, from -pi to pi; 0 for two zeros."""
    top = np.maximum(bit_length(np.abs(y)) - fraction_y, bit_length(np.abs(x)) - fraction_x)
    up, along = shift(y, fraction_y - (59 - top)), shift(x, fraction_x - (59 - top))
    behind = along < 0
    below = up < 0
    turned = np.where(behind, np.where(below, -HALF_TURN, HALF_TURN), 0)
    along, up = np.where(behind, -along, along), np.where(behind, -up, up)
    for k in range(_STEPS):
        high = up > 0
        step_x, step_y = up >> k, along >> k
        along, up = along + np.where(high, step_x, -step_x), up - np.where(high, step_y, -step_y)
        turned = turned + np.where(high, ANGLES[k], -ANGLES[k])
    value = shift(turned, 60 - out)
    # CORDIC always turns; on the axis itself the angle is known
    value = np.where(y == 0, shift(np.where(x < 0, HALF_TURN, 0), 60 - out), value)
    return value


def length(a: Ints, b: Ints, fraction_a: Ints, fraction_b: Ints, out: Ints) -> Ints:
    """sqrt(a^2 + b^2) of words."""
    top = np.maximum(bit_length(np.abs(a)) - fraction_a, bit_length(np.abs(b)) - fraction_b)
    p, q = shift(a, fraction_a - (30 - top)), shift(b, fraction_b - (30 - top))
    return shift(root_of(p * p + q * q), (30 - top) - out)
