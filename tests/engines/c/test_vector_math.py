"""Functions for loops and lanes against those of math.h: numbers of every size, and those that are none."""

from __future__ import annotations

import ctypes
import math
import shutil
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowgraph.engines.c.compile import LANES, LOOPS, load
from flowgraph.engines.c.helpers import helper_text
from flowgraph.engines.c.lanes.source import PRELUDE, WIDTH
from flowgraph.engines.c.preamble import MACROS

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")

NAMES = ("exp", "log", "sin", "cos", "atan2")
KINDS = {
    "double": (np.float64, ctypes.c_double),
    "float": (np.float32, ctypes.c_float),
    "fg_real": (np.float64, None),
}
FARTHEST = {"double": 1.6e6, "float": 1e5, "fg_real": 1.6e6}
SIZES = (
    *(0.0, 1.0, math.inf, 5e-324, 2.2e-308, 1e-45, 1e-40, 3.4e38, 1.7e308, 708.0, 709.78, 709.9, 745.0),
    *(746.0, 87.0, 88.7, 88.8, 103.0, 1e5, 1.1e5, 1.6e6, 1.7e6, 1e22, math.pi, math.pi / 2, math.pi / 4),
    *(math.tan(math.pi / 8), 1.0 + 2.0**-52, 1.0 - 2.0**-53, math.sqrt(2.0)),
)
EDGES = (math.nan, *SIZES, *(-x for x in SIZES))


@cache
def library(kind: str) -> Any:
    """Each function over an array, the second argument of `atan2` in another."""
    lanes = kind == "fg_real"
    made = [f"fg_lanes_{n}" if lanes else f"fg_{n}" for n in NAMES]
    width = WIDTH if lanes else 1
    lines = [
        "#include <math.h>",
        "#include <stdbool.h>",
        "#include <stddef.h>",
        "#include <stdint.h>",
        MACROS,
    ]
    lines += [PRELUDE] if lanes else []
    lines.append(helper_text(made, "double" if lanes else kind))
    for name, called in zip(NAMES, made, strict=True):
        call = f"{called}(x[k], y[k])" if name == "atan2" else f"{called}(x[k])"
        lines.append(
            f"void {name}_all(const {kind} *x, const {kind} *y, {kind} *out, int64_t n)\n"
            f"{{ (void)y; for (int64_t k = 0; k < n / {width}; k++) out[k] = {call}; }}"
        )
    return load({"math_of_loops.c": "\n".join(lines) + "\n"}, LANES if lanes else LOOPS)


def computed(kind: str, name: str, x: Any, y: Any = 0.0) -> np.ndarray:
    dtype = KINDS[kind][0]
    size = -(-len(np.atleast_1d(x)) // WIDTH) * WIDTH
    arrays = []
    for given_ in (x, y, 0.0):
        whole = np.zeros(8 * size + 64, np.uint8)
        start = -whole.ctypes.data % 64
        array = whole[start : start + size * np.dtype(dtype).itemsize].view(dtype)
        array[: len(np.atleast_1d(x))] = given_
        arrays.append(array)
    places = [ctypes.c_void_p(a.ctypes.data) for a in arrays]
    getattr(library(kind), f"{name}_all")(*places, ctypes.c_int64(size))
    return arrays[2][: len(np.atleast_1d(x))].copy()


def compare(kind: str, name: str, x: np.ndarray, y: np.ndarray | None = None) -> None:
    """Within 3 units in the last place of NumPy's in higher precision; alike where that is not finite."""
    dtype: Any = KINDS[kind][0]
    x = x.astype(dtype)
    wide = x.astype(np.longdouble)
    with np.errstate(all="ignore"):
        if y is None:
            want = getattr(np, name)(wide).astype(dtype)
            found = computed(kind, name, x)
        else:
            y = y.astype(dtype)
            want = np.arctan2(wide, y.astype(np.longdouble)).astype(dtype)
            found = computed(kind, name, x, y)
        if name in ("sin", "cos"):
            want[~(np.abs(x) <= FARTHEST[kind])] = np.nan
        if name == "exp":  # what is too small to be a full number is 0
            want[np.abs(want) < 2.0 * np.finfo(dtype).tiny] = 0.0
            found[np.abs(found) < 2.0 * np.finfo(dtype).tiny] = 0.0
        special = ~np.isfinite(want)
        np.testing.assert_array_equal(found[special], want[special])
        unit = np.maximum(np.spacing(np.abs(want[~special])), np.finfo(dtype).tiny)
        if name in ("sin", "cos"):  # near a multiple of a quarter turn the argument's own unit counts
            unit = np.maximum(unit, np.finfo(dtype).eps * 2.0**-11)
        off = np.abs(found[~special].astype(np.longdouble) - want[~special]) / unit
    assert off.size == 0 or off.max() <= 3.0, (name, x[~special][off.argmax()], off.max())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_edges(kind, name):
    with np.errstate(over="ignore"):
        x = np.array(EDGES, KINDS[kind][0])
    if name != "atan2":
        compare(kind, name, x)
    else:
        compare(kind, name, *(g.ravel() for g in np.meshgrid(x, x)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_many_of_every_size(kind, name):
    draw = np.random.default_rng(3)
    lowest, highest = (-300.0, 300.0) if kind != "float" else (-37.0, 37.0)
    size = 10.0 ** draw.uniform(lowest, highest, 20_000) * draw.choice([-1.0, 1.0], 20_000)
    near = draw.uniform(-1.0, 1.0, 20_000) * 10.0 ** draw.integers(0, 6, 20_000)
    x = np.concatenate([size, near])
    if name != "atan2":
        compare(kind, name, x)
    else:
        y = draw.permutation(x)
        compare(kind, name, x, y)
        compare(kind, name, near, near * draw.uniform(0.3, 3.0, len(near)))


@pytest.mark.parametrize("kind", KINDS)
@given(x=st.lists(st.floats(), min_size=1, max_size=9), data=st.data())
def test_any_number(kind, x, data):
    y = data.draw(st.lists(st.floats(), min_size=len(x), max_size=len(x)))
    with np.errstate(over="ignore"):
        a, b = (np.array(v).astype(KINDS[kind][0]) for v in (x, y))
    for name in NAMES[:-1]:
        compare(kind, name, a)
    compare(kind, "atan2", a, b)
