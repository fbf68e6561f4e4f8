"""The bench of Jacobians: a row a step, by hand and derived, and two whole filters."""

from __future__ import annotations

import pytest

from flowgraph import DeclarationError, UnknownNameError, find_graph
from flowgraph.graphs.benches.jacobians import PAIRS, jacobians

KEYS = (
    "jacobian",
    "graphs",
    "operations",
    "derived_operations",
    "c_us",
    "derived_c_us",
    "python_us",
    "derived_python_us",
    "difference",
    "bound",
)


def test_a_step_stands_beside_the_derived_one():
    (row,) = jacobians(of="predict_turn", ticks=20, runs=1, engine="reference").rows
    assert tuple(row) == KEYS
    assert row["difference"] < row["bound"] == 1e-9
    assert 100 < row["operations"] < row["derived_operations"] < 1000
    assert min(row[k] for k in KEYS if k.endswith("_us")) > 0.0


def test_a_filter_of_a_model_takes_no_more_than_one_by_hand():
    (row,) = jacobians(of="filter ekf", ticks=20, runs=1, engine="reference").rows
    assert row["derived_operations"] < 1.2 * row["operations"]
    assert row["difference"] is None


def test_each_pair_names_graphs_of_the_library():
    for pair in PAIRS.values():
        for name in pair.graphs:
            find_graph(name)


def test_what_is_not_there_is_refused():
    with pytest.raises(UnknownNameError, match=r"jacobians.of[\s\S]*predict_turn"):
        jacobians(of="predict_turm")
    with pytest.raises(DeclarationError, match="whole number"):
        jacobians(of="predict_turn", ticks=0)
