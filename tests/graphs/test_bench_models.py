"""The bench of models: a row a problem and method, and peers that agree."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.graphs.benches.model_problems import PROBLEMS, drawn
from flowgraph.graphs.benches.models import METHODS, models

KEYS = (
    "problem",
    "filter",
    "rmse",
    "nees_mean",
    "dimension",
    "log_likelihood",
    "peer",
    "peer_difference",
    "peer_error",
    "c_us",
)


@pytest.mark.parametrize(
    ("problem", "method", "peer"),
    [
        ("point", "square_root", "filterpy, pykalman"),
        ("point", "information", "filterpy"),
        ("radar", "iterated", "stonesoup"),
        ("ranges", "cubature", "filterpy, stonesoup"),
        ("turn", "unscented", "filterpy"),
        ("bicycle", "extended", "filterpy"),
        ("pendulum", "cubature", "filterpy"),
        pytest.param("point", "linear", "filterpy, pykalman, dynamax", marks=pytest.mark.slow),
        pytest.param("radar", "extended", "filterpy, dynamax", marks=pytest.mark.slow),
        pytest.param("pose", "extended", "filterpy", marks=pytest.mark.slow),
    ],
)
def test_a_peer_with_the_same_method_agrees(problem, method, peer):
    for name in (*peer.split(", "), "jax"):
        pytest.importorskip(name)
    (row,) = models(problem=problem, method=method, runs=1, engine="reference").rows
    assert tuple(row) == KEYS
    assert row["peer"] == peer
    assert row["peer_difference"] < 1e-9
    assert 0.3 * row["dimension"] < row["nees_mean"] < 3.0 * row["dimension"]
    assert row["peer_error"] is None


def test_particles_have_the_likelihood_of_the_exact_filter():
    rows = models(problem="point", method="bootstrap", runs=1, particles=3000, engine="reference").rows
    assert rows[0]["peer"] == "linear"
    assert abs(rows[0]["peer_difference"]) < 3.0, "of 340, over 100 measurements"


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["point", "ranges"])  # all: `flowgraph bench models`
def test_every_method_follows_every_problem(problem):
    rows = models(problem=problem, runs=2, particles=500, engine="reference").rows
    assert {row["filter"] for row in rows} >= set(METHODS) - {"linear"}
    for row in rows:
        assert np.isfinite([row["rmse"], row["nees_mean"], row["log_likelihood"], row["c_us"]]).all()


def test_the_truth_is_drawn_from_the_model():
    """Of the point: its velocity wanders by the density, 0.5 m/s^2/sqrt(Hz), and the measurement by 1 m."""
    run = drawn(PROBLEMS["point"](), 0)
    steps = np.diff(run.truth[:, 2:], axis=0)
    assert steps.std() == pytest.approx(0.5 * np.sqrt(0.5), rel=0.15)
    assert (run.inputs["z"]["value"] - run.truth[:, :2]).std() == pytest.approx(1.0, rel=0.15)


def test_what_is_not_there_is_refused():
    with pytest.raises(UnknownNameError, match=r"models.problem[\s\S]*radar"):
        models(problem="rader")
    with pytest.raises(UnknownNameError, match=r"models.method"):
        models(method="ukf")
    with pytest.raises(DeclarationError, match="whole number"):
        models(runs=0)
