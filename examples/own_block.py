"""A block of your own, with state and with an output that has a clock of its own.

`running` keeps the mean and the spread of all values so far (Welford 1962). The mean is there for every
value; the standard deviation exists from the second value on, so that output is marked `| None` and
returned with `when(...)`.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Array, Scalar, Signal, Stream, block, graph, integer, lower, real, simulate, when


class Tally(Signal):
    """How many values there were, their mean, and the sum of squared distances from it."""

    count: Array = integer()
    mean: Array = real()
    squares: Array = real()


@block
def running(seen: Tally, x: Scalar, *, xp) -> tuple[Tally, tuple[Scalar, Scalar | None]]:
    """The mean of all values so far, and their standard deviation where there are two or more."""
    count = seen.count + 1
    step = x - seen.mean
    mean = seen.mean + step / count
    squares = seen.squares + step * (x - mean)
    spread = xp.sqrt(squares / xp.maximum(count - 1, 1))
    return Tally(count=count, mean=mean, squares=squares), (mean, when(count >= 2, spread))


@running.init
def _(x) -> Tally:
    return Tally(count=np.int32(0), mean=0.0, squares=0.0)


@graph
def statistics(x: Stream[Scalar]):
    """Mean and standard deviation of a stream, as they come in."""
    mean, spread = running(x)
    return {"mean": mean, "spread": spread}


def main() -> None:
    built = statistics.build()
    values = np.random.default_rng(1).normal(20.0, 3.0, 1000)
    result = simulate(built, {"x": (np.arange(1000) * 10**9, values)})
    print(built.text())
    print(f"{len(result.mean)} means, {len(result.spread)} standard deviations")
    print(f"after the last value: {result.mean.value[-1]:.3f} +- {result.spread.value[-1]:.3f}")
    print(lower(built))


if __name__ == "__main__":
    main()
