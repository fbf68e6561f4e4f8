"""NumPy's functions by a shorter way: what they give, and of which kind, is NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.recorder import namespaces, ranges
from flowgraph.recorder.namespaces import NUMPY

GIVEN = [
    np.array([True, False, True]),
    np.array([3, 1, 2], np.int32),
    np.array([3, 1, 2], np.uint32),
    np.arange(6.0).reshape(2, 3),
    np.ones(4, np.float32),
    np.zeros((0,)),
]


@pytest.mark.parametrize("x", GIVEN, ids=lambda x: f"{x.dtype}{x.shape}")
@pytest.mark.parametrize("more", [{}, {"axis": 0}, {"axis": -1, "dtype": np.float64}])
def test_sums_are_those_of_numpy(x, more):
    for keepdims in (False, True):
        found, wanted = NUMPY.sum(x, keepdims=keepdims, **more), np.sum(x, keepdims=keepdims, **more)
        assert type(found) is type(wanted)
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)
    if x.ndim == 1 or "axis" in more:
        found, wanted = NUMPY.cumulative_sum(x, **more), np.cumulative_sum(x, **more)
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)
        more = {**more, "include_initial": True}
        np.testing.assert_array_equal(NUMPY.cumulative_sum(x, **more), np.cumulative_sum(x, **more))
    else:
        with pytest.raises(ValueError, match="axis"):
            NUMPY.cumulative_sum(x)


@pytest.mark.parametrize("side", ["left", "right"])
def test_places_are_those_of_numpy(side):
    ends, values = [1, 2, 2, 5], np.array([[0, 2], [5, 9]])
    found = NUMPY.searchsorted(ends, values, side=side)
    np.testing.assert_array_equal(found, np.searchsorted(ends, values, side=side))
    assert NUMPY.searchsorted(np.array(ends), 2, side=side) == np.searchsorted(ends, 2, side=side)


@pytest.mark.parametrize("kind", ["int32", "uint32", "int64", "uint64"])
@pytest.mark.parametrize("real", ["float32", "float64"])
def test_reals_become_whole_numbers_without_a_word(kind, real):
    """Many small ones, which are told by their squares, and each that does not fit, wherever it stands."""
    ends = np.iinfo(kind)
    edges = (-1.0, 2.0**31, -(2.0**31), 2.0**62, 2.0**63, -(2.0**63), 2.0**64, 1e30, -1e300)
    for one in (np.nan, np.inf, -np.inf, *edges):
        with np.errstate(over="ignore"):
            x = np.array([[0.5, 3.7], [one, 2.0]], real)
        with np.errstate(all="raise"):
            found = ranges.cast(np, x, kind)
        number = float(x[1, 0])
        exact = int(number) if np.isfinite(number) else number
        want = 0 if exact != exact else min(max(exact, int(ends.min)), int(ends.max))
        assert found.dtype == kind
        assert [int(v) for v in found.ravel()] == [0, 3, want, 2], (one, kind)


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("lead", [(), (3,), (0,), (2, 3)])
def test_factors_are_those_of_numpy_and_nan_where_it_refuses(monkeypatch, direct, real, lead):
    """By whichever way NumPy is called, also with an old one's: one matrix in a stack spoils no other."""
    if not direct:
        monkeypatch.setattr(namespaces, "_LAPACK", None)
    random = np.random.default_rng(0)
    root = random.normal(size=(*lead, 4, 4))
    good = (root @ root.mT + np.eye(4)).astype(real)
    b = random.normal(size=(*lead, 4, 2)).astype(real)
    bad = good.copy()
    if bad.size:
        bad[(0,) * len(lead)] = 0.0
    with np.errstate(all="raise"):
        for a in (good, good.mT):
            for found, wanted in (
                (NUMPY.linalg.cholesky(a), np.linalg.cholesky(a)),
                (NUMPY.linalg.solve(a, b), np.linalg.solve(a, b)),
                (NUMPY.linalg.solve(a, b[..., :1]), np.linalg.solve(a, b[..., :1])),
            ):
                assert found.dtype == real
                np.testing.assert_array_equal(found, wanted)
        for found, whole in (
            (NUMPY.linalg.cholesky(bad), NUMPY.linalg.cholesky(good)),
            (NUMPY.linalg.solve(bad, b), NUMPY.linalg.solve(good, b)),
        ):
            spoilt = np.isnan(found).all((-2, -1))
            assert spoilt.sum() == min(1, spoilt.size)
            np.testing.assert_array_equal(found[~spoilt], whole[~spoilt])
        if not lead:
            np.testing.assert_array_equal(NUMPY.linalg.solve(good, b[:, 0]), np.linalg.solve(good, b[:, 0]))
            assert np.isnan(NUMPY.linalg.solve(bad, b[:, 0])).all()


@pytest.mark.parametrize(
    "condition", [True, np.False_, np.array(True), np.array([True, False, True]), [True, False, True]]
)
def test_a_selection_is_that_of_numpy(condition):
    whole = np.arange(12.0).reshape(4, 3)
    turned = whole.mT
    one = (2.0, 2, True, np.float64(3.0), np.array(4.0))
    given = (whole, -whole, whole[0], np.arange(3, dtype=np.int32), *one)
    for x in given:
        for y in given:
            found, wanted = NUMPY.where(condition, x, y), np.where(condition, x, y)
            assert found.dtype == wanted.dtype
            np.testing.assert_array_equal(found, wanted)
    if not np.ndim(condition):
        assert NUMPY.where(condition, turned, turned) is turned
