"""`bench registers`: of few bits they make a particle filter resample otherwise, of many alike."""

from __future__ import annotations

import pytest

from flowgraph import DeclarationError
from flowgraph.graphs.benches.registers import registers


@pytest.mark.slow
def test_wider_registers_decide_alike():
    rows = registers(particles="10, 50", bits="16,44", duration=2.0).rows
    assert [(r["particles"], r["bits"]) for r in rows] == [(10, 16), (10, 44), (50, 16), (50, 44)]
    for narrow, wide in (rows[:2], rows[2:]):
        assert narrow["events"] == wide["events"] == 9
        assert 0 < narrow["events_differing"] < 9
        assert narrow["first_differing"] < 9
        assert wide["events_differing"] == 0
        assert wide["first_differing"] is None


@pytest.mark.parametrize("text", ["", "ten", "0", "10,-1"])
def test_numbers_that_are_none(text):
    with pytest.raises(DeclarationError, match=r"(?s)registers.particles: these are no whole numbers.*--set"):
        registers(particles=text)
