"""An extended filter of the pose whose Jacobians nobody wrote: `jacobian` of what the unscented filter takes.

It is as accurate as `ekf`, the same in all engines, and costs no more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    Case,
    Graph,
    Stream,
    block,
    collect,
    delay,
    graph,
    jacobian,
    latest,
    lower,
    simulate,
)
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.filters import update_extended
from flowgraph.blocks.models.pose import POSE, between_imu, move_jacobian, start_pose, tangent_jacobian
from flowgraph.blocks.models.unscented_pose import (
    STATE,
    carry_pose,
    imu_density,
    named_pose,
    see_pose,
    start_state,
)
from flowgraph.blocks.signals import Gaussian, Imu, Pose
from flowgraph.graphs import ekf
from flowgraph.graphs.ukf import stacked_pose
from flowgraph.pipeline.costs import Costs
from flowgraph.pipeline.optimise import COMPILED
from tests.graphs.estimation import compare, engines_agree, thesis
from tests.graphs.test_ekf import a_state

Function = Callable[[Array, Any], Array]
DT = 0.01


def in_tangent_space(f: Function, space: StateSpace, seen: StateSpace, x: Array, xp: Any, more: int) -> Any:
    """f(x) and its derivative from the tangent space at x, and by `more` numbers, to that at f(x)."""
    t = space.tangent
    y = f(xp.concat([x, xp.zeros((more,), dtype=x.dtype)], axis=-1), xp)

    def moved(d: Array, xp: Any) -> Array:
        start = xp.concat([space.plus(x, d[..., :t], xp), d[..., t:]], axis=-1)
        return seen.minus(f(start, xp), y, xp)

    return y, jacobian(moved, xp.zeros((t + more,), dtype=x.dtype), xp)[1]


def moving(control: Imu, dt: Any, gravity: tuple[float, float, float] = GRAVITY) -> Function:
    carry = carry_pose(gravity)
    return lambda s, xp: carry(s[..., None, :10], control, s[..., None, 10:], dt, xp)[..., 0, :]


@block
def predict_derived(
    belief: Gaussian,
    control: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float],
    dt: float,
    xp: Any,
) -> Gaussian:
    after, J = in_tangent_space(moving(control, dt, gravity), STATE, STATE, belief.mean, xp, 6)
    F, G = J[..., :9], J[..., 9:]
    P = F @ belief.covariance @ F.mT + G @ xp.asarray(imu_density(noise), dtype=F.dtype) @ G.mT * dt
    return Gaussian(mean=STATE.plus(after, xp.zeros((9,)), xp), covariance=0.5 * (P + P.mT))


def see_derived(lever: tuple[float, float, float]) -> Callable[..., tuple[Array, Array]]:
    observe = see_pose(lever)
    return lambda x, xp: in_tangent_space(observe, STATE, POSE, x, xp, 0)


@graph
def derived_ekf(
    imu: Stream[Imu],
    vicon: Stream[Pose],
    *,
    start: Gaussian,
    noise: ImuNoise,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = GRAVITY,
):
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | vicon, name="control")
    prior = predict_derived(belief, between_imu(last, control), noise=noise, gravity=gravity)
    posterior, innovation = update_extended(
        prior,
        vicon.map(stacked_pose, name="pose"),
        observe=see_derived(lever),
        R=np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3),
        space=STATE,
        measured_space=POSE,
    )
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    return {"belief": named_pose(posterior)}


NOISE = ImuNoise(gyro=0.0224, accelerometer=0.0224, gyro_bias=0.0, accelerometer_bias=0.0)


@cache
def both(seconds: float) -> tuple[Graph, Graph, Case]:
    """The derived filter, the one by hand, and a flight that scores them."""
    case = ekf.case(thesis(1, seconds))
    inputs: Any = case.inputs
    first = inputs["vicon"][0]
    settings: Any = {"noise": NOISE, "position_noise": 0.1, "attitude_noise": 0.1, "lever": (0.1, 0.0, -0.2)}
    derived = derived_ekf.build(start=start_state(first.position, first.attitude), **settings)
    return derived, ekf.build(start=start_pose(first.position, first.attitude), **settings), case


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
    """Scalar operations of a tick with an IMU reading and a pose, in the two blocks of each."""
    derived, by_hand, _ = both(2.0)
    pairs = [(derived, "predict_derived update_extended"), (by_hand, "predict_pose update_pose")]
    counts = [Costs(lower(g), 3, COMPILED).by_stage for g, _ in pairs]
    own, other = (
        sum(sum(found[stage].values()) for stage in stages.split())
        for found, (_, stages) in zip(counts, pairs, strict=True)
    )
    assert own < 1.2 * other, own / other


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobians_by_hand_are_the_derived_ones(seed):
    state, imu = a_state(seed)
    x = np.concatenate([state[3:6], state[:3], state[6:]])  # (p, v, q) of (v, p, q)
    after, J = in_tangent_space(moving(imu, DT), STATE, STATE, x, np, 6)
    F = tangent_jacobian(state[6:], after[6:], imu, DT, np)
    np.testing.assert_allclose(J[:, :9], F, atol=1e-9)
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
