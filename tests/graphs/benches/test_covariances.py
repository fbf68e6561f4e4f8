"""`bench covariances`: correlations need fewer bits than elements, and scaled states as many."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DeclarationError
from flowgraph.graphs.benches.covariances import _FORMS, covariances
from flowgraph.pipeline.formats import fraction_for


@pytest.mark.parametrize("form", sorted(_FORMS))
def test_a_form_gives_the_covariance_again(form):
    L = np.tril(np.random.default_rng(1).normal(size=(5, 5)))
    split, join = _FORMS[form]
    np.testing.assert_allclose(join(*split(L @ L.T)), L @ L.T, atol=1e-12)


def test_correlations_need_fewer_bits():
    (narrow, wide) = covariances(bits="20, 40", duration=2.0).rows
    assert narrow["correlations_m"] < 0.5 * narrow["covariance_m"]
    assert all(v < 1e-6 for k, v in wide.items() if k != "bits")


def test_states_that_are_scaled_by_powers_of_two_have_the_same_words():
    P = np.abs(np.random.default_rng(2).normal(size=(4, 4))) + 0.1
    scale = 2.0 ** np.array([3, -2, 0, 5])
    over = scale[:, None] * scale
    a, b = (
        np.ldexp(P, fraction_for(P, 20).astype(int)),
        np.ldexp(P * over, fraction_for(P * over, 20).astype(int)),
    )
    np.testing.assert_array_equal(a, b)


def test_what_is_no_number_of_bits_is_refused():
    with pytest.raises(
        DeclarationError, match=r"(?s)covariances.bits: these are no whole numbers.*--set bits"
    ):
        covariances(bits="few", duration=1.0)
