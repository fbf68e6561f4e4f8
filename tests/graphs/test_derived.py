"""Jacobians that nobody wrote: their filter is as accurate as one by hand, and the same in all engines."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, Graph, jacobian, simulate
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.models.pose import move_jacobian, start_pose
from flowgraph.blocks.models.unscented_pose import start_state
from flowgraph.graphs import ekf
from tests.graphs.derived import derived_ekf, ekf_by_hand, moving, operations
from tests.graphs.estimation import compare, engines_agree, thesis
from tests.graphs.test_ekf import a_state

DT = 0.01
NOISE = ImuNoise(gyro=0.0224, accelerometer=0.0224, gyro_bias=0.0, accelerometer_bias=0.0)


@cache
def both(seconds: float) -> tuple[Graph, Graph, Case]:
    """The derived filter, the one by hand, and a flight that scores them."""
    case = ekf.case(thesis(1, seconds))
    inputs: Any = case.inputs
    first = inputs["vicon"][0]
    settings: Any = {"noise": NOISE, "position_noise": 0.1, "attitude_noise": 0.1, "lever": (0.1, 0.0, -0.2)}
    derived = derived_ekf.build(start=start_state(first.position, first.attitude), **settings)
    return derived, ekf_by_hand.build(start=start_pose(first.position, first.attitude), **settings), case


def test_it_is_as_accurate_as_the_one_by_hand():
    derived, by_hand, case = both(3.0)
    found, other = (case.score(simulate(g, case.inputs)) for g in (derived, by_hand))
    for name in ("position_rmse_m", "attitude_rmse_deg", "nees_mean"):
        assert found[name] == pytest.approx(other[name], rel=0.01), name


def test_its_instructions_give_the_bits_of_its_steps():
    derived, _, case = both(0.5)
    python, reference = (simulate(derived, case.inputs, engine=e) for e in ("python", "reference"))
    for leaf, values in python["belief"].leaves.items():
        np.testing.assert_array_equal(values, reference["belief"][leaf], err_msg=leaf)


@pytest.mark.slow
def test_the_engines_agree():
    pytest.importorskip("jax")
    derived, _, case = both(2.0)
    python = engines_agree(derived, case.inputs)
    c = simulate(derived, case.inputs, engine="c")
    for name, series in python.series.items():
        compare(series, c[name])


def test_it_costs_at_most_what_the_one_by_hand_costs():
    derived, by_hand, _ = both(2.0)
    assert operations(derived) < 1.2 * operations(by_hand)


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobians_by_hand_are_the_derived_ones(seed):
    state, imu = a_state(seed)
    x = np.concatenate([state[3:6], state[:3], state[6:]])  # (p, v, q) of (v, p, q)
    swap = [3, 4, 5, 0, 1, 2, 6, 7, 8, 9]
    whole = jacobian(lambda s, xp: moving(imu, DT)(xp.concat([s, np.zeros(6)], axis=-1), xp), x, np)[1]
    np.testing.assert_allclose(whole[np.ix_(swap, swap)], move_jacobian(state[6:], imu, DT, np), atol=1e-9)


def test_many_states_at_once():
    rng = np.random.default_rng(3)
    states = [a_state(k)[0] for k in range(4)]
    imu = a_state(9)[1]
    x = np.stack([np.concatenate([s[3:6], s[:3], s[6:], 0.01 * rng.normal(size=6)]) for s in states])
    whole = jacobian(moving(imu, DT), x, np)[1]
    assert whole.shape == (4, 10, 16)
    for row, one in zip(x, whole, strict=True):
        np.testing.assert_allclose(jacobian(moving(imu, DT), row, np)[1], one, atol=1e-14)
