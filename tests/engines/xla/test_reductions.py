"""Reductions over a short axis of many in XLA: slice by slice they are what they are at once."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.engines.xla import namespace
from flowgraph.engines.xla.namespace import JaxNamespace

jax = pytest.importorskip("jax")

MANY = namespace._MANY
RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("name", ["sum", "prod", "max", "min", "any", "all"])
@pytest.mark.parametrize("keepdims", [False, True])
@pytest.mark.parametrize("axis", [0, -2])
def test_a_short_axis_of_many_gives_what_numpy_gives(name, keepdims, axis):
    x = RANDOM.normal(size=(4, 3, MANY))
    x[1, 2, 5] = np.nan
    for given in (x, x > 0.5, (10 * RANDOM.normal(size=x.shape)).astype(np.int32)):
        if name in ("any", "all"):
            given = given > 0
        elif name in ("max", "min") and given.dtype == bool:
            continue
        with jax.enable_x64(True):
            found = getattr(JaxNamespace(jax), name)(given, axis=axis, keepdims=keepdims)
        expected = getattr(np, name)(given, axis=axis, keepdims=keepdims)
        assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
        np.testing.assert_array_equal(np.asarray(found), expected)


def operations(shape, axis):
    def squares(x):
        return JaxNamespace(jax).sum(x * x, axis=axis)

    return {e.primitive.name for e in jax.make_jaxpr(squares)(np.zeros(shape)).jaxpr.eqns}


def test_only_a_short_axis_of_many_goes_slice_by_slice():
    assert "reduce_sum" not in operations((3, MANY), 0)
    assert "reduce_sum" in operations((3, MANY - 1), 0)
    assert "reduce_sum" in operations((17, MANY), 0)
    assert "reduce_sum" in operations((3, MANY), 1)
    assert "reduce_sum" in operations((3, MANY), None)


def jitted(name, shape, axis):
    xp = JaxNamespace(jax)
    if name in ("max", "min"):
        return lambda x: getattr(xp, name)(1.5 * xp.reshape(x, shape), axis=axis)
    return lambda x: xp.sum(getattr(xp, name)(1.5 * xp.reshape(x, shape), 0.0), axis=axis)


@pytest.mark.parametrize("name", ["max", "min", "maximum", "minimum"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("shape", "axis"), [((9000,), None), ((30, 300), 1), ((300, 30), 0), ((3, 3000), 0)])
def test_an_extreme_of_many_has_the_nan_among_them(name, dtype, shape, axis):
    x = np.arange(9000, dtype=dtype) - 4000.0
    x[7] = np.nan
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(jitted(name, shape, axis))(x))
    assert found.dtype == dtype
    expected = np.isnan(x.reshape(shape)).any(axis=axis)
    np.testing.assert_array_equal(np.isnan(found), expected)
