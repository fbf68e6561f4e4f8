"""`bench fixed`: a row a filter, with formats and what they are worth, or the reason why it has none."""

from __future__ import annotations

import pytest

from flowgraph.graphs.benches.fixed import fixed


@pytest.mark.slow
def test_a_row_has_figures_or_a_reason():
    rows = fixed(
        graphs="roll_pitch, tag_pose", duration=1.0, flights=2, compared=0.3, width=26, least=26
    ).rows
    first, second = rows
    assert first["graph"] == "roll_pitch"
    assert first["bits"] == 26
    assert first["reason"] is None
    assert 0.0 < first["estimate_difference_relative"] < 1e-3
    assert first["saturations"] == 0
    assert first["values_compared"] > 50
    assert first["values_differing"] == 0
    assert second["graph"] == "tag_pose"
    assert second["bits"] is None
    assert len(second["reason"]) > 20
