"""Damaged files and killed processes, briefly; `tests.fuzz` and `tests.kills` are the same at length."""

from __future__ import annotations

import pytest

from tests import kills
from tests.fuzz.__main__ import run

pytest.importorskip("rosbags", reason="needs the extra ros")
pytest.importorskip("pyarrow", reason="needs the extra study")


@pytest.mark.parametrize("seed", [11, 12])
def test_damaged_files_end_in_what_they_hold_or_in_our_error(seed):
    found = run(seed, 340, limit=False)
    assert found["failures"] == []
    assert min(found["kinds"].values()) >= 10


@pytest.mark.slow
def test_damaged_files_at_length():
    assert run(13, 4_000, limit=False)["failures"] == []


@pytest.mark.slow
def test_nothing_is_lost_half_or_left_by_kill_9():
    assert kills.run(16, 5)["failures"] == []
