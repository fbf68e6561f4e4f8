"""Every graph of the library gives the same in C as in Python, and nearly the same in single precision."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import simulate
from tests.graphs.library import LIBRARY, library_case
from tests.support import same

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
    "gnss_ins": 5e-3,
    "complementary": 1e-3,
    "augmented_complementary": 1e-3,
    "orientation_complementary": 1e-3,
    "quaternion_ukf": 1e-3,
    "roll_pitch": 1e-3,
    "gyro_integration": 1e-3,
    "marg": 1e-3,
    "attitude_mekf": 1e-3,
    "particle": 5e-2,
    "tracker": 1e-4,
    "ins_particle": 0.2,  # of 60 particles; one that is drawn in place of another moves the mean
    "rbpf_indoor": 5e-2,
    "rbpf_outdoor": 0.1,  # m and m/s; as above
    "imu_calibration": 0.05,  # counts of 1024, means of growing sums
}
"""Largest difference of the estimate in single precision, in its own units, over a second of flight."""


LONG = {
    "ukf",
    "ins_ukf_pose",
    "ins_ukf_velocity",
    "ins_particle",
    "quaternion_ukf",
    "rbpf_indoor",
    "rbpf_outdoor",
}
"""They take 5 to 20 s to compile."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in LIBRARY]
)
def test_c_agrees_with_python_and_with_the_interpreter(name):
    """XLA is compared in `tests/graphs/test_optimised.py`, and in each graph's own tests."""
    given = library_case(name)
    wanted = simulate(given.graph, given.inputs)
    for engine in ("reference", "c"):
        same(wanted, simulate(given.graph, given.inputs, engine=engine), exact=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_single_precision_stays_near(name):
    given = library_case(name)
    double = simulate(given.graph, given.inputs, engine="c")[given.estimate]
    single = simulate(given.graph, given.inputs, engine="c", dtype="float32")[given.estimate]
    np.testing.assert_array_equal(double.time, single.time)
    for leaf, a in double.leaves.items():
        if a.dtype.kind == "f":
            np.testing.assert_allclose(single.leaves[leaf], a, rtol=0, atol=SINGLE[name], err_msg=leaf)
