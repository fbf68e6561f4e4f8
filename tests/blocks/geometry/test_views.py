"""Parts of a state by name: read, replaced, moved; and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.blocks.geometry import StateSpace, angle, euclidean, quaternion

CAR = StateSpace(position=euclidean(2), heading=angle(), speed=euclidean(1))
X = np.array([[1.0, 2.0, 0.5, 3.0], [4.0, 5.0, -0.5, 6.0]])


def test_parts_are_read_by_name_all_rows_at_once():
    x = CAR.view(X)
    np.testing.assert_array_equal(x.position, X[:, :2])
    np.testing.assert_array_equal(x.heading, X[:, 2:3])
    np.testing.assert_array_equal(x[..., 3:], x.speed)
    np.testing.assert_array_equal(2.0 * x - X, X)
    np.testing.assert_array_equal(np.eye(4) @ CAR.view(X[0]), X[0])


def test_a_state_moves_by_the_velocities_of_its_parts():
    x = CAR.view(X)
    whole = CAR.plus(x, velocity=(x.speed * np.ones(2), np.array([0.1, 0.2]), 0.3), dt=2.0)[...]
    expected = X + 2.0 * np.array([[3.0, 3.0, 0.1, 0.3], [6.0, 6.0, 0.2, 0.3]])
    np.testing.assert_allclose(whole, expected)
    some = CAR.plus(x, velocity={"heading": 4.0}, dt=1.0)
    np.testing.assert_allclose(some.heading, [[4.5 - 2.0 * np.pi], [3.5 - 2.0 * np.pi]])
    np.testing.assert_array_equal(some.position, x.position)


def test_parts_are_replaced_by_name():
    new = CAR.view(X).replace(speed=np.array([7.0, 8.0]))
    np.testing.assert_array_equal(new[...], np.c_[X[:, :3], [7.0, 8.0]])


def test_a_start_is_made_by_name():
    start = CAR.gaussian(position=((1.0, 2.0), 3.0), speed=(5.0, 0.5), heading=(0.1, 0.2))
    np.testing.assert_array_equal(start.mean, [1.0, 2.0, 0.1, 5.0])
    np.testing.assert_allclose(np.diag(start.covariance), [9.0, 9.0, 0.04, 0.25])


def test_what_is_no_part_is_refused():
    x = CAR.view(X)
    with pytest.raises(UnknownNameError, match=r"'sped'[\s\S]*heading, position, speed"):
        x.sped  # noqa: B018
    with pytest.raises(UnknownNameError, match="sped"):
        x.replace(sped=1.0)
    with pytest.raises(DeclarationError, match=r"these are not the parts[\s\S]*2 parts"):
        CAR.plus(x, velocity=(x.position, 0.0), dt=1.0)
    with pytest.raises(DeclarationError, match=r"'position' has another number of entries"):
        CAR.plus(x, velocity=(np.ones((2, 3)), 0.0, 0.0), dt=1.0)
    with pytest.raises(DeclarationError, match=r"a function of arrays[\s\S]*x\.position"):
        np.sin(np.asarray(x))
    with pytest.raises(DeclarationError, match=r"a part cannot be called this[\s\S]*'shape'"):
        StateSpace(shape=euclidean(2))
    with pytest.raises(DeclarationError, match="a state space is made of parts"):
        StateSpace(euclidean(2), attitude=quaternion())


def test_a_space_without_names_hands_plain_arrays():
    assert StateSpace(euclidean(4)).view(X) is X
