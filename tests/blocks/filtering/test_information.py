"""The information form: the covariance form in other numbers, and the better one where nothing is known."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import simulate
from flowgraph.blocks.filtering import extended, information
from tests.blocks.filtering.test_filtered import POINT, driven, point, spots, tracker


def test_it_is_the_extended_filter_of_a_car():
    _, inputs = driven(10.0)
    one, other = (simulate(tracker.build(method=m), inputs) for m in (extended(), information()))
    for name, leaf in (("output", "mean"), ("output", "covariance"), ("innovation", "nis")):
        np.testing.assert_allclose(other[name][leaf], one[name][leaf], rtol=1e-9, atol=1e-9)
    likely = one["log_likelihood"]["value"]
    np.testing.assert_allclose(other["log_likelihood"]["value"], likely, atol=1e-9)


@pytest.mark.parametrize("deviation", [1e4, 1e6])
def test_of_a_start_of_which_nothing_is_known_no_digit_is_lost(deviation):
    """The belief is the least-squares fit to all measurements: of a covariance of 1e12 few are left."""
    inputs = spots(12)
    nothing = POINT.space.gaussian(position=((5.0, -3.0), deviation), velocity=((1.0, 1.0), deviation))
    # the same by least squares, in the state at the first time and the noises of the steps
    time, z = inputs["spot"].time, inputs["spot"]["position"]
    at, rows, seen = np.eye(4), [], []
    width = 4 * len(time)
    reach = np.zeros((4, width))
    reach[:, :4] = at
    for k in range(len(time)):
        if k:
            F, _, Q = (np.asarray(a) for a in POINT.discrete((time[k] - time[k - 1]) * 1e-9, np, np.float64))
            reach = F @ reach
            reach[:, 4 * k : 4 * k + 4] = np.linalg.cholesky(Q)
            for i in range(4):
                rows.append(np.eye(width)[4 * k + i])
                seen.append(0.0)
        rows += list(reach[:2] / 0.5)
        seen += list(z[k] / 0.5)
    fit = reach @ np.linalg.lstsq(np.array(rows), np.array(seen), rcond=None)[0]
    found = simulate(point.build(method=information(), start=nothing), inputs)["output"]
    apart = np.abs(found["mean"][-1] - fit).max()
    assert apart < 10.0 / deviation**2 + 1e-11
    assert np.isfinite(found["covariance"]).all()
    if deviation == 1e6:
        plain = simulate(point.build(method=extended(), start=nothing), inputs)["output"]
        assert np.abs(plain["mean"][-1] - fit).max() > 100.0 * apart
