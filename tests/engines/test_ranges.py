"""Operations outside their range: one rule in every engine."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from flowgraph import Array, LoweringError, Signal, Stream, graph, integer, real, simulate
from tests.support import ENGINES

REALS = [
    np.inf,
    -np.inf,
    1e20,
    -1e20,
    2.0**31,
    2.0**32,
    -(2.0**31) - 1,
    2.0**63,
    2.0**64,
    -1.0,
    -0.5,
    -2.5,
    3.7,
]
WHOLE = [0, 1, -1, 7, -7, 2**31 - 1, -(2**31), 5, 31, 32, 64]
LIMITS = {kind: np.iinfo(kind) for kind in ("int32", "int64", "uint32", "uint64")}


class Reals(Signal):
    x: Array = real(len(REALS) + 1)


class Pairs(Signal):
    a: Array = integer(len(WHOLE) ** 2)
    b: Array = integer(len(WHOLE) ** 2)


class Many(Signal):
    a: Array = real(25)
    b: Array = real(25)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def in_every_engine(step: Callable[..., Any], value: Signal) -> dict[str, np.ndarray]:
    @graph
    def one(a: Stream[type(value)]) -> Any:  # type: ignore[valid-type]
        return a.map(step)

    built = one.build()
    batch = type(value)(*(np.asarray(part)[None] for part in vars(value).values()))
    found = {
        engine: simulate(built, {"a": (np.array([0]), batch)}, engine=engine, diverged="count").output.value[
            0
        ]
        for engine in ENGINES
    }
    for engine, got in found.items():
        assert got.dtype == found["python"].dtype, engine
        np.testing.assert_array_equal(got, found["python"], err_msg=engine)
    return found


@pytest.mark.parametrize("kind", LIMITS)
def test_reals_become_the_nearest_whole_number_and_nan_becomes_0(kind: str) -> None:
    def step(s: Reals, *, xp: Any) -> Any:
        inputs = xp.where(s.x == 12345.0, xp.nan, s.x)  # an infinity cannot be an input
        edges = xp.where(inputs == 1.5, xp.inf, xp.where(inputs == -1.5, -xp.inf, inputs))
        return xp.astype(edges, getattr(xp, kind))

    given = [1.5 if x == np.inf else -1.5 if x == -np.inf else x for x in REALS]
    found = in_every_engine(step, Reals(np.array([*given, 12345.0])))["python"]
    low, high = int(LIMITS[kind].min), int(LIMITS[kind].max)
    right = [high if x == np.inf else low if x == -np.inf else min(max(int(x), low), high) for x in REALS]
    assert found.tolist() == [*right, 0]


def test_what_is_known_when_a_step_is_recorded_follows_the_same_rule() -> None:
    def step(s: Reals, *, xp: Any) -> Any:
        return xp.astype(s.x, xp.int32) * 0 + xp.astype(xp.asarray([1e20] * 14), xp.int32)

    found = in_every_engine(step, Reals(np.zeros(len(REALS) + 1)))["python"]
    assert (found == 2**31 - 1).all()


@pytest.mark.parametrize("name", ["floordiv", "mod"])
def test_whole_numbers_divided_by_0_are_0(name: str) -> None:
    a, b = (np.array(x, np.int32).ravel() for x in np.meshgrid(WHOLE, WHOLE, indexing="ij"))
    of = getattr(operator, name)
    found = in_every_engine(lambda s: of(s.a, s.b), Pairs(a, b))["python"]
    assert (found[b == 0] == 0).all()
    sound = (b != 0) & ~((a == -(2**31)) & (b == -1))
    assert found[sound].tolist() == [of(int(x), int(y)) for x, y in zip(a[sound], b[sound], strict=True)]


@pytest.mark.parametrize("name", ["lshift", "rshift"])
def test_shifts_by_all_bits_or_more_leave_0_or_the_sign(name: str) -> None:
    a, b = (np.array(x, np.int32).ravel() for x in np.meshgrid(WHOLE, WHOLE, indexing="ij"))
    found = in_every_engine(lambda s: getattr(operator, name)(s.a, s.b), Pairs(a, b))["python"]
    beyond = (b < 0) | (b >= 32)
    right = np.where((name == "rshift") & (a < 0), -1, 0)
    assert (found[beyond] == right[beyond]).all()


@pytest.mark.parametrize("name", ["floordiv", "mod"])
def test_reals_rounded_down_at_infinity_and_at_0(name: str) -> None:
    values = [0.0, 1.5, -2.5, 7.0, -1e300]

    def step(s: Many, *, xp: Any) -> Any:
        b = xp.where(s.b == 7.0, xp.inf, xp.where(s.b == 1.5, -xp.inf, s.b))
        return getattr(operator, name)(s.a, b)

    a, b = (x.ravel() for x in np.meshgrid(values, values, indexing="ij"))
    found = in_every_engine(step, Many(a, b))["python"]
    if name == "floordiv":
        assert found[(a == -2.5) & (b == 7.0)] == -1.0
        assert found[(a == 1.5) & (b == 7.0)] == 0.0
        assert found[(a == 1.5) & (b == 0.0)] == np.inf


def test_a_constant_below_the_normal_numbers_is_refused() -> None:
    def tiny(s: Many) -> Any:
        return s.a / (s.a + 1e-310)

    @graph
    def one(a: Stream[Many]) -> Any:
        return a.map(tiny)

    with pytest.raises(LoweringError) as error:
        one.build()
    assert "a constant is smaller than the normal numbers" in str(error.value)
    assert __name__ in str(error.value.path)
