"""States drawn number by number: what wraps is broken where it jumps, and nothing is drawn of nothing."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DataError
from flowgraph.drawing.states import Quantity, broken, plot_states

SECONDS = np.arange(100) * 0.1


def test_a_line_that_wraps_has_a_gap_at_each_jump():
    angle = (np.linspace(0.0, 800.0, 100) + 180.0) % 360.0 - 180.0
    seconds, values = broken(SECONDS, angle, True)
    assert np.isnan(values).sum() == 2
    assert len(seconds) == len(values) == 102
    kept = values[~np.isnan(values)]
    np.testing.assert_array_equal(kept, angle)
    assert np.nanmax(np.abs(np.diff(values))) < 180.0


def test_a_panel_has_its_band_its_truth_and_its_unit(tmp_path):
    wave = np.sin(SECONDS)
    shown = [
        Quantity("depth", SECONDS, wave, "m", np.full(100, 0.5), wave + 0.1),
        Quantity("heading", SECONDS, (60 * SECONDS + 180) % 360 - 180, "deg", np.full(100, 5.0), turns=True),
        Quantity("residual", SECONDS, wave, "", np.full(100, 0.3), dots=True),
    ]
    figure = plot_states(shown, tmp_path / "a.png", heading="mine")
    first, second, third = figure.axes
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert first.get_ylabel() == "[m]"
    low, high = (f(first.collections[0].get_paths()[0].vertices[:, 1]) for f in (np.min, np.max))
    assert (low, high) == (pytest.approx(wave.min() - 1.5), pytest.approx(wave.max() + 1.5))
    assert len(first.lines) == 2
    assert second.get_ylim() == (-180.0, 180.0)
    assert third.lines[1].get_linestyle() == "None"


def test_more_than_fit_are_named_and_nothing_is_refused():
    many = [Quantity(f"x {k}", SECONDS, SECONDS) for k in range(40)]
    figure = plot_states(many)
    assert len(figure.axes) == 36
    with pytest.raises(DataError, match="nothing to plot"):
        plot_states([])
