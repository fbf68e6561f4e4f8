"""Closed forms along the last axis, against the functions for one quaternion or matrix at a time."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.geometry import rotations as g

N = 7


def quaternions(seed: int) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(4, N))
    return q / np.linalg.norm(q, axis=0)


def test_quaternions_agree_with_geometry():
    a, b = quaternions(0), quaternions(1)
    v = np.random.default_rng(2).normal(size=(3, N))
    np.testing.assert_allclose(lanes.multiply(a, b, xp=np).T, g.multiply(a.T, b.T, xp=np), atol=1e-15)
    np.testing.assert_allclose(lanes.exponential(v, xp=np).T, g.from_rotation_vector(v.T, xp=np), atol=1e-15)
    R = np.moveaxis(lanes.rotation_matrices(a, xp=np), -1, 0)
    np.testing.assert_allclose(R, g.to_matrix(a.T, xp=np), atol=1e-15)
    np.testing.assert_allclose(lanes.normalize(3.0 * a, xp=np), a, atol=1e-15)


def test_one_vector_is_rotated_by_every_attitude():
    q, v = quaternions(0), np.array([0.3, -9.0, 2.0])
    np.testing.assert_allclose(lanes.rotate(q, v, xp=np), (g.to_matrix(q.T, xp=np) @ v).T, atol=1e-14)


def test_rotation_vectors_to_one_attitude():
    q, z = quaternions(0), quaternions(1)[:, 0]
    q[:, 0] = z  # no turn at all
    q[:, 1] = -z
    q[:, 2] = g.multiply(z, g.from_rotation_vector(np.array([1e-7, 0.0, 0.0]), xp=np), xp=np)
    found = lanes.rotation_vectors_to(q, z, xp=np)
    relative = g.multiply(g.conjugate(q.T, xp=np), np.broadcast_to(z, (N, 4)), xp=np)
    np.testing.assert_allclose(found.T, g.to_rotation_vector(relative, xp=np), atol=1e-14)
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-15)
    np.testing.assert_allclose(found[:, 2], [-1e-7, 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.01, 1.0, 3.0])
def test_a_turned_attitude_is_the_product_with_the_exponential(size):
    q, v = quaternions(0), size * np.random.default_rng(2).normal(size=(3, N))
    expected = lanes.multiply(q, lanes.exponential(v, xp=np), xp=np)
    np.testing.assert_allclose(lanes.turned(q, v, xp=np), expected, atol=2e-15)
    long = (1.0 + 1e-5) * q  # what is added brings the norm back
    np.testing.assert_allclose(lanes.turned(long, v, xp=np), expected, atol=2e-10)


def test_the_exponential_of_nothing_is_the_identity():
    np.testing.assert_array_equal(
        lanes.exponential(np.zeros((3, 2)), xp=np), [[1, 1], [0, 0], [0, 0], [0, 0]]
    )


def test_matrices_agree_with_linear_algebra():
    rng = np.random.default_rng(3)
    A, B = rng.normal(size=(2, N, 3, 3))
    last = lambda M: np.moveaxis(M, 0, -1)
    np.testing.assert_allclose(lanes.matrix_product(last(A), last(B)), last(A @ B), atol=1e-14)
    np.testing.assert_array_equal(lanes.transpose(last(A), xp=np), last(A.mT))
    S = A @ A.mT + 0.1 * np.eye(3)
    inverse, log_determinant = lanes.inverse_and_log_determinant(last(S), xp=np)
    np.testing.assert_allclose(inverse, last(np.linalg.inv(S)), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(S)[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("pivot", [1.0, 1e-6, 1e4])
def test_a_solution_by_triangles_agrees_with_linear_algebra(pivot):
    rng = np.random.default_rng(4)
    A, B = rng.normal(size=(N, 3, 3)), rng.normal(size=(N, 3, 5))
    S = A @ A.mT + 0.1 * np.eye(3)
    S[:, 0, :] *= pivot
    S[:, :, 0] *= pivot
    last = lambda M: np.moveaxis(M, 0, -1)
    solved, log_determinant = lanes.solve_and_log_determinant(last(S), last(B), xp=np)
    expected = np.linalg.solve(S, B)
    for k in range(3):  # the rows differ by the pivot in size
        np.testing.assert_allclose(
            solved[k], last(expected)[k], rtol=1e-9, atol=1e-9 * abs(expected[:, k]).max()
        )
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(S)[1], rtol=1e-9)


def test_cross_products_of_one_vector_with_many():
    rng = np.random.default_rng(4)
    a, B = rng.normal(size=(3, N)), rng.normal(size=(3, 5, N))
    expected = np.cross(a[:, None, :], B, axis=0)
    np.testing.assert_allclose(lanes.cross(a, B, xp=np), expected, atol=1e-15)
    shared = np.cross(a[:, :1, None], B, axis=0)
    np.testing.assert_allclose(lanes.cross(a[:, :1], B, xp=np), shared, atol=1e-15)
