"""Rotations obey their laws, for any rotation, in both precisions, and where formulas divide by zero."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from flowgraph.blocks.geometry import rotations as g
from flowgraph.recorder.namespaces import NUMPY


def series(x, first):
    """The series of cos(x), or with 1 of sin(x) / x, in exact fractions."""
    term, total, square = Fraction(1), Fraction(1), -(Fraction(x) ** 2)
    for k in range(first + 2, 60, 2):
        term *= square / (k * (k - 1))
        total += term
    return total


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_the_ratio_of_a_sine_to_its_angle_is_as_exact_as_a_number_can_be(kind):
    x = np.concatenate(
        [[0.0, 1e-300, 1e-20, 1e-9], np.geomspace(1e-8, 3.0, 300), -np.geomspace(1e-3, 1.5, 50)]
    )
    x = x.astype(kind)
    got = g.sinc(x, xp=NUMPY)
    assert got.dtype == kind
    assert g.sinc(x, xp=np).tolist() == got.tolist()
    last = np.finfo(kind).eps
    for a, y in zip(x.tolist(), got.tolist(), strict=True):
        true = series(a, 1)
        assert abs(Fraction(y) - true) <= Fraction(float(last)) * abs(true) * 2  # two roundings


def test_a_rotation_vector_of_any_size_gives_its_quaternion_to_the_last_bits():
    rng = np.random.default_rng(3)
    for size in (0.0, 1e-200, 1e-40, 1e-17, 1e-16, 1e-15, 1e-12, 1e-8, 1e-3, 0.3, 2.0):
        v = size * rng.uniform(-1.0, 1.0, 3)
        half = math.sqrt(math.fsum((0.5 * v) ** 2))
        want = [float(series(half, 0)), *(float(series(half, 1) * Fraction(x) / 2) for x in v.tolist())]
        np.testing.assert_allclose(g.from_rotation_vector(v, xp=NUMPY), want, rtol=4e-16, atol=2e-16 * half)


numbers = st.floats(-1.0, 1.0, allow_subnormal=False)
vectors = arrays(np.float64, 3, elements=st.floats(-10.0, 10.0, allow_subnormal=False))
directions = arrays(np.float64, 3, elements=numbers).filter(lambda v: np.linalg.norm(v) > 1e-3)
quaternions = (
    arrays(np.float64, 4, elements=numbers)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)
turns = st.tuples(directions, st.floats(0.0, np.pi - 1e-6)).map(lambda p: p[0] / np.linalg.norm(p[0]) * p[1])


def scipy_matrix(q):
    return Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()


@given(quaternions)
def test_matrix_is_that_of_scipy(q):
    np.testing.assert_allclose(g.to_matrix(q, xp=np), scipy_matrix(q), atol=1e-14)


@given(quaternions, quaternions)
def test_product_of_quaternions_is_product_of_matrices(a, b):
    product = g.to_matrix(g.multiply(a, b, xp=np), xp=np)
    np.testing.assert_allclose(product, g.to_matrix(a, xp=np) @ g.to_matrix(b, xp=np), atol=1e-14)


@given(quaternions, quaternions, quaternions)
def test_product_is_associative(a, b, c):
    left = g.multiply(g.multiply(a, b, xp=np), c, xp=np)
    np.testing.assert_allclose(left, g.multiply(a, g.multiply(b, c, xp=np), xp=np), atol=1e-14)


@given(quaternions)
def test_conjugate_is_the_inverse(q):
    one = g.multiply(q, g.conjugate(q, xp=np), xp=np)
    np.testing.assert_allclose(one, [1.0, 0.0, 0.0, 0.0], atol=1e-15)


@given(quaternions, st.floats(0.01, 100.0))
def test_normalize_restores_the_norm(q, scale):
    np.testing.assert_allclose(g.normalize(q * scale, xp=np), q, atol=1e-14)


@given(quaternions, vectors)
def test_rotation_keeps_lengths_and_agrees_with_the_sandwich_product(q, v):
    turned = g.rotate(q, v, xp=np)
    assert np.isclose(np.linalg.norm(turned), np.linalg.norm(v), atol=1e-12)
    pure = np.concatenate([[0.0], v])
    sandwich = g.multiply(g.multiply(q, pure, xp=np), g.conjugate(q, xp=np), xp=np)
    np.testing.assert_allclose(sandwich[1:], turned, atol=1e-12)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(g.skew(a, xp=np) @ b, np.cross(a, b), atol=1e-12)


@given(turns)
def test_log_undoes_exp(v):
    q = g.from_rotation_vector(v, xp=np)
    assert np.isclose(np.linalg.norm(q), 1.0, atol=1e-14)
    np.testing.assert_allclose(g.to_rotation_vector(q, xp=np), v, atol=1e-9)
    np.testing.assert_allclose(g.to_rotation_vector(-q, xp=np), v, atol=1e-9)  # the shorter of q and -q


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-12, 1e-8, 0.9e-4, 1.1e-4, 1e-3, 3.0])
def test_exp_and_log_are_exact_near_zero_and_keep_the_precision(dtype, size):
    with np.errstate(all="raise", under="ignore"):
        v = np.asarray([0.6 * size, 0.0, -0.8 * size], dtype=dtype)
        q = g.from_rotation_vector(v, xp=np)
        back = g.to_rotation_vector(q, xp=np)
    assert q.dtype == back.dtype == dtype
    wanted = Rotation.from_rotvec(v.astype(float)).as_quat()[[3, 0, 1, 2]]
    np.testing.assert_allclose(q, wanted, rtol=0, atol=4 * np.finfo(dtype).eps)
    np.testing.assert_allclose(back, v, rtol=20 * np.finfo(dtype).eps, atol=0)


@given(directions, directions)
def test_between_vectors_turns_one_into_the_other_by_the_shortest_way(a, b):
    q = g.between_vectors(a, b, xp=np)
    unit_a, unit_b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    np.testing.assert_allclose(g.rotate(q, unit_a, xp=np), unit_b, atol=2e-5)
    angle = np.linalg.norm(g.to_rotation_vector(q, xp=np))
    shortest = np.arctan2(np.linalg.norm(np.cross(unit_a, unit_b)), unit_a @ unit_b)
    assert np.isclose(angle, shortest, atol=2e-5)


@given(directions)
def test_between_opposite_vectors_is_half_a_turn(a):
    q = g.between_vectors(a, -a, xp=np)
    assert np.isclose(np.linalg.norm(q), 1.0, atol=1e-12)
    np.testing.assert_allclose(g.rotate(q, a, xp=np), -a, atol=1e-9)


@given(directions)
def test_between_equal_vectors_is_no_turn(a):
    np.testing.assert_allclose(g.between_vectors(a, 2.0 * a, xp=np), [1.0, 0.0, 0.0, 0.0], atol=1e-12)


@given(quaternions, directions)
def test_level_points_the_force_up_and_turns_no_more_than_it_must(q, force):
    levelled = g.level(q, force, xp=np)
    up = g.rotate(levelled, force / np.linalg.norm(force), xp=np)
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=2e-5)
    before = g.rotate(q, force / np.linalg.norm(force), xp=np)
    tilt = np.degrees(np.arctan2(np.hypot(before[0], before[1]), before[2]))
    assert np.isclose(g.geodesic_angle(levelled, q), tilt, atol=2e-3)


@given(quaternions, st.floats(-179.0, 179.0), directions, st.floats(0.0, 170.0))
def test_error_splits_into_heading_then_tilt(truth, heading, axis, tilt):
    flat = np.array([axis[0], axis[1], 0.0])
    flat = flat / np.linalg.norm(flat) if np.linalg.norm(flat) > 1e-6 else np.array([1.0, 0.0, 0.0])
    about_z = g.from_rotation_vector(np.array([0.0, 0.0, np.radians(heading)]), xp=np)
    swing = g.from_rotation_vector(flat * np.radians(tilt), xp=np)
    estimate = g.multiply(swing, g.multiply(about_z, truth, xp=np), xp=np)
    found_tilt, found_heading = g.tilt_and_heading(estimate, truth)
    assert np.isclose(found_tilt, tilt, atol=1e-5)
    assert np.isclose(found_heading, heading, atol=1e-5)
    verticals = g.rotate(swing, np.array([0.0, 0.0, 1.0]), xp=np)[2]
    assert np.isclose(np.cos(np.radians(found_tilt)), verticals, atol=1e-9)


@given(quaternions, quaternions)
def test_geodesic_angle_is_symmetric_and_blind_to_sign(a, b):
    angle = g.geodesic_angle(a, b)
    assert 0.0 <= angle <= 180.0 + 1e-9
    assert np.isclose(angle, g.geodesic_angle(b, a), atol=1e-9)
    assert np.isclose(angle, g.geodesic_angle(-a, b), atol=1e-9)


@given(quaternions, quaternions, st.floats(0.0, 1.0))
def test_slerp_divides_the_way(a, b, part):
    between = g.slerp(a, b, part)
    assert np.isclose(g.geodesic_angle(a, between), part * g.geodesic_angle(a, b), atol=1e-5)
    assert g.geodesic_angle(g.slerp(a, b, 1.0), b) < 1e-5


def test_batches_are_rows():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(2, 5, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    v = rng.normal(size=(2, 5, 3))
    for function, args in (
        (g.multiply, (q, q[::-1])),
        (g.to_matrix, (q,)),
        (g.rotate, (q, v)),
        (g.skew, (v,)),
        (g.from_rotation_vector, (v,)),
        (g.to_rotation_vector, (q,)),
        (g.between_vectors, (v, v[::-1])),
        (g.level, (q, v)),
    ):
        whole = function(*args, xp=np)
        np.testing.assert_allclose(whole[1, 3], function(*(a[1, 3] for a in args), xp=np), atol=1e-14)


def test_right_product_multiplies_on_the_right():
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(2, 7, 4))
    found = (g.right_product(b, xp=np) @ a[..., None])[..., 0]
    np.testing.assert_allclose(found, g.multiply(a, b, xp=np), atol=1e-14)


def test_exp_of_a_tiny_rotation_is_exact():
    v = np.array([[0.0, 0.0, 0.0], [1e-200, 0.0, 0.0], [0.0, 3e-16, 0.0], [0.0, 0.0, 2e-9]])
    q = g.from_rotation_vector(v, xp=np)
    np.testing.assert_array_equal(q[:, 0], 1.0)
    np.testing.assert_allclose(q[:, 1:], v / 2, rtol=1e-15)
    assert np.isfinite(g.from_rotation_vector(v.astype(np.float32), xp=np)).all()
