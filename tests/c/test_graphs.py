"""Every graph of the library gives the same in C as in Python, and nearly the same in single precision."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from flowgraph import simulate
from flowgraph.cli.options import case_of
from tests.support import same

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
GRAPHS = sorted(PROJECT["entry-points"]["flowgraph.graphs"])
"""The graphs of the library; each must have a line below for single precision."""

SINGLE = {
    "kalman": 1e-4,
    "async_kalman": 1e-4,
    "ekf": 5e-3,
    "ins_eskf": 5e-3,
    "complementary": 1e-3,
    "augmented_complementary": 1e-3,
    "orientation_complementary": 1e-3,
    "rbpf_indoor": 5e-2,
}
"""Largest difference of the estimate in single precision, in its own units, over a second of flight."""


def case(name: str):
    settings = ["duration=1"]
    if name == "orientation_complementary":
        settings.append("sensors=gyro,coordinate_acceleration,thrust")
        return case_of(name, "sim:thesis", settings, 0)[0]
    if name.startswith("rbpf"):
        settings.append("particles=60")
    return case_of(name, "sim", settings, 0)[0]


@pytest.mark.parametrize("name", GRAPHS)
def test_all_engines_agree(name):
    given = case(name)
    wanted = simulate(given.graph, given.inputs)
    for engine in ("reference", "xla", "c"):
        same(wanted, simulate(given.graph, given.inputs, engine=engine), exact=False)


@pytest.mark.parametrize("name", GRAPHS)
def test_single_precision_stays_near(name):
    given = case(name)
    double = simulate(given.graph, given.inputs, engine="c")[given.estimate]
    single = simulate(given.graph, given.inputs, engine="c", dtype="float32")[given.estimate]
    np.testing.assert_array_equal(double.time, single.time)
    for leaf, a in double.leaves.items():
        if a.dtype.kind == "f":
            np.testing.assert_allclose(single.leaves[leaf], a, rtol=0, atol=SINGLE[name], err_msg=leaf)
