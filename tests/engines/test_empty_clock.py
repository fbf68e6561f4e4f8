"""Streams at a clock that never ticks: empty in every engine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    Scalar,
    Signal,
    Stream,
    block,
    delay,
    graph,
    integer,
    latest,
    merge,
    periodic,
    real,
    simulate,
    simulate_many,
    when,
    window,
)
from tests.support import ENGINES, MS, scalars


class Pair(Signal):
    x: Array = real(3)
    k: Array = integer()


@block
def split(x: Scalar, z: Scalar | None) -> tuple[Scalar, Scalar | None]:
    if z is None:
        return x + 2.0, None
    return x + z, x + 2.0 * z


@block
def struct(x: Scalar, z: Scalar | None, *, xp: Any) -> tuple[Scalar, Pair | None]:
    if z is None:
        return x, None
    return x, when(z > 0, Pair(xp.stack([x, z, x]), xp.astype(z, xp.int32)))


@block
def total(state: Scalar, x: Scalar | None, z: Scalar | None) -> tuple[Scalar, Scalar]:
    new = state + (0.0 if x is None else x) + (0.0 if z is None else z)
    return new, new


@total.init
def _(*_: Any) -> float:
    return 5.0


def optional(a: Any, never: Any) -> dict[str, Any]:
    p, q = split(never, never)
    return {"p": p, "q": q}


def structs(a: Any, never: Any) -> dict[str, Any]:
    p, q = struct(never, never)
    return {"p": p, "q": q, "x": q.map(lambda s: s.x)}


def merged(a: Any, never: Any) -> dict[str, Any]:
    both = merge(a, never, tie="left")
    return {"both": both, "optional": split(both, never)[0], "never": split(both, never)[1]}


def held(a: Any, never: Any) -> dict[str, Any]:
    memory = delay(1.0, name="memory")
    new = never + memory
    memory.feed(new)
    return {"new": new, "last": latest(never, init=7.0).at(a)}


def collected(a: Any, never: Any) -> dict[str, Any]:
    return {
        "window": window(never, at=a, size=2).map(lambda w: w.count),
        "closed": window(a, at=never, size=9).map(lambda w, *, xp: xp.sum(w.values)),
        "every": never.every(3),
        "odd": never.filter(lambda v: v > 1),
    }


def states(a: Any, never: Any) -> dict[str, Any]:
    return {"never": total(never, never), "some": total(a, never)}


@pytest.mark.parametrize("body", [optional, structs, merged, held, collected, states])
def test_what_never_ticks_is_empty_in_every_engine(body: Any):
    @graph
    def g(a: Stream[Scalar], b: Stream[Scalar]):
        never = latest(b, init=5.0).at(a & b)
        return {**body(a, never), "a": a}

    built = g.build(a=periodic("4ms", phase="2ms"), b=periodic("8ms", phase="4ms"))
    inputs = {"a": scalars(np.array([2, 6, 10]) * MS), "b": scalars([4 * MS])}
    first = simulate(built, inputs)
    for engine in ENGINES[1:]:
        result = simulate(built, inputs, engine=engine)
        assert list(result.series) == list(first.series)
        for name, series in first.series.items():
            assert result[name].time.tolist() == series.time.tolist(), (engine, name)
            for leaf, array in series.leaves.items():
                assert result[name][leaf].tolist() == array.tolist()
                assert result[name][leaf].dtype == array.dtype
        assert len(simulate_many(built, inputs, [1, 2], engine=engine)["a"].time) == 3
    assert len(first.a) == 3
    assert any(len(series) == 0 for series in first.series.values())
