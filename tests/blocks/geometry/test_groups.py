"""Rigid motions as parts of a state: what goes out comes back, and the exponential is that of the matrix."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.blocks.geometry import SE, SE_2, SO, Quaternion, StateSpace
from flowgraph.blocks.unscented import SigmaPoints

GROUPS = {
    "SO(2)": SO(2),
    "SO(3)": SO(3),
    "SE(2)": SE(2),
    "SE(3)": SE(3),
    "SE(3) world": SE(3, error="world"),
    "SE_2(3)": SE_2(3),
    "SE_2(3) world": SE_2(3, error="world"),
}


def somewhere(space, rng, n=20):
    return space.plus(np.broadcast_to(space.rest, (n, space.size)), rng.normal(size=(n, space.tangent)), np)


@pytest.mark.parametrize("name", GROUPS)
@pytest.mark.parametrize("length", [1e-6, 0.0999, 0.1001, 1.0, 3.0])
def test_minus_undoes_plus(name, length):
    rng, space = np.random.default_rng(0), StateSpace(GROUPS[name])
    x, d = somewhere(space, rng), rng.normal(size=(20, space.tangent))
    d *= length / np.linalg.norm(d, axis=-1, keepdims=True)
    np.testing.assert_allclose(
        space.minus(space.plus(x, d, np), x, np), d, rtol=0, atol=1e-13 + 1e-11 * length
    )


def matrix(kind: str, d: np.ndarray) -> np.ndarray:
    """The element of the Lie algebra, as a matrix."""
    if kind == "SE(2)":
        return np.array([[0.0, -d[2], d[0]], [d[2], 0.0, d[1]], [0.0, 0.0, 0.0]])
    vectors, (a, b, c) = d[:-3].reshape(-1, 3), d[-3:]
    made = np.zeros((3 + len(vectors),) * 2)
    made[:3, :3] = [[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]
    made[:3, 3:] = vectors.T
    return made


@pytest.mark.parametrize("kind", ["SE(2)", "SE(3)", "SE_2(3)"])
def test_a_move_from_rest_is_the_exponential_of_the_matrix(kind):
    d = np.random.default_rng(1).normal(size=GROUPS[kind].tangent)
    x, whole = GROUPS[kind].plus(GROUPS[kind].rest, d, np), expm(matrix(kind, d))
    rows = 2 if kind == "SE(2)" else 3
    np.testing.assert_allclose(x[: rows * (whole.shape[1] - rows)], whole[:rows, rows:].T.ravel(), atol=1e-14)


@pytest.mark.parametrize("name", ["SE(2)", "SE(3)", "SE(3) world", "SE_2(3)", "SE_2(3) world", "SO(3)"])
def test_the_reset_is_the_change_of_the_error_to_first_order(name):
    rng, space, h = np.random.default_rng(2), StateSpace(GROUPS[name]), 1e-6
    x = somewhere(space, rng, 1)[0]
    for size in (1e-2, 1e-1):
        d = size * rng.normal(size=space.tangent)
        after = space.plus(x, d, np)
        moved = [
            (space.minus(space.plus(x, d + h * e, np), after, np)
             - space.minus(space.plus(x, d - h * e, np), after, np)) / (2 * h)
            for e in np.eye(space.tangent)
        ]  # fmt: skip
        found = space.reset(d, np)
        assert found is not None
        assert np.abs(np.stack(moved, axis=-1) - found).max() < 2.0 * np.dot(d, d)


@pytest.mark.parametrize("name", [n for n, p in GROUPS.items() if not isinstance(p, Quaternion)])
def test_the_mean_of_points_leaves_no_deviation(name):
    space, rng = StateSpace(GROUPS[name]), np.random.default_rng(3)
    points = SigmaPoints(1.0, 0.0, 0.0)
    x = somewhere(space, rng, 1)[0]
    apart = 0.4 * rng.normal(size=(2 * space.tangent, space.tangent))
    images = np.concatenate([x[None, :], space.plus(x[None, :], apart, np)])
    scale = points.scale(space.tangent)
    mean = points.cluster(images, space, scale, np).mean
    assert np.abs(space.minus(images[1:], mean[None, :], np).mean(axis=0)).max() < 1e-9


def test_what_is_not_there_is_refused():
    with pytest.raises(DeclarationError, match=r"there is no such group here[\s\S]*SE_2\(2\)"):
        SE_2(2)
    with pytest.raises(UnknownNameError, match="SE.error"):
        SE(2, error="world")


def test_the_parts_of_a_group_have_names():
    space = StateSpace(body=SE_2(3))
    x = space.view(np.arange(20.0).reshape(2, 10))
    np.testing.assert_array_equal(x.body.velocity, [[3.0, 4.0, 5.0], [13.0, 14.0, 15.0]])
    with pytest.raises(UnknownNameError, match="velocit"):
        x.body.velocit  # noqa: B018
