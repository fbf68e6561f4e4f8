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
HOST = {"tag_pose", "imu_calibration"}
"""Run in Python: PnP is on the host, and the calibration needs a recording of raw counts."""
GRAPHS = sorted(set(PROJECT["entry-points"]["flowgraph.graphs"]) - HOST)
"""The graphs of the library; each must have a line below for single precision."""

SINGLE = {
    "kalman": 1e-4,
    "async_kalman": 1e-4,
    "ekf": 5e-3,
    "ukf": 5e-3,
    "ins_eskf": 5e-3,
    "ins_ekf_pose": 5e-3,
    "ins_ukf_pose": 5e-3,
    "ins_ukf_velocity": 5e-3,
    "outdoor_eskf": 5e-3,
    "complementary": 1e-3,
    "augmented_complementary": 1e-3,
    "orientation_complementary": 1e-3,
    "quaternion_ukf": 1e-3,
    "roll_pitch": 1e-3,
    "gyro_integration": 1e-3,
    "marg": 1e-3,
    "particle": 5e-2,
    "ins_particle": 0.2,  # of 60 particles; one that is drawn in place of another moves the mean
    "rbpf_indoor": 5e-2,
    "rbpf_outdoor": 5e-2,
}
"""Largest difference of the estimate in single precision, in its own units, over a second of flight."""

OWN = {
    "orientation_complementary": ("sim:thesis", ["sensors=gyro,coordinate_acceleration,thrust"]),
    "outdoor_eskf": ("sim:thesis", ["sensors=imu,gps,gps2,altimeter,magnetometer,optical_flow"]),
    "rbpf_outdoor": (
        "sim:thesis",
        ["sensors=imu,gps,gps2,altimeter,magnetometer,optical_flow", "particles=60"],
    ),
    "rbpf_indoor": ("sim", ["particles=60"]),
    "marg": ("sim:thesis", ["sensors=imu,magnetometer"]),
    "particle": ("sim:plane", ["particles=60"]),
    "ins_ekf_pose": ("course", []),
    "ins_ukf_pose": ("course", []),
    "ins_ukf_velocity": ("course", []),
    "ins_particle": ("course", ["particles=60"]),
}
"""The flight of a graph, and settings, where it is not a second of `sim`."""


def case(name: str):
    data, settings = OWN.get(name, ("sim", []))
    return case_of(name, data, ["duration=1", *settings], 0)[0]


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
