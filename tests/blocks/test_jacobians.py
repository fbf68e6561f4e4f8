"""Every Jacobian that the library has by hand is the derived one, or to the order that it says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flowgraph import jacobian
from flowgraph.blocks.geometry import euler
from flowgraph.blocks.geometry.groups import SE, SE_2, SO
from flowgraph.blocks.geometry.manifold import Part, StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import (
    between_vectors,
    conjugate,
    from_rotation_vector,
    multiply,
    rotate,
    to_rotation_vector,
)
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, predict
from flowgraph.blocks.models import euler_ins, pose
from flowgraph.blocks.orientation.fixed_gain import _arc_jacobian
from flowgraph.blocks.orientation.marg import predict_level
from flowgraph.blocks.outdoor import belief as outdoor
from flowgraph.blocks.signals import Belief, Gaussian, Imu, LevelBelief
from flowgraph.graphs.benches.jacobian_pairs import drawn
from flowgraph.graphs.benches.jacobians import PAIRS, apart

SILENT = ImuNoise(gyro=0.0, accelerometer=0.0, gyro_bias=0.0, accelerometer_bias=0.0)
SEEDS = pytest.mark.parametrize("seed", range(3))


def attitude(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def reading(rng: np.random.Generator) -> Imu:
    return Imu(gyro=rng.normal(size=3), specific_force=10.0 * rng.normal(size=3))


@SEEDS
def test_of_a_rotated_vector(seed):
    rng = np.random.default_rng(seed)
    q, v = attitude(rng), rng.normal(size=3)
    derived = jacobian(lambda q, xp: rotate(q, v, xp=xp), q, np)[1]
    by_hand = pose.rotated_jacobian(q, v, np)
    tangent = np.eye(4) - np.outer(q, q)  # a matrix may differ along q, which keeps its norm
    np.testing.assert_allclose(by_hand @ tangent, derived @ tangent, atol=1e-12)


@SEEDS
def test_of_what_a_motion_capture_sees(seed):
    rng = np.random.default_rng(seed)
    q, lever = attitude(rng), rng.normal(size=3)
    x = np.concatenate([rng.normal(size=6), q])

    def seen(x: Any, xp: Any) -> Any:
        return xp.concat([x[..., 3:6] + rotate(x[..., 6:], lever, xp=xp), x[..., 6:]], axis=-1)

    error = lambda s, xp: pose.POSE.minus(seen(s, xp), seen(x, np), xp)
    derived = jacobian(error, x, np)[1]
    np.testing.assert_allclose(pose.observe_jacobian(q, lever, np), derived, atol=1e-9)


@SEEDS
@pytest.mark.parametrize("order", ["zxy", "zyx"])
def test_of_the_rates_of_euler_angles(seed, order):
    rng = np.random.default_rng(seed)
    e, w = rng.uniform(-1.0, 1.0, 3), rng.normal(size=3)
    f = lambda e, xp: (euler.inverse_rate_matrix(e, order=order, xp=xp) @ w[:, None])[..., 0]
    by_hand = euler.inverse_rate_jacobian(e, w, order=order, xp=np)
    np.testing.assert_allclose(by_hand, jacobian(f, e, np)[1], atol=1e-12)


@SEEDS
@pytest.mark.parametrize("order", ["zxy", "zyx"])
def test_of_navigation_by_euler_angles(seed, order):
    rng = np.random.default_rng(seed)
    x, imu, dt = rng.uniform(-1.0, 1.0, 15), reading(rng), 0.02

    def move(s: Any, xp: Any) -> Any:
        state, noise = s[..., :15], s[..., 15:]
        turn, push = euler_ins.increments(state, imu, dt)
        moved = euler_ins.move(state, turn + noise[..., :3], push + noise[..., 3:6], dt, order=order, xp=xp)
        walk = xp.concat([xp.zeros((9,)), noise[..., 6:]], axis=-1)
        return moved + walk

    derived = jacobian(move, np.concatenate([x, np.zeros(12)]), np)[1]
    F, L = euler_ins.move_jacobians(x, *euler_ins.increments(x, imu, dt), dt, order=order, xp=np)
    np.testing.assert_allclose(F, derived[:, :15], atol=1e-12)
    np.testing.assert_allclose(L, derived[:, 15:], atol=1e-12)


@SEEDS
def test_of_the_shortest_arc_to_the_vertical(seed):
    rng = np.random.default_rng(seed)
    n = rng.normal(size=3) + np.array([0.0, 0.0, 2.0])
    n = n / np.linalg.norm(n)
    up = np.array([0.0, 0.0, 1.0])
    back = conjugate(between_vectors(n, up, xp=np), xp=np)
    turned = lambda n, xp: to_rotation_vector(
        multiply(between_vectors(n, 0.0 * n + up, xp=xp), back, xp=xp), xp=xp
    )
    np.testing.assert_allclose(_arc_jacobian(n, np), jacobian(turned, n, np)[1], atol=1e-12)


NAVIGATION = StateSpace(euclidean(6), quaternion(), euclidean(6))


def navigated(imu: Imu, dt: float) -> Callable[[Any, Any], Any]:
    """The step of `predict`, over (p, v, q, biases)."""

    def move(x: Any, xp: Any) -> Any:
        p, v, q = x[..., :3], x[..., 3:6], x[..., 6:10]
        rate, force = imu.gyro - x[..., 10:13], imu.specific_force - x[..., 13:16]
        half = from_rotation_vector(rate * (0.5 * dt), xp=xp)
        middle = multiply(q, half, xp=xp)
        step = (rotate(middle, force, xp=xp) + xp.asarray(GRAVITY)) * dt
        after = [p + (v + 0.5 * step) * dt, v + step, multiply(middle, half, xp=xp), x[..., 10:]]
        return xp.concat(after, axis=-1)

    return move


@SEEDS
@pytest.mark.parametrize(("dt", "order"), [(0.005, 1e-6), (0.1, 1e-2)])
def test_of_an_inertial_step_to_second_order_in_the_turn(seed, dt, order):
    """Its rows of the attitude and what follows the gyroscope's bias leave terms of (w dt)^2 out."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.normal(size=6), attitude(rng), 0.01 * rng.normal(size=6)])
    imu = reading(rng)
    after, F = linearised(navigated(imu, dt), x, NAVIGATION, np, seen=NAVIGATION)
    start = Belief(x[:3], x[3:6], x[6:10], x[10:13], x[13:16], np.eye(15))
    found = predict.step(start, imu, noise=SILENT, dt=dt, xp=np)
    np.testing.assert_allclose(found.position, after[:3], atol=1e-12)
    np.testing.assert_allclose(found.attitude, after[6:10], atol=1e-12)
    scale = np.sqrt(np.diag(F @ F.mT))
    error = np.abs(found.covariance - F @ F.mT) / np.outer(scale, scale)
    assert error.max() < order
    assert found.covariance[3, 6] != 0.0


LEVEL = StateSpace(euclidean(3), quaternion(), euclidean(3))


@SEEDS
@pytest.mark.parametrize(("dt", "order"), [(0.005, 1e-6), (0.1, 1e-2)])
def test_of_a_step_of_the_tilt_to_second_order_in_the_turn(seed, dt, order):
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.normal(size=3), attitude(rng), 0.01 * rng.normal(size=3)])
    imu = reading(rng)
    moved = navigated(imu, dt)

    def step(s: Any, xp: Any) -> Any:
        none = xp.zeros((3,))
        after = moved(xp.concat([none, s, none], axis=-1), xp)
        return after[..., 3:13]

    _, F = linearised(step, x, LEVEL, np, seen=LEVEL)
    start = LevelBelief(velocity=x[:3], attitude=x[3:7], gyro_bias=x[7:], covariance=np.eye(9))
    found = predict_level.step(start, imu, noise=SILENT, gravity=-GRAVITY[2], dt=dt, xp=np)
    scale = np.sqrt(np.diag(F @ F.mT))
    assert (np.abs(found.covariance - F @ F.mT) / np.outer(scale, scale)).max() < order


def outdoor_state(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([rng.normal(size=6) + 3.0, attitude(rng), rng.normal(size=3), attitude(rng)])


@SEEDS
def test_of_an_outdoor_step(seed):
    rng = np.random.default_rng(seed)
    x, imu, dt = outdoor_state(rng), reading(rng), 0.005
    moved = navigated(imu, dt)

    def step(x: Any, xp: Any) -> Any:
        after = moved(xp.concat([x[..., :10], xp.zeros((6,))], axis=-1), xp)
        return xp.concat([after[..., :10], x[..., 10:]], axis=-1)

    _, F = linearised(step, x, outdoor.OUTDOOR, np, seen=outdoor.OUTDOOR)
    start = Gaussian(mean=x, covariance=np.eye(15))
    found = outdoor.predict_clone.step(start, imu, noise=SILENT, dt=dt, xp=np)
    np.testing.assert_allclose(found.covariance, F @ F.mT, atol=1e-9)


@SEEDS
def test_of_an_outdoor_step_with_biases(seed):
    """To second order in the turn of a step, which is what F is."""
    rng = np.random.default_rng(seed)
    x, imu, dt = np.append(outdoor_state(rng), 0.1 * rng.normal(size=6)), reading(rng), 0.005
    moved = navigated(imu, dt)

    def step(x: Any, xp: Any) -> Any:
        after = moved(xp.concat([x[..., :10], x[..., 17:]], axis=-1), xp)
        return xp.concat([after[..., :10], x[..., 10:]], axis=-1)

    _, F = linearised(step, x, outdoor.BIASED, np, seen=outdoor.BIASED)
    start = Gaussian(mean=x, covariance=np.eye(21))
    found = outdoor.predict_clone.step(start, imu, noise=SILENT, dt=dt, xp=np)
    np.testing.assert_allclose(found.covariance, F @ F.mT, atol=1e-6)
    np.testing.assert_allclose(found.mean, step(x, np), atol=1e-12)


def test_of_the_error_after_a_correction_to_first_order():
    """`StateSpace.reset` is I - skew(d)/2: the derivative of the new error by the old leaves terms of d^2."""
    rng = np.random.default_rng(5)
    space = StateSpace(euclidean(2), quaternion())
    x = np.concatenate([rng.normal(size=2), attitude(rng)])
    for size in (1e-2, 1e-3):
        d = size * rng.normal(size=5)
        moved = space.plus(x, d, np)
        error = lambda e, xp, d=d, moved=moved: space.minus(space.plus(x, d + e, xp), moved, xp)
        exact = jacobian(error, np.zeros(5), np)[1]
        reset = space.reset(d, np)
        assert reset is not None
        np.testing.assert_allclose(reset, exact, atol=float(d @ d))


@pytest.mark.parametrize("name", PAIRS)
def test_a_step_by_hand_is_the_derived_one(name):
    """Each that the library has, to 1e-9 or to the order that it documents."""
    pair, rng = PAIRS[name], np.random.default_rng(7)
    found = [apart(pair, rng) for _ in range(5)]
    assert max(found) < pair.bound
    assert pair.bound <= 1e-9 or max(found) > 1e-3 * pair.bound  # the order is no pretext


def test_what_a_step_by_hand_leaves_out_is_of_the_order_that_it_says():
    """Half the step, a quarter of what is missing: each has an error of (w dt)^2 in a step."""
    for name in ("predict", "predict_level"):
        pair = PAIRS[name]
        x, P, z = drawn(pair, np.random.default_rng(1))
        off = []
        for dt in (0.04, 0.02):
            a, b = (step(x, P, z, dt, np).covariance for step in (pair.by_hand, pair.derived))
            scale = np.sqrt(np.diag(b))
            off.append(np.abs(a - b) / np.outer(scale, scale))
        assert 3.0 < off[0].max() / off[1].max() < 16.0, name


@SEEDS
def test_how_an_attitude_changes_with_a_small_turn(seed):
    """The closed form of a quaternion is what is derived of any part."""
    q = attitude(np.random.default_rng(seed))
    part: Any = quaternion()
    derived: Any = Part
    np.testing.assert_allclose(part.directions(q, np), derived.directions(part, q, np), atol=1e-12)
    np.testing.assert_allclose(part.errors(q, np), derived.errors(part, q, np), atol=1e-12)


PARTS = (quaternion(), SO(2), SE(2), SE(3), SE_2(3), SE_2(3, error="world"))


@pytest.mark.parametrize("part", PARTS, ids=str)
def test_a_function_is_linearised_on_any_space(part):
    """As its lines are, from a small move at x to one at y."""
    space = StateSpace(euclidean(2), part)
    rng = np.random.default_rng(3)
    x, turn = (np.asarray(space.plus(space.rest, rng.normal(size=space.tangent), np)) for _ in range(2))
    far, size, t = space.minus(turn, space.rest, np), space.size, space.tangent

    def f(s: Any, xp: Any) -> Any:
        return space.plus(s[..., :size], far * (1.0 + s[..., size:]), xp)

    y, J = linearised(f, x, space, np, seen=space, more=t)

    def error(d: Any, xp: Any) -> Any:
        start = space.plus(x, d[..., :t], xp)
        return space.minus(f(xp.concat([start, d[..., t:]], axis=-1), xp), y, xp)

    np.testing.assert_allclose(J, jacobian(error, np.zeros(2 * t), np)[1], atol=1e-12)
    np.testing.assert_allclose(y, space.plus(x, far, np), atol=1e-14)
    many = linearised(f, np.stack([x, turn]), space, np, seen=space, more=t)[1]
    np.testing.assert_allclose(many[0], J, atol=1e-12)
