"""Straight code that the compiler packs into vectors: sigma points of a turn, whose rows it has mixed up."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from flowgraph import simulate
from flowgraph.blocks.filtering import unscented
from flowgraph.graphs.benches.model_problems import PROBLEMS, declared, drawn

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


def test_the_rows_of_sigma_points_stay_apart():
    problem = PROBLEMS["turn"]()
    built = declared(problem).build(method=unscented(), sizes={"m": 2})
    inputs = drawn(problem, 0).inputs
    ours, right = (simulate(built, inputs, engine=e)["output"] for e in ("c", "reference"))
    np.testing.assert_allclose(ours["mean"], right["mean"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ours["covariance"], right["covariance"], rtol=1e-9, atol=1e-9)
