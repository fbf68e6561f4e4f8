"""The random words and normal numbers of `random`, in NumPy with few passes, or in Python for a few.

The same integers, step by step. A product of 32 bits by 32 is written once as 64, and its halves are read as
views; each round then is one product and two exclusive ors, with the next key mixed into the low half. The
segment of a normal number is looked up by the bits that name it, and its sign is put on while it is whole.
A few words are made with Python's integers, since each pass over a short array costs as much as all of its
arithmetic.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from typing import Any

import numpy as np

MULTIPLIERS, WEYL = (0xD2511F53, 0xCD9E8D57), (0x9E3779B9, 0xBB67AE85)
"""Of Philox4x32: by what words are multiplied, and what a key grows by, in each round."""

COLUMN = np.array([[m] for m in MULTIPLIERS], dtype=np.uint64)
"""The multipliers (2, 1)."""

_WORD = 0xFFFFFFFF
FEW = 16
"""Words up to which Python's integers are quicker."""

_LOW, _HIGH = (0, 1) if sys.byteorder == "little" else (1, 0)


def words(count: int, name: int, time: int, seed: np.ndarray, rounds: int, *, first: int = 0) -> np.ndarray:
    """`count` random words (uint32) of Philox4x32, of the counters from `first` on; see `random.words`."""
    if count <= FEW and not first:
        return np.array(few_words(count, name, int(time), seed, rounds), np.uint32)
    time, n = int(time), -(-count // 4)
    even = np.empty((2, n), np.uint32)
    even[0], even[1] = np.arange(first, first + n, dtype=np.uint32), time & _WORD
    return _mixed(even, np.array([[name], [(time >> 32) & _WORD]], np.uint32), seed, rounds)[:count]


def words_at(count: int, name: int, times: np.ndarray, seed: np.ndarray, rounds: int) -> np.ndarray:
    """The words (count, n) of n times (int64)."""
    blocks, n = -(-count // 4), len(times)
    even, odd = np.empty((2, blocks, n), np.uint32), np.empty((2, blocks, n), np.uint32)
    even[0], even[1] = np.arange(blocks, dtype=np.uint32)[:, None], times & _WORD
    odd[0], odd[1] = name, (times >> 32) & _WORD
    made = _mixed(even.reshape(2, -1), odd.reshape(2, -1), seed, rounds)
    return made.reshape(4 * blocks, n)[:count]


def _mixed(even: np.ndarray, odd: np.ndarray, seed: np.ndarray, rounds: int) -> np.ndarray:
    """The words (4 n) of n counters: even (2, n) is written over, odd (2, n), or (2, 1) for all."""
    n, keys = even.shape[1], _key_columns(*seed.tolist(), rounds)
    products, mixed, odd = np.empty((2, n), np.uint64), np.empty((2, n), np.uint32), odd ^ keys[0]
    halves = products.view(np.uint32).reshape(2, n, 2)[::-1]
    high, low = halves[:, :, _HIGH], halves[:, :, _LOW]
    for key in keys[1:]:
        np.multiply(even, COLUMN, out=products)
        np.bitwise_xor(high, odd, out=even)
        odd = np.bitwise_xor(low, key, out=mixed)
    np.multiply(even, COLUMN, out=products)
    np.bitwise_xor(high, odd, out=even)
    return np.concatenate([even, low]).reshape(4 * n)


def few_words(count: int, name: int, time: int, seed: np.ndarray, rounds: int) -> list[int]:
    """The same as Python's integers."""
    low, high, keys = time & _WORD, (time >> 32) & _WORD, _keys(*seed.tolist(), rounds)
    if count <= 4:
        return list(_one(0, name, low, high, keys)[:count])
    made = [_one(k, name, low, high, keys) for k in range(-(-count // 4))]
    return [w for part in zip(*made, strict=True) for w in part][:count]


@lru_cache
def _keys(k: int, q: int, rounds: int) -> list[tuple[int, int]]:
    """The keys of each round."""
    return [((k + WEYL[0] * r) & _WORD, (q + WEYL[1] * r) & _WORD) for r in range(rounds)]


@lru_cache
def _key_columns(k: int, q: int, rounds: int) -> np.ndarray:
    """The keys of each round (rounds, 2, 1)."""
    return np.array(_keys(k, q, rounds), np.uint32)[:, :, None]


def _one(
    index: int, name: int, low: int, high: int, keys: list[tuple[int, int]]
) -> tuple[int, int, int, int]:
    """The four words of one counter, those of even numbers first."""
    a, b, c, d = index, name, low, high
    for k, q in keys:
        left, right = a * MULTIPLIERS[0], c * MULTIPLIERS[1]
        a, b, c, d = (right >> 32) ^ b ^ k, right & _WORD, (left >> 32) ^ d ^ q, left & _WORD
    return a, c, b, d


def by_form(values: np.ndarray, base: int) -> np.ndarray:
    """A table of segments (n) int32, from `base` on: looked up by the leading bits of a float32."""
    return np.concatenate([np.zeros(base, np.int32), values])


def normals(
    bits: np.ndarray,
    tables: tuple[np.ndarray, np.ndarray],
    segment_bits: int,
    place_bits: int,
    scale: float,
) -> Any:
    """Standard normal numbers from words; see `random.normal_from`. `tables`: start and fall, `by_form`."""
    sign = (bits & np.uint32(1)).view(np.int32)
    np.negative(sign, out=sign)
    tail = bits >> np.uint32(1)
    tail |= np.uint32(1)
    place = tail.view(np.int32).astype(np.float32).view(np.int32)
    segment = (place >> np.int32(23 - segment_bits)).astype(np.intp)
    place >>= np.int32(23 - segment_bits - place_bits)
    place &= np.int32((1 << place_bits) - 1)
    place *= tables[1].take(segment, None, None, "clip")
    place += np.int32(1 << (place_bits - 1))
    place >>= np.int32(place_bits)
    size = tables[0].take(segment, None, None, "clip")
    size -= place
    size ^= sign  # of two's complement: -n is ~n + 1
    size -= sign
    found = size.astype(np.float64)
    found *= scale
    return found
