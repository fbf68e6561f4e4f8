"""`tracker`: one model by every method, on the flight in the plane."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, load_flight, simulate
from flowgraph.graphs import tracker
from flowgraph.graphs.tracker import METHODS
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn


def a_case(**settings):
    return tracker.case(load_flight("sim:plane", seed=1, settings={"duration": "10"}), **settings)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_follows_the_point(method):
    case = a_case(method=method, particles=2000)
    score = case.score(simulate(case.graph, case.inputs))
    assert score["position_rmse_m"] < 0.5
    assert 0.3 < score["nis_mean"] < 2.5


def test_the_gaussian_methods_are_one_filter_for_a_linear_model():
    beliefs = []
    for method in METHODS[:5]:
        case = a_case(method=method)
        beliefs.append(simulate(case.graph, case.inputs)["posterior"])
    for other in beliefs[1:]:
        np.testing.assert_allclose(other["mean"], beliefs[0]["mean"], atol=1e-12)
        np.testing.assert_allclose(other["covariance"], beliefs[0]["covariance"], atol=1e-12)


def test_the_engines_agree_and_it_is_lowered_and_drawn():
    pytest.importorskip("jax")
    case = a_case(method="imm", gate=0.999)
    engines_agree(case.graph, case.inputs)
    is_lowered_and_drawn(a_case(), "seen_in_plane")


def test_what_cannot_be_is_refused():
    with pytest.raises(DeclarationError, match=r"tracker.method[\s\S]*linear or extended"):
        a_case(method="kalman")
    with pytest.raises(DataError, match="position"):
        tracker.case(load_flight("sim", settings={"duration": "1"}))
    in_space = load_flight("sim:thesis", settings={"duration": "1", "sensors": "all"})
    with pytest.raises(DataError, match=r"position: the tracker follows a point in a plane[\s\S]*of 3"):
        tracker.case(in_space, position_noise=0.1)
