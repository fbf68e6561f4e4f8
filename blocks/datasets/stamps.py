"""Stamps: in which unit they are, whether they can be a clock's, and what to do with those out of order.

A wrong stamp looks like any other number. What gives it away is the company it keeps: a step of 44 years
beside steps of 20 ms, an inertial unit of 50 MHz, a table in which nearly all stamps are equal. What cannot
be is refused by its row; a remedy that would throw most of a recording away is not offered.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping
from decimal import Decimal, DecimalException
from pathlib import Path
from typing import NoReturn

import numpy as np

from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = [
    "POLICIES",
    "UNITS",
    "as_nanoseconds",
    "check_clock",
    "in_order",
    "lasting",
    "likely_unit",
    "nanoseconds",
    "strictly_later",
    "stretch",
]

POLICIES = ("raise", "drop", "sort")
"""What to do with rows whose time does not increase: refuse them; leave them out; sort, and of equal times
keep the first."""

UNITS: Mapping[str, int] = {
    "s": 10**9,
    "ms": 10**6,
    "us": 10**3,
    "ns": 1,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
    "day": 86400 * 10**9,
}
"""The units that stamps come in, in ns."""

_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}

_LAST = 4_000_000_000
"""s; the year 2096. What is later is no time of a recording."""

_KEPT = 0.9
"""The share of the rows that a remedy must leave."""

_PAUSE = 3599 * 10**9  # ns; a step of an hour is a clock that was set
_INERTIAL = (50_000, 10**9)  # ns; between these lies the median step of an inertial unit
_OTHER = (50_000, 3600 * 10**9)
_USUAL = (2e5, 2e8)  # ns; of units of time, the one that makes the median step lie here is meant

_WRAPS = {
    2**32: "a 32-bit counter of nanoseconds that wraps",
    2**32 * 10**3: "a 32-bit counter of microseconds that wraps",
    2**32 * 10**6: "a 32-bit counter of milliseconds that wraps",
    2**16 * 10**6: "a 16-bit counter of milliseconds that wraps",
    604_800 * 10**9: "a time of the week that begins anew",
    86_400 * 10**9: "a time of day that begins anew",
    3_600 * 10**9: "a local time that was set back by an hour",
}
"""By how much, in ns, a clock goes back that is none, and what it is."""


def nanoseconds(seconds: str) -> int:
    """Decimal seconds as an integer of nanoseconds, rounded once and never through a float.

    Raises:
        ValueError: when the text is not a finite number, or beyond 64 bits.
    """
    return as_nanoseconds(seconds, "s")


def as_nanoseconds(stamp: str, unit: str) -> int:
    """A decimal number of a unit of `UNITS` as an integer of nanoseconds, rounded once.

    Raises:
        ValueError: when the text is not a finite number, or beyond 64 bits.
    """
    try:
        number = Decimal(stamp)
        most = Decimal(9_223_372_036 * 10**9) / UNITS[unit]
        if "_" in stamp or not -most < number < most:
            raise ValueError
        return int((number * UNITS[unit]).to_integral_value())
    except (DecimalException, OverflowError, ValueError) as error:
        raise ValueError(f"not a finite number of {unit} below 9.2e9 s: {stamp!r}") from error


def likely_unit(stamp: str) -> str | None:
    """The unit that makes a stamp too large for its own a time from 2001 to 2096, or None."""
    try:
        number = Decimal(stamp)
        fits = [u for u in _WORDS if 10**18 <= number * UNITS[u] < _LAST * 10**9]
    except DecimalException:
        return None
    return fits[0] if fits else None


def stretch(ns: float) -> str:
    """A length of time as people say it: "44.4 years", "3.5 h", "20 ms"."""
    size = abs(float(ns))
    for unit, length in (("years", 365.25 * 864e11), ("days", 864e11), ("h", 36e11), ("s", 1e9), ("ms", 1e6)):
        if size >= length:
            return f"{size / length:.3g} {unit}"
    return f"{size / 1e3:.3g} us" if size >= 1e3 else f"{size:.3g} ns"


def lasting(time: np.ndarray) -> str:
    """A span of stamps (n,) in ns, in seconds: "1.4e+09 s to ... s"."""
    return f"{time[0] / 1e9:.9g} s to {time[-1] / 1e9:.9g} s"


def in_order(
    name: str, row: Callable[[int], str], time: np.ndarray, x: np.ndarray, bad_time: str
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Times (n,) and rows (n, ...) with increasing time, as `bad_time` (of `POLICIES`) says, and notes.

    Args:
        name: what the notes are about.
        row: what to call row k in a message.

    Raises:
        DataError: when a third of the stamps are equal to others; with bad_time="raise", for the first row
            that is not later than all before it; with "drop", when less than half of the rows would be left.
    """
    n = len(time)
    before = np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(time)[:-1]]) if n else time
    bad = np.flatnonzero(time <= before) if n else time[:0]
    if not len(bad):
        return time, x, []
    times, first = np.unique(time, return_index=True)
    twice = n - len(times)
    if 3 * twice > n and twice > 1:
        _all_alike(row, time, len(times))
    kept = _kept(time, before)
    if bad_time == "raise":
        _out_of_order(row, time, before, int(bad[0]), kept, twice)
    if bad_time == "drop":
        if 2 * int(kept.sum()) < n:
            raise DataError(
                "leaving out rows out of order would leave too little of this recording",
                path=row(int(bad[0])),
                expected="at least half of the rows in order",
                got=f"{int(kept.sum())} of {n} rows",
                fix="check the column, the unit and the digits of the stamps",
            )
        return (
            time[kept],
            x[kept],
            [note("skipped", f"{name}: {n - int(kept.sum())} rows out of order left out")],
        )
    sentence = f"{name}: sorted, {len(bad)} rows were out of order"
    sentence += f", {twice} of equal time left out" if twice else ""
    return times, x[first], [note("skipped" if twice else "info", sentence)]


def _kept(time: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Which rows (n,) are left in order: those after all before them, unless a few lie ahead of most."""
    kept = time > before
    if kept.mean() >= _KEPT:
        return kept
    most = _longest(time)
    return most if most.mean() >= _KEPT else kept


def _longest(time: np.ndarray) -> np.ndarray:
    """Which rows (n,) make the longest run of increasing stamps that can be chosen."""
    ends: list[int] = []  # the smallest last stamp of a run of each length, and the row it is of
    rows: list[int] = []
    previous = np.full(len(time), -1)
    for k, stamp in enumerate(time.tolist()):
        place = bisect_left(ends, stamp)
        previous[k] = rows[place - 1] if place else -1
        ends[place : place + 1], rows[place : place + 1] = [stamp], [k]
    chosen = np.zeros(len(time), dtype=bool)
    k = rows[-1]
    while k >= 0:
        chosen[k] = True
        k = int(previous[k])
    return chosen


def _all_alike(row: Callable[[int], str], time: np.ndarray, different: int) -> NoReturn:
    same = np.flatnonzero(time[1:] == time[:-1])
    share = "nearly all" if 4 * different < len(time) else "many"
    raise DataError(
        f"{share} stamps are equal",
        path=row(int(same[0]) + 1 if len(same) else 0),
        expected="a stamp of its own for each row",
        got=f"{len(time)} rows with {different} different stamp{'s' * (different != 1)}",
        fix="write the stamps with all their digits (a C++ stream and %g write six), or check the column and "
        "the unit of the time",
    )


def _out_of_order(
    row: Callable[[int], str], time: np.ndarray, before: np.ndarray, k: int, kept: np.ndarray, twice: int
) -> NoReturn:
    n, lost = len(time), int((~kept).sum())
    back = int(before[k]) - int(time[k])
    ahead = np.flatnonzero(~kept)
    blamed = int(ahead[0]) if len(ahead) and ahead[0] < k else k  # one that lies ahead of those that follow
    sizes = _WRAPS if blamed == k else {}
    wraps = next((what for size, what in sizes.items() if abs(back - size) < 0.02 * size), None)
    enough = max((1.0 - _KEPT) * n, 2)
    remedies = []
    if wraps is None and lost <= enough:
        remedies.append("bad_time=drop leaves such rows out")
        if blamed == k and twice <= enough:
            remedies.append("bad_time=sort sorts them in")
    got = f"{time[k]} ns" + (f", {stretch(back)} back" if back else ", the same")
    if blamed != k:
        got = f"{time[blamed]} ns, which is {stretch(int(time[blamed]) - int(time[k]))} ahead of the next"
    raise DataError(
        "time does not increase",
        path=row(blamed),
        expected=f"a stamp after {before[k]} ns" if blamed == k else f"a stamp before {time[k]} ns",
        got=got + (f": as {wraps}" if wraps else ""),
        fix=", ".join(remedies)
        or "mend the stamps: "
        + ("add what the clock lost" if wraps else f"leaving rows out would cost {lost} of {n}"),
    )


def check_clock(
    name: str,
    row: Callable[[int], str],
    time: np.ndarray,
    *,
    inertial: bool,
    unit: str | None,
    drop: bool,
    fix: str,
) -> tuple[slice, str | None]:
    """Refuse stamps (n,), increasing int64 ns, that are of no clock.

    Args:
        name: of the stream.
        row: what to call row k in a message.
        inertial: whether they are of an inertial unit, which has a rate of its own.
        unit: what they were read as, if a setting `time.unit` can say otherwise.
        drop: whether a few rows that lie apart are left out.
        fix: what else can be done.

    Returns:
        The rows that hang together, and what is wrong with the others, or None.

    Raises:
        DataError: naming the row, or the rate.
    """
    if not len(time):
        return slice(None), None
    for k in (0, len(time) - 1):
        if not -1_000_000 * 10**9 <= time[k] < _LAST * 10**9:
            raise DataError(
                "a stamp is of no time that a recording can be of",
                path=row(k),
                expected="between 1970 and 2096",
                got=f"{time[k] / 1e9:.9g} s",
                fix="check the column and the unit of the time" + _settable(unit),
            )
    if len(time) < 3:
        return slice(None), None
    steps = np.diff(time)
    middle = int(np.partition(steps, (len(steps) - 1) // 2)[(len(steps) - 1) // 2])
    worst = int(np.argmax(steps))
    if steps[worst] > max(10_000 * middle, _PAUSE):
        return _apart(row, time, worst, middle, drop)
    least, most = _INERTIAL if inertial else _OTHER
    if least <= middle < most:
        return slice(None), None
    likely = _meant(middle, unit)
    usual = middle * UNITS[likely] / UNITS[unit] if likely and unit else 0.0
    index = inertial and unit == "s" and (steps == 10**9).all()
    raise DataError(
        "these stamps are an index, not a clock" if index else f"{name} has stamps of no such sensor's clock",
        path=row(0),
        expected=f"a median step from {stretch(least)} to "
        + (f"below {stretch(most)}" if inertial else stretch(most)),
        got=f"a median step of {stretch(middle)}, {len(time)} rows in {stretch(int(time[-1]) - int(time[0]))}"
        + (f"; in {_WORDS[likely]} it would be {stretch(usual)}" if likely and not index else ""),
        fix=(
            f"time.unit={likely}"
            if likely and not index
            else "choose the column of the time" + _settable(unit)
        )
        if unit
        else fix,
    )


def _meant(middle: int, unit: str | None) -> str | None:
    """The unit in which a median step would be a sensor's."""
    if unit is None:
        return None
    fits = [u for u in _WORDS if u != unit and _USUAL[0] <= middle * UNITS[u] / UNITS[unit] < _USUAL[1]]
    return fits[0] if fits else None


def _settable(unit: str | None) -> str:
    return ": time.unit=" + " or ".join(_WORDS) if unit else ""


def _apart(
    row: Callable[[int], str], time: np.ndarray, worst: int, middle: int, drop: bool
) -> tuple[slice, str]:
    """The greater side of a step that cannot be, and what to say of the lesser."""
    n, early = len(time), worst + 1
    first = early <= n - early
    count = early if first else n - early
    step = stretch(int(time[worst + 1]) - int(time[worst]))
    place = row(0 if first else worst + 1)
    which = (
        "the first stamp" if first and count == 1 else "the last stamp" if count == 1 else f"{count} stamps"
    )
    what = f"{place}: {which} lie{'s' * (count == 1)} {step} {'before' if first else 'after'} the others"
    if count <= max((1.0 - _KEPT) * n, 1) and drop:
        return slice(early, None) if first else slice(early), what
    unset = first and abs(int(time[0])) < 864e11
    raise DataError(
        f"{which} lie{'s' * (count == 1)} {step} {'before' if first else 'after'} the others",
        path=place,
        expected=f"steps as the others, {stretch(middle)}",
        got=f"a step of {step} from {time[worst]} ns to {time[worst + 1]} ns"
        + (", as of a clock that was not yet set" if unset else ""),
        fix="mend or delete "
        + ("the row" if count == 1 else "these rows")
        + (", or leave them out with bad_time=drop" if count <= max((1.0 - _KEPT) * n, 1) else ""),
    )


def strictly_later(seconds: np.ndarray, what: str, file: Path) -> tuple[np.ndarray, list[str]]:
    """Which rows (n,) come after all before them, and notes that name those that do not.

    Raises:
        DataError: when less than half of them do.
    """
    stamps = np.rint(np.asarray(seconds) * 1e9)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(stamps)[:-1]])
    keep = stamps > before
    bad = np.flatnonzero(~keep)
    if not len(bad):
        return keep, []
    first = int(bad[0])
    if 2 * int(keep.sum()) < len(keep):
        raise DataError(
            "most stamps do not increase",
            path=f"{file}: {what}, row {first + 1}",
            expected="stamps in seconds that increase",
            got=f"{len(bad)} of {len(keep)} rows are not after those before them",
            fix="write the stamps with all their digits, and in order",
        )
    step = 1e3 * float(seconds[first] - seconds[first - 1])
    more = f"; {len(bad)} rows in all are not after those before them" if len(bad) > 1 else ""
    sentence = f"{file.name}: {what}, row {first + 1} is {step:+.3f} ms after the one before{more}: left out"
    return keep, [note("skipped", sentence)]
