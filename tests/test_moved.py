"""Old names of modules lead to the modules that stand in their place."""

from __future__ import annotations

import importlib

import pytest

import flowgraph
from flowgraph.moved import MOVED
from tests.support import isolated


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_is_the_same_module(old):
    before = {n: getattr(flowgraph, n) for n in flowgraph.__all__}
    new = importlib.import_module(MOVED[old])
    assert importlib.import_module(old) is new
    assert new.__spec__ is not None
    assert new.__spec__.name == MOVED[old]
    assert [n for n in before if getattr(flowgraph, n) is not before[n]] == []


def test_a_module_below_one_that_was_moved():
    assert importlib.import_module("flowgraph.costs.report") is importlib.import_module(
        "flowgraph.pipeline.costs.report"
    )
    with pytest.raises(ModuleNotFoundError, match="nothing"):
        importlib.import_module("flowgraph.costs.nothing")


def test_old_imports_in_a_fresh_process():
    """In another order than here; a function of the name of a module stays what it is."""
    isolated(
        "from flowgraph.xla_batch import vectorised\n"
        "from flowgraph.graph import Graph\n"
        "from flowgraph.blocks.euler import angles_from_quaternion\n"
        "from flowgraph.blocks.kalman import Gaussian, update_linear\n"
        "from flowgraph.c import write_c\n"
        "from flowgraph.pipeline import Pipeline\n"
        "import flowgraph\n"
        "assert flowgraph.graph.__name__ == 'graph' and flowgraph.Graph is Graph\n"
        "assert callable(flowgraph.simulate) and callable(flowgraph.block)\n"
    )
    isolated(
        "from flowgraph.simulate import simulate\nimport flowgraph\nassert flowgraph.simulate is simulate\n"
    )
