"""The bench of particles: a row a size, and a picture."""

from __future__ import annotations

import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.graphs.benches.particles import FILTERS, particles, sizes


@pytest.mark.parametrize("name", FILTERS)
def test_a_row_a_size_beside_the_reference(name, tmp_path):
    report = particles(filter=name, least=20, most=50, flights=1, duration=1.5, engine="python")
    assert [row["particles"] for row in report.rows] == [20, 50]
    for row in report.rows:
        assert row["position_rmse_m"] > 0.0
        assert row["position_ratio"] == row["position_rmse_m"] / row["reference_position_rmse_m"]
        assert 0.0 < row["effective_part"] <= 1.0
        assert row["us_per_tick"] > 0.0
        assert (row["attitude_rmse_deg"] is None) == (name == "particle")
    report.figures["particles.svg"](tmp_path / "particles.svg")
    assert "</svg>" in (tmp_path / "particles.svg").read_text()


def test_the_sizes_are_round_numbers():
    assert sizes(10, 10_000) == [10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000]
    assert sizes(30, 30) == [30]


def test_what_cannot_be_run_is_refused():
    with pytest.raises(UnknownNameError, match="rbpf_indoor"):
        particles(filter="ukf")
    with pytest.raises(DeclarationError, match="no size between"):
        particles(least=100, most=10)
    with pytest.raises(DeclarationError, match="whole number"):
        particles(flights=0)
