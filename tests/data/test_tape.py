"""Merging recorded series into ticks: nested times, interleaved times, no events at all."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from flowgraph import Series
from flowgraph.data.tape import Tape

stamps = st.lists(st.integers(-50, 50), unique=True).map(sorted)


def series(times: list[int]) -> Series:
    return Series(np.array(times, dtype=np.int64), np.zeros(len(times)))


@given(st.lists(stamps, max_size=4))
def test_a_tape_holds_each_time_once_with_the_sources_present(times):
    tape = Tape.of(tuple(series(t) for t in times))
    wanted = sorted(set().union(*times))
    assert tape.time.tolist() == wanted
    assert tape.key.tolist() == [sum(1 << k for k, own in enumerate(times) if t in own) for t in wanted]
    assert tape.patterns == tuple(sorted(set(tape.key.tolist())))


@given(stamps, st.integers(1, 7))
def test_times_that_lie_within_the_longest_add_no_tick(times, step):
    tape = Tape.of((series(times[::step]), series(times)))
    assert tape.time.tolist() == times
    assert tape.key.tolist() == [3 if k % step == 0 else 2 for k in range(len(times))]


def test_more_sources_than_a_table_of_patterns_holds():
    tape = Tape.of(tuple(series([k, 40]) for k in range(20)))
    assert tape.patterns == (*(1 << k for k in range(20)), 2**20 - 1)
