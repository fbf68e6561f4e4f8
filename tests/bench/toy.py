"""The smallest graph with two rates, against the libraries that somebody might write it in instead.

A at 200 Hz -> 2x + 1, B at 40 Hz -> x + 0.5; at each A, the sum with the latest B, collected.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import add
from typing import Any

import numpy as np

from flowgraph import (
    Graph,
    Scalar,
    Series,
    Stream,
    apply,
    graph,
    latest,
    periodic,
    scan,
    simulate,
    take_while,
)
from tests.bench.rows import Row, interleaved, seconds

PERIOD_NS, EVERY = 5_000_000, 5


@graph
def toy(a: Stream[Scalar], b: Stream[Scalar]):
    """The sum of two mapped sensors at the faster one."""
    held = latest(b.map(lambda x: x + 0.5), init=0.0)
    return {"sum": a.map(lambda x: 2.0 * x + 1.0) + held}


def build() -> Graph:
    return toy.build(a=periodic(PERIOD_NS), b=periodic(EVERY * PERIOD_NS))


def recording(ticks: int) -> dict[str, Series]:
    """`ticks` events of A, and B at each fifth of them."""
    time = np.arange(ticks, dtype=np.int64) * PERIOD_NS
    a, b = np.sin(np.arange(ticks) * 0.01), np.cos(np.arange(0, ticks, EVERY) * 0.003)
    return {"a": Series(time, a, name="a"), "b": Series(time[::EVERY], b, name="b")}


def with_reactivex(events: list[tuple[bool, float]]) -> list[float]:
    """The same in ReactiveX: events in time order, (whether from B, value), B first at ties."""
    from reactivex import Subject, operators

    ops: Any = operators
    a: Any = Subject()
    b: Any = Subject()
    held = b.pipe(ops.map(lambda x: x + 0.5), ops.start_with(0.0))
    found: list[float] = []
    sums = a.pipe(ops.map(lambda x: 2.0 * x + 1.0), ops.with_latest_from(held), ops.starmap(add))
    sums.subscribe(found.append)
    push_a, push_b = a.on_next, b.on_next
    for from_b, value in events:
        if from_b:
            push_b(value)
        else:
            push_a(value)
    return found


def in_order(inputs: dict[str, Series]) -> list[tuple[bool, float]]:
    """The events of a recording as ReactiveX takes them."""
    a, b = inputs["a"]["value"].tolist(), inputs["b"]["value"].tolist()
    events = []
    for k, value in enumerate(a):
        if k % EVERY == 0:
            events.append((True, b[k // EVERY]))
        events.append((False, value))
    return events


def with_scan(ticks: int, inputs: dict[str, Series]) -> Callable[[], np.ndarray]:
    """The same as a hand-written `jax.lax.scan`: compiled, from NumPy arrays to a NumPy array."""
    import jax
    import jax.numpy as jnp

    a, b, present = inputs["a"]["value"], np.zeros(ticks), np.zeros(ticks, dtype=bool)
    b[::EVERY], present[::EVERY] = inputs["b"]["value"], True

    def step(held: Any, x: Any) -> Any:
        a, b, present = x
        held = jnp.where(present, b + 0.5, held)
        return held, 2.0 * a + 1.0 + held

    scan = jax.jit(lambda *columns: jax.lax.scan(step, jnp.float64(0.0), columns))

    def run() -> np.ndarray:
        with jax.enable_x64(True):
            return np.asarray(scan(a, b, present)[1])

    return run


def python_engine(*, ticks: int = 10_000, repeats: int = 15) -> list[Row]:
    """Source events a second in the Python engine and in ReactiveX, building and set-up included.

    ReactiveX is handed its events as Python floats already merged in time order; ours merges and checks them.
    """
    inputs = recording(ticks)
    events = in_order(inputs)
    ours = lambda: simulate(build(), inputs)
    np.testing.assert_array_equal(ours()["sum"]["value"], with_reactivex(events))
    rate = lambda work: lambda: len(events) / seconds(work) * 1e-6
    speed, peer, ratio = interleaved(rate(ours), rate(lambda: with_reactivex(events)), repeats)
    unit = "million events/s"
    rows = [Row("toy, python", speed, peer, unit, "reactivex Subjects", ratio, "ratio >= 4", ratio >= 4.0)]
    return rows + chain_of_operations(ticks=ticks, repeats=repeats)


@graph
def chain(a: Stream[Scalar]):
    """A chain of stream operations: map, filter, scan, take_while, and each value less the last."""
    mapped = a.map(lambda x: 2.0 * x + 1.0).filter(lambda x: x > 0.0)
    folded = scan(mapped, lambda total, x: 0.9 * total + x, init=0.0)
    before = folded.delay(0.0)
    return {"out": take_while(apply(lambda x, y: x - y, folded, before), lambda x: x < 1e6)}


def chain_in_reactivex(values: list[float]) -> list[float]:
    """The same chain in ReactiveX, fed value by value."""
    from reactivex import Subject, operators

    ops: Any = operators
    source: Any = Subject()
    found: list[float] = []
    steps = source.pipe(
        ops.map(lambda x: 2.0 * x + 1.0),
        ops.filter(lambda x: x > 0.0),
        ops.scan(lambda total, x: 0.9 * total + x, 0.0),
        ops.start_with(0.0),
        ops.pairwise(),
        ops.map(lambda pair: pair[1] - pair[0]),
        ops.take_while(lambda x: x < 1e6),
    )
    steps.subscribe(found.append)
    for value in values:
        source.on_next(value)
    return found


def chain_of_operations(*, ticks: int, repeats: int) -> list[Row]:
    """Source events a second of a chain of stream operations, building and set-up included."""
    series = recording(ticks)["a"]
    values = series["value"].tolist()
    ours = lambda: simulate(chain.build(a=periodic(PERIOD_NS)), {"a": series})
    np.testing.assert_array_equal(ours()["out"]["value"], chain_in_reactivex(values))
    rate = lambda work: lambda: ticks / seconds(work) * 1e-6
    speed, peer, ratio = interleaved(rate(ours), rate(lambda: chain_in_reactivex(values)), repeats)
    name, unit = "chain of stream operations, python", "million events/s"
    return [Row(name, speed, peer, unit, "reactivex Subjects", ratio, "ratio >= 1", ratio >= 1.0)]


def xla_engine(*, ticks: int = 1_000_000, repeats: int = 15) -> list[Row]:
    """Ticks a second in XLA after compilation, of the compiled loop and of the whole `simulate` call."""
    inputs, built = recording(ticks), build()
    scan = with_scan(ticks, inputs)
    first = simulate(built, inputs, engine="xla")
    np.testing.assert_allclose(first["sum"]["value"], scan(), rtol=0.0, atol=1e-12)
    rate = lambda time: ticks / time * 1e-6
    loop = lambda: rate(simulate(built, inputs, engine="xla").wall_s)
    call = lambda: rate(seconds(lambda: simulate(built, inputs, engine="xla")))
    peer = lambda: rate(seconds(scan))
    unit, against = "million ticks/s", "hand-written lax.scan"
    ours, theirs, ratio = interleaved(loop, peer, repeats)
    rows = [Row("toy, xla: loop", ours, theirs, unit, against, ratio, "ratio >= 1.3", ratio >= 1.3)]
    ours, theirs, ratio = interleaved(call, peer, repeats)
    return [
        *rows,
        Row("toy, xla: whole call", ours, theirs, unit, against, ratio, "ratio >= 0.8", ratio >= 0.8),
    ]
