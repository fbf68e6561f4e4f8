"""Euler angles: rotations, rate matrices against differences, singularities; the step of the filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowgraph import UnknownNameError
from flowgraph.blocks.geometry import euler, geodesic_angle
from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.models import euler_ins as ins
from flowgraph.blocks.models.unscented_ins import carried, far_points
from flowgraph.blocks.signals import Gaussian, Imu, PoseMeasurement
from flowgraph.blocks.unscented import predict_unscented

SCIPY = {"zyx": ("ZYX", [2, 1, 0]), "zxy": ("ZXY", [2, 0, 1])}
NOISE = ImuNoise(0.01, 0.1, 1e-3, 1e-2)
DT = 0.02


def some_angles(seed: int = 0, most: float = 1.3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-most, most, (40, 3))


def matrix(e: Any, order: str) -> np.ndarray:
    return np.asarray(euler.matrix_from_angles(np.asarray(e), order=order, xp=np))


def derivative(function: Any, x: np.ndarray, h: float) -> np.ndarray:
    """Five-point central differences, of error h^4: the columns are the slopes."""
    columns = []
    for d in np.eye(x.shape[-1]) * h:
        near, far = function(x + d) - function(x - d), function(x + 2 * d) - function(x - 2 * d)
        columns.append((8.0 * near - far) / (12.0 * h))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("order", euler.ORDERS)
def test_rotations_are_those_of_scipy_and_back(order):
    e = some_angles()
    letters, places = SCIPY[order]
    R = matrix(e, order)
    np.testing.assert_allclose(R, Rotation.from_euler(letters, e[:, places]).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(euler.angles_from_matrix(R, order=order, xp=np), e, atol=1e-13)
    q = euler.quaternion_from_angles(e, order=order, xp=np)
    np.testing.assert_allclose(euler.angles_from_quaternion(q, order=order, xp=np), e, atol=1e-13)


@pytest.mark.parametrize("order", euler.ORDERS)
def test_the_body_rate_matrix_is_that_of_finite_differences(order):
    """skew(w) = R^T dR/dt, with dR/dt from differences of the rotation along each angle."""
    for e in some_angles(1):
        slopes = derivative(lambda a: matrix(a, order), e, 1e-3)  # (3, 3, angle)
        turns = np.einsum("ji,jkn->ikn", matrix(e, order), slopes)
        found = np.stack([turns[2, 1], turns[0, 2], turns[1, 0]])
        G = euler.body_rate_matrix(e, order=order, xp=np)
        np.testing.assert_allclose(G, found, atol=1e-9)
        world = np.einsum("ijn,kj->ikn", slopes, matrix(e, order))
        found = np.stack([world[2, 1], world[0, 2], world[1, 0]])
        np.testing.assert_allclose(euler.world_rate_matrix(e, order=order, xp=np), found, atol=1e-9)
        np.testing.assert_allclose(
            G @ euler.inverse_rate_matrix(e, order=order, xp=np), np.eye(3), atol=1e-13
        )
        assert abs(np.linalg.det(G) - euler.singular_cosine(e, order=order, xp=np)) < 1e-13


@pytest.mark.parametrize("order", euler.ORDERS)
def test_the_slope_of_the_inverse(order):
    w = np.array([0.3, -1.1, 0.7])
    for e in some_angles(2, 1.0):
        rate = lambda a: np.asarray(euler.inverse_rate_matrix(a, order=order, xp=np)) @ w
        J = euler.inverse_rate_jacobian(e, w, order=order, xp=np)
        np.testing.assert_allclose(J, derivative(rate, e, 1e-3), atol=1e-8)


@pytest.mark.parametrize(("order", "which"), [("zyx", 1), ("zxy", 0)])
def test_at_its_singularity_everything_stays_finite_and_a_warning_names_it(order, which):
    e = np.zeros(3)
    e[which] = np.pi / 2
    assert np.isfinite(euler.inverse_rate_matrix(e, order=order, xp=np)).all()
    cosine = np.asarray([euler.singular_cosine(e, order=order, xp=np)])
    said = ins.singularity_warning(cosine, order)
    assert said is not None
    assert f"{['phi (roll)', 'theta (pitch)'][which]} = +-90 degrees" in said
    assert ins.singularity_warning(np.array([0.9]), order) is None
    other = "zxy" if order == "zyx" else "zyx"
    assert euler.singular_cosine(e, order=other, xp=np) == 1.0


@pytest.mark.parametrize("order", euler.ORDERS)
def test_beyond_the_singularity_the_nearer_of_two_triples_is_taken(order):
    for e in some_angles(3):
        e = (
            e
            + np.array([np.pi, 0.0, 0.0]) * (order == "zxy")
            + np.array([0.0, np.pi, 0.0]) * (order == "zyx")
        )
        q = euler.quaternion_from_angles(e, order=order, xp=np)
        found = ins.measured_angles(np.asarray(q), e + 0.05, order=order, xp=np)
        np.testing.assert_allclose(matrix(found, order), matrix(e, order), atol=1e-12)
        np.testing.assert_allclose(euler.wrapped(np.asarray(found) - e), 0.0, atol=1e-12)


def test_an_unknown_convention_is_refused():
    with pytest.raises(UnknownNameError, match=r"zxy, zyx"):
        euler.need_order("xyz")


# The step


def a_step(seed: int) -> tuple[np.ndarray, Imu]:
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.normal(size=3), rng.uniform(-1, 1, 3), 0.3 * rng.normal(size=9)])
    return x, Imu(gyro=rng.normal(size=3), specific_force=rng.normal(size=3) + np.array([0, 0, 9.8]))


@pytest.mark.parametrize("order", euler.ORDERS)
def test_the_jacobians_of_the_step(order):
    for seed in range(5):
        x, imu = a_step(seed)

        def moved(x: Any, n: Any, imu: Imu = imu) -> np.ndarray:
            turn, push = ins.increments(x, imu, DT)
            after = np.asarray(ins.move(x, turn + n[:3], push + n[3:6], DT, order=order, xp=np))
            return after + np.concatenate([np.zeros(9), n[6:]])

        turn, push = ins.increments(x, imu, DT)
        F, L = ins.move_jacobians(x, turn, push, DT, order=order, xp=np)
        np.testing.assert_allclose(F, derivative(lambda a: moved(a, np.zeros(12)), x, 1e-3), atol=1e-9)
        np.testing.assert_allclose(L, derivative(lambda n, x=x: moved(x, n), np.zeros(12), 1e-3), atol=1e-9)


@pytest.mark.parametrize("order", euler.ORDERS)
def test_the_step_follows_a_rigid_body_to_second_order(order):
    """Constant rate in the body: the attitude is R Exp(w t), whatever the convention; halving dt quarters
    what is missing."""
    x, imu = a_step(1)
    x[9:] = 0.0
    exact = matrix(x[3:6], order) @ Rotation.from_rotvec(imu.gyro * 0.2).as_matrix()
    errors = []
    for steps in (20, 40):
        y, dt = x, 0.2 / steps
        for _ in range(steps):
            turn, push = ins.increments(y, imu, dt)
            y = np.asarray(ins.move(y, turn, push, dt, order=order, xp=np))
        errors.append(np.abs(matrix(y[3:6], order) - exact).max())
    assert errors[1] < 1e-4
    assert 3.5 < errors[0] / errors[1] < 4.5


def unscented(belief: Gaussian, imu: Imu, *, order: str, noise: ImuNoise, **more: Any) -> Gaussian:
    """The prediction of `ins_ukf_pose`."""
    density = np.diag(ins.increment_variances(noise))
    return predict_unscented.step(
        belief, imu, move=carried(order), noise=density, space=ins.STATE, points=far_points(12), **more
    )


@pytest.mark.parametrize("order", euler.ORDERS)
def test_an_angle_of_ninety_degrees_keeps_its_digits(order):
    """An arc sine would lose half of them."""
    e = np.zeros(3)
    e[{"zxy": 0, "zyx": 1}[order]] = np.pi / 2 - 1e-6
    R = euler.matrix_from_angles(e, order=order, xp=np)
    np.testing.assert_allclose(euler.angles_from_matrix(R, order=order, xp=np), e, rtol=0, atol=1e-12)


@pytest.mark.parametrize("order", euler.ORDERS)
def test_both_conventions_and_both_filters_say_the_same(order):
    x, imu = a_step(2)
    A = np.random.default_rng(0).normal(size=(15, 15))
    belief = Gaussian(mean=x, covariance=1e-6 * (A @ A.T + np.eye(15)))
    extended = ins.predict_extended.step(belief, imu, order=order, noise=NOISE, dt=DT, xp=np)
    sigma = unscented(belief, imu, order=order, noise=NOISE, dt=DT, xp=np)
    np.testing.assert_allclose(sigma.mean, extended.mean, atol=1e-5)
    np.testing.assert_allclose(sigma.covariance, extended.covariance, atol=1e-3 * extended.covariance.max())
    for step in (ins.predict_extended.step, unscented):
        still = step(belief, imu, order=order, noise=NOISE, dt=0.0, xp=np)
        np.testing.assert_allclose(still.mean, x, atol=1e-14)
        np.testing.assert_allclose(still.covariance, belief.covariance, atol=1e-18)


@pytest.mark.parametrize("order", euler.ORDERS)
def test_the_sigma_points_see_the_spread_of_drawn_noise(order):
    """Mean and covariance against 200,000 draws."""
    x, imu = a_step(3)
    belief = Gaussian(mean=x, covariance=np.diag(np.repeat([0.1, 0.05, 0.2, 0.1, 0.1], 3) ** 2))
    noise = ImuNoise(0.2, 1.0, 0.1, 0.1)
    found = unscented(belief, imu, order=order, noise=noise, dt=0.1, xp=np)
    rng = np.random.default_rng(0)
    points = x + rng.normal(size=(200_000, 15)) @ np.linalg.cholesky(belief.covariance).T
    shakes = rng.normal(size=(200_000, 12)) * np.sqrt(ins.increment_variances(noise) * 0.1)
    turn, push = ins.increments(points, imu, 0.1)
    after = ins.move(points, turn + shakes[:, :3], push + shakes[:, 3:6], 0.1, order=order, xp=np)
    after = after + np.concatenate([np.zeros((len(points), 9)), shakes[:, 6:]], axis=1)
    deviation = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose((after.mean(axis=0) - found.mean) / deviation, 0.0, atol=0.03)
    scale = deviation[:, None] * deviation
    np.testing.assert_allclose((np.cov(after.T) - found.covariance) / scale, 0.0, atol=0.04)


def test_a_difference_of_angles_is_wrapped():
    """A yaw of 179 degrees and a measured one of -179 are two degrees apart."""
    mean = np.zeros(15)
    mean[5] = np.radians(179.0)
    prior = Gaussian(mean=mean, covariance=np.eye(15) * 1e-2)
    q = euler.quaternion_from_angles(np.array([0.0, 0.0, np.radians(-179.0)]), order="zxy", xp=np)
    z = PoseMeasurement(np.zeros(3), np.asarray(q), np.zeros((6, 6)), np.array(0.0), np.array(1))
    settings: dict[str, Any] = {"order": "zxy", "R": np.eye(6) * 1e-6, "xp": np}
    posterior, innovation = ins.update_pose_angles.step(prior, z, **settings)
    np.testing.assert_allclose(innovation.residual[5], np.radians(2.0), atol=1e-12)
    np.testing.assert_allclose(posterior.mean[5], np.radians(-179.0), atol=1e-4)
    assert ins.update_pose_angles.step(prior, None, **settings) == (prior, None)


@pytest.mark.parametrize("order", euler.ORDERS)
def test_the_covariance_in_the_tangent_space(order):
    x, _ = a_step(4)
    A = np.random.default_rng(1).normal(size=(15, 15)) * 1e-4
    belief = Gaussian(mean=x, covariance=A @ A.T)
    found = ins.navigation_belief.step(belief, order=order, xp=np)
    draws = np.random.default_rng(2).normal(size=(100_000, 15)) @ A.T
    e = x[3:6] + draws[:, 3:6]
    turn = (
        Rotation.from_matrix(matrix(x[3:6], order)).inv() * Rotation.from_matrix(matrix(e, order))
    ).as_rotvec()
    error = np.concatenate([draws[:, :3], draws[:, 6:9], turn, draws[:, 9:]], axis=1)
    deviation = np.sqrt(np.diag(found.covariance))
    scale = deviation[:, None] * deviation
    np.testing.assert_allclose((np.cov(error.T) - found.covariance) / scale, 0.0, atol=0.02)


@pytest.mark.parametrize("order", euler.ORDERS)
@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-12, 1e-9, 3e-8, 1e-7, 1e-5, 1e-3])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_close_to_the_pole_the_angles_make_the_same_rotation(order, off, sign):
    e = some_angles(3, 3.0)
    e[:, 1 if order == "zyx" else 0] = sign * (np.pi / 2 - off)
    q = euler.quaternion_from_angles(e, order=order, xp=np)
    back = euler.angles_from_quaternion(q, order=order, xp=np)
    again = euler.quaternion_from_angles(back, order=order, xp=np)
    assert geodesic_angle(q, again).max() < 1e-6


@pytest.mark.parametrize(("order", "inner"), [("zyx", 0), ("zxy", 1)])
def test_at_the_pole_the_angles_are_those_of_scipy(order, inner):
    e = some_angles(4, 3.0)
    e[:, 1 - inner] = np.where(np.arange(len(e)) % 2, np.pi / 2, -np.pi / 2)
    q = euler.quaternion_from_angles(e, order=order, xp=np)
    letters, places = SCIPY[order]
    with pytest.warns(UserWarning, match="Gimbal lock"):
        theirs = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_euler(letters)
    ours = euler.angles_from_quaternion(q, order=order, xp=np)
    np.testing.assert_allclose(np.degrees(euler.wrapped(ours[:, places] - theirs)), 0.0, atol=1e-6)
    assert (ours[:, inner] == 0.0).all()
