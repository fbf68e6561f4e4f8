"""Normal draws: ours, which are the same in every engine, beside those of JAX and NumPy.

In XLA the draws of a tick are taken in a scan and added to what it carries, as a particle filter does: there
a compiler may fuse them with what uses them, and does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.random import Site, seed_words
from tests.bench.rows import Row, interleaved, seconds

PERIOD_NS = 5_000_000
SEED = 7


def check(draws: np.ndarray, who: str) -> None:
    """Fail unless the sums of `draws` (3, n) over many ticks look like sums of standard normal numbers."""
    count = draws.size
    assert abs(draws.mean()) < 6.0 / np.sqrt(count), who
    assert abs(draws.var() - 1.0) < 6.0 * np.sqrt(2.0 / count), who


def in_xla(*, ticks: int = 2000, particles: int = 1000, repeats: int = 15) -> list[Row]:
    """Microseconds a tick of 3 normals a particle in a compiled scan."""
    import jax
    import jax.numpy as jnp

    from flowgraph.engines.xla.namespace import JaxNamespace

    shape = (3, particles)
    site = Site("bench", "normal", shape)
    xp = JaxNamespace(jax)
    key = jax.random.key(SEED)

    def ours(time: Any, words: Any) -> Any:
        return xp.materialise(site.numbers(time, words, xp=xp))  # as the XLA engine does

    def theirs(dtype: Any) -> Callable[[Any, Any], Any]:
        return lambda time, words: jax.random.normal(jax.random.fold_in(key, time), shape, dtype)

    def scan(draw: Callable[[Any, Any], Any], dtype: Any) -> Callable[[], np.ndarray]:
        step = lambda words, total, time: (total + draw(time, words), None)
        play = jax.jit(
            lambda total, words, time: jax.lax.scan(lambda c, t: step(words, c, t), total, time)[0]
        )
        words = seed_words(SEED)
        time = np.arange(ticks, dtype=np.int64) * PERIOD_NS

        def run() -> np.ndarray:
            with jax.enable_x64(True):
                return np.asarray(play(jnp.zeros(shape, dtype), words, time))

        return run

    mine = scan(ours, np.float64)
    wanted = np.zeros(shape)
    for tick in range(ticks):
        wanted += site.numbers(tick * PERIOD_NS, seed_words(SEED), xp=NUMPY)
    np.testing.assert_array_equal(mine(), wanted)
    rows = []
    for dtype in (np.float64, np.float32):
        name = np.dtype(dtype).name
        peer = scan(theirs(dtype), dtype)
        check(peer() / np.sqrt(ticks), f"jax.random, {name}")
        cost = lambda work: lambda: seconds(work) * 1e6 / ticks
        figures = interleaved(cost(mine), cost(peer), repeats)
        met = figures[2] <= 1.0
        rows.append(
            Row(
                f"{3 * particles:,} normals, xla",
                *figures[:2],
                "us/tick",
                f"jax.random.normal, {name}",
                figures[2],
                *(("ratio <= 1", met) if dtype is np.float64 else ()),
            )
        )
    check(wanted / np.sqrt(ticks), "ours")
    return rows


def in_numpy(*, ticks: int = 200, particles: int = 1000, repeats: int = 15) -> list[Row]:
    """Microseconds a tick of 3 normals a particle in NumPy; the peer only goes on with its one stream."""
    shape = (3, particles)
    site = Site("bench", "normal", shape)
    words = seed_words(SEED)
    generator = np.random.Generator(np.random.Philox(SEED))

    def ours() -> None:
        for tick in range(ticks):
            site.numbers(tick * PERIOD_NS, words, xp=NUMPY)

    def peer() -> None:
        for _ in range(ticks):
            generator.standard_normal(shape)

    check(site.numbers(0, words, xp=NUMPY), "ours")
    check(generator.standard_normal(shape), "numpy.random.Philox")
    cost = lambda work: lambda: seconds(work) * 1e6 / ticks
    mine, theirs, ratio = interleaved(cost(ours), cost(peer), repeats)
    against = "numpy Generator(Philox).standard_normal"
    return [Row(f"{3 * particles:,} normals, python", mine, theirs, "us/tick", against, ratio)]
