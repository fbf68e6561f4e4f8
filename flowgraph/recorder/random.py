"""Counter-based random numbers: each draw is a function of (seed, name of the stream, time, index) alone.

Nothing is stored between draws, so they are the same in every engine, for any number of workers, and do not
move when a node is added or a graph is nested. The generator is Philox4x32 with 7 rounds, the fewest that
pass BigCrush (J. Salmon, M. Moraes, R. Dror, D. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011,
table 2). Counter words: index, hash of the name, low and high word of the time; key: the seed.

Normal draws invert the distribution with integers only, after D. Lee, R. Cheung, W. Luk and J. Villasenor,
"Hardware implementation trade-offs of polynomial approximations and interpolations", IEEE Trans. Computers
2008: the octave of the tail probability and its leading bits choose a line segment from a table. Integer
arithmetic is what makes them equal to the last bit whatever a compiler does to floating point.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from statistics import NormalDist
from typing import Any, Protocol

import numpy as np

from flowgraph.errors import DeclarationError
from flowgraph.recorder import numpy_random
from flowgraph.recorder.namespaces import NUMPY

ROUNDS = 7
_WEYL = np.array([[w] for w in numpy_random.WEYL], dtype=np.uint32)
_WORD = 0xFFFFFFFF

_SEGMENT_BITS = 6  # segments an octave: 64
_PLACE_BITS = 14  # bits of the position within a segment
_FRACTION_BITS = 22  # a draw is an integer times 2^-22
_AT_ONCE = 1 << 15  # numbers that NumPy makes together: what is between them and their words stays in a cache
_BASE = 127 << _SEGMENT_BITS  # of the float32 exponent


class Draw(Protocol):
    """What a block's step is handed as `draw`: random numbers for this tick, by name."""

    def normal(self, name: str, shape: tuple[int, ...]) -> Any:
        """Independent standard normal numbers."""

    def uniform(self, name: str, shape: tuple[int, ...]) -> Any:
        """Independent uniform numbers in [0, 1)."""


def philox(even: Any, odd: Any, key: Any, *, rounds: int = ROUNDS, xp: Any) -> tuple[Any, Any]:
    """Philox4x32 on many counters at once.

    Args:
        even: (2, n) uint32, counter words 0 and 2.
        odd: (2, n) uint32, counter words 1 and 3; (2, 1) where all counters share them.
        key: (2, 1) uint32.

    Returns:
        Words 0 and 2, and words 1 and 3, of the result, (2, n) each.
    """
    for r in range(rounds):
        product = xp.astype(even, xp.uint64) * numpy_random.COLUMN
        high = xp.astype(product >> np.uint64(32), xp.uint32)
        even = high[::-1] ^ odd ^ (key + _WEYL * np.uint32(r))
        odd = xp.astype(product, xp.uint32)[::-1]
    return even, odd


def words(count: int, name: int, time: Any, seed: Any, *, xp: Any) -> Any:
    """`count` random words.

    Args:
        name: 32-bit hash of the stream's name.
        time: int64 ns, or a Python int.
        seed: (2,) uint32.
    """
    n = -(-count // 4)
    low = xp.asarray(time & _WORD, dtype=xp.uint32)
    high = xp.asarray((time >> 32) & _WORD, dtype=xp.uint32)
    index = np.arange(n, dtype=np.uint32)
    even = xp.stack([index, xp.broadcast_to(low, (n,))])
    odd = xp.reshape(xp.stack([np.asarray(name, np.uint32), high]), (2, 1))
    first, second = philox(even, odd, xp.reshape(seed, (2, 1)), xp=xp)
    return xp.reshape(xp.concat([first, second]), (4 * n,))[:count]


def uniform_from(bits: Any, *, xp: Any) -> Any:
    """Uniform reals in [0, 1): multiples of 2^-24, exact in float32 too."""
    return xp.astype(bits >> np.uint32(8), xp.float64) * 2.0**-24


def normal_from(bits: Any, *, xp: Any) -> Any:
    """Standard normal reals, multiples of 2^-22, one from each word: the inverse distribution by table.

    The lowest bit is the sign, the others the tail probability. Its float32 form is octave and leading bits,
    which is the segment's number. The error of the inverse is below 3e-5; the largest draw is 6.2.
    """
    start, slope = segments()
    tail = xp.astype((bits >> np.uint32(1)) | np.uint32(1), xp.int32)
    form = xp.float32_bits(tail)
    segment = (form >> np.int32(23 - _SEGMENT_BITS)) - np.int32(_BASE)
    rest = 23 - _SEGMENT_BITS - _PLACE_BITS
    place = (form & np.int32((1 << (23 - _SEGMENT_BITS)) - 1)) >> np.int32(rest)
    fall = (xp.take(slope, segment, axis=0) * place + np.int32(1 << (_PLACE_BITS - 1))) >> np.int32(
        _PLACE_BITS
    )
    size = xp.take(start, segment, axis=0) - fall
    sign = np.int32(1) - np.int32(2) * xp.astype(bits & np.uint32(1), xp.int32)
    return xp.astype(size * sign, xp.float64) * 2.0**-_FRACTION_BITS


@lru_cache(maxsize=1)
def segments() -> tuple[np.ndarray, np.ndarray]:
    """Start and fall of each segment of the upper quantile function, in units of 2^-22 (int32)."""
    places = np.concatenate([2.0**k * (1 + np.arange(64) / 64) for k in range(31)] + [[2.0**31]])
    inverse = NormalDist().inv_cdf
    values = np.array([-inverse(p * 2.0**-32) for p in places])
    nodes = np.rint(values * 2**_FRACTION_BITS).astype(np.int32)
    return nodes, np.append(nodes[:-1] - nodes[1:], 0).astype(np.int32)


@dataclass(frozen=True)
class Site:
    """One place in a graph where random numbers are drawn: a full name, "normal" or "uniform", a shape."""

    name: str
    kind: str
    shape: tuple[int, ...]

    @cached_property
    def hash(self) -> int:
        """The 32-bit number that stands for the name in the counter."""
        return int.from_bytes(hashlib.blake2b(self.name.encode(), digest_size=4).digest(), "little")

    def numbers(self, time: Any, seed: Any, *, xp: Any) -> Any:
        """The draws of this site at a time."""
        if xp is NUMPY:
            return _in_numpy(self.kind, self.shape, self.hash, time, seed)
        bits = words(math.prod(self.shape), self.hash, time, seed, xp=xp)
        made = {"normal": normal_from, "uniform": uniform_from}[self.kind](bits, xp=xp)
        return xp.reshape(made, self.shape)

    def at(self, times: np.ndarray, seed: np.ndarray) -> Any:
        """The draws (*shape, n) at n times (int64 ns)."""
        return numbers_at(self.kind, self.shape, self.hash, times, seed)


def _in_numpy(kind: str, shape: tuple[int, ...], name: int, time: Any, seed: np.ndarray) -> Any:
    """The same numbers as in any namespace, with fewer passes over them."""
    count = math.prod(shape)
    if kind == "uniform" and count <= numpy_random.FEW:
        few = [(w >> 8) * 2.0**-24 for w in numpy_random.few_words(count, name, int(time), seed, ROUNDS)]
        return np.array(few).reshape(shape) if shape else np.float64(few[0])
    if count <= _AT_ONCE:
        return _made(kind, numpy_random.words(count, name, time, seed, ROUNDS)).reshape(shape)
    counters, step = -(-count // 4), _AT_ONCE // 4
    found = np.empty((4, counters))
    for first in range(0, counters, step):
        some = min(step, counters - first)
        bits = numpy_random.words(4 * some, name, time, seed, ROUNDS, first=first)
        found[:, first : first + some] = _made(kind, bits).reshape(4, some)
    return found.reshape(4 * counters)[:count].reshape(shape)


def _made(kind: str, bits: np.ndarray) -> Any:
    """Numbers of words."""
    return uniform_from(bits, xp=NUMPY) if kind == "uniform" else _normals(bits)


def numbers_at(kind: str, shape: tuple[int, ...], name: int, times: np.ndarray, seed: np.ndarray) -> Any:
    """The draws (*shape, n) of a site at n times (int64 ns): those of `Site.numbers` at each.

    Args:
        kind: "normal" or "uniform".
        name: the hash of the site.
    """
    bits = numpy_random.words_at(math.prod(shape), name, times, seed, ROUNDS)
    return _made(kind, bits.ravel()).reshape(*shape, len(times))


def _normals(bits: np.ndarray) -> Any:
    return numpy_random.normals(bits, _tables(), _SEGMENT_BITS, _PLACE_BITS, 2.0**-_FRACTION_BITS)


@lru_cache(maxsize=1)
def _tables() -> tuple[np.ndarray, np.ndarray]:
    start, fall = segments()
    return numpy_random.by_form(start, _BASE), numpy_random.by_form(fall, _BASE)


def site(prefix: str, kind: str, name: str, shape: Any) -> Site:
    """The site `prefix/name`; refuses a shape that is not fixed."""
    if not isinstance(name, str) or not name or "/" in name or "/" in prefix:
        raise DeclarationError(
            "a random stream cannot be called this",
            path=f"{prefix}/{name}",
            expected="names without /, which joins them",
            got=f"{prefix!r}, {name!r}",
            fix="use . or _ within a name",
        )
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise DeclarationError(
            "a draw needs a fixed shape",
            path=f"{prefix}/{name}",
            expected="a tuple of whole numbers",
            got=repr(shape),
            fix=f'write draw.{kind}("{name}", (3, n))',
        )
    return Site(f"{prefix}/{name}", kind, shape)


class NumpyDraw:
    """`draw` in the Python engine, for one call in one tick."""

    __slots__ = ("_prefix", "_seed", "_time")

    def __init__(self, prefix: str, seed: np.ndarray, time: int) -> None:
        self._prefix, self._seed, self._time = prefix, seed, time

    def normal(self, name: str, shape: tuple[int, ...]) -> Any:
        return self._numbers("normal", name, shape)

    def uniform(self, name: str, shape: tuple[int, ...]) -> Any:
        return self._numbers("uniform", name, shape)

    def _numbers(self, kind: str, name: str, shape: tuple[int, ...]) -> Any:
        try:
            found = _known_site(self._prefix, kind, name, shape)
        except TypeError:  # a shape that is no tuple of numbers: `site` says so
            found = site(self._prefix, kind, name, shape)
        return found.numbers(self._time, self._seed, xp=NUMPY)


_known_site = lru_cache(maxsize=1024)(site)


def seed_words(seed: int) -> np.ndarray:
    """(2,) uint32 from a seed in 0 .. 2^64 - 1.

    Raises:
        DeclarationError: for anything else.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**64:
        raise DeclarationError(
            "this is no seed",
            path="seed",
            expected="a whole number from 0 to 2^64 - 1",
            got=repr(seed),
            fix="write seed=0, or seeds=range(100) for many runs",
        )
    return np.array([int(seed) & _WORD, int(seed) >> 32], dtype=np.uint32)
