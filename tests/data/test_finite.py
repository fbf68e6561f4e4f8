"""Whether all entries of an array are numbers."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from flowgraph.data.finite import finite


@given(arrays(st.sampled_from([np.float32, np.float64]), array_shapes(min_side=0, max_dims=3)), st.booleans())
def test_it_is_what_each_entry_is(array, turned):
    """Of numbers whose squares no float holds too, and of arrays that do not lie in one piece."""
    array = array.T if turned else array[..., ::2]
    with warnings.catch_warnings(), np.errstate(all="raise"):
        warnings.simplefilter("error")
        assert finite(array) == bool(np.isfinite(array).all())


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 12_345, 99_999])
def test_one_among_many_is_found(wrong, place):
    array = np.full(100_000, 1e200)
    assert finite(array)
    array[place] = wrong
    assert not finite(array)


def test_numbers_with_squares_below_all_others_are_finite_for_one_who_wants_errors_of_them():
    with np.errstate(all="raise"):
        assert finite(np.full(3, 1e-200))
        assert not finite(np.array([1e-200, np.nan]))


def test_other_kinds_are_always_finite():
    assert finite(np.array([2**62, -1]))
    assert finite(np.array([True, False]))
    assert finite(np.float64(1.0))
    assert not finite(np.float64("nan"))
