"""The ensemble Kalman filter: the Kalman filter in the limit, equal in all engines, and what goes wrong."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DeclarationError, lower, simulate
from flowgraph.blocks.filtering import MeasurementModel, ensemble, extended, linear
from flowgraph.blocks.models.tracking import BICYCLE
from tests.blocks.filtering.test_filtered import GPS, driven, point, spots, tracker
from tests.support import all_engines, both_quick


@pytest.mark.parametrize("engines", [both_quick, pytest.param(all_engines, marks=pytest.mark.slow)])
def test_it_is_equal_in_the_engines_lowered_and_drawn(engines):
    _, inputs = driven(2.0)
    built = tracker.build(method=ensemble(50), gate=0.999)
    result = engines(built, inputs)
    assert len(result["innovation"]) == len(result["log_likelihood"]) == len(inputs["fix"])
    assert {"filter/carry", "filter/correct"} <= {stage.path for stage in lower(built).stages}
    assert "correct" in built.text()


def test_with_more_members_it_comes_to_the_kalman_filter():
    """Its error falls as one over the root of their number."""
    inputs = spots(25)
    exact = simulate(point.build(method=linear()), inputs, engine="reference")
    apart, likely = [], []
    for count in (50, 5000):
        runs = [
            simulate(point.build(method=ensemble(count, seed=k)), inputs, seed=k, engine="reference")
            for k in range(4)
        ]
        for leaf in ("mean", "covariance"):
            off = [run["output"][leaf] - exact["output"][leaf] for run in runs]
            apart.append(np.sqrt(np.mean(np.square(off))))
        total = [run["log_likelihood"]["value"].sum() for run in runs]
        likely.append(np.mean(total) - exact["log_likelihood"]["value"].sum())
    few, many = apart[:2], apart[2:]
    for a, b in zip(few, many, strict=True):
        assert 5.0 < a / b < 20.0, "10 in the mean"
    assert abs(likely[1]) < 0.2


def test_noise_that_goes_in_is_noise_that_is_added_where_it_only_adds():
    inside = MeasurementModel(
        BICYCLE, lambda x, v, xp: x.position + v, noise=[4.0, 4.0], read=lambda fix: fix.position
    )
    _, inputs = driven(5.0)
    exact = simulate(tracker.build(method=extended()), inputs)["output"]["mean"]
    for seen in (GPS, inside):
        found = simulate(tracker.build(seen=seen, method=ensemble(2000)), inputs, engine="reference")
        assert np.abs(found["output"]["mean"] - exact)[:, :2].max() < 0.25


def test_a_gate_refuses_and_finds_its_way_back():
    jump = {k: (50.0, 50.0) for k in range(20, 40)}
    result = simulate(point.build(method=ensemble(200), gate=0.999), spots(at=jump), engine="reference")
    accepted = result["innovation"]["accepted"]
    assert accepted[:20].all()
    assert not accepted[20:25].any()
    assert accepted[-5:].all()
    assert np.abs(result["output"]["mean"][-1][:2] - 50.0).max() < 1.5


def test_entries_that_are_missing_say_nothing():
    inputs = spots(at={5: (np.nan, 0.1), 9: (np.nan, np.nan)})
    result = simulate(point.build(method=ensemble(100)), inputs, engine="reference")
    assert len(result["innovation"]) == len(inputs["spot"]) - 1
    assert result["innovation"]["parts"][5] == 1.0
    np.testing.assert_allclose(result["output"]["mean"][9], result["prior"]["mean"][9], atol=1e-14)
    assert np.isfinite(result["output"]["covariance"]).all()


@pytest.mark.parametrize("count", [1, 0, 2.5, True])
def test_what_is_no_number_of_members_is_refused(count):
    with pytest.raises(DeclarationError, match="this is no number of members"):
        ensemble(count)
