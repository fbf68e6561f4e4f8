"""A sensor of your own: a signal type, a generator of events with their noise, and a filter that reads it.

A sonar looks down from a hovering drone. Its period jitters, its readings are noisy, and one in ten is an
echo that is far too long. A generator yields `(time in ns, value)` in order; each event is checked as it
comes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flowgraph import Array, Signal, Stream, aperiodic, block, collect, delay, graph, real, simulate

NOISE = 0.05  # m, standard deviation of one reading


class Range(Signal):
    """The distance to the ground below."""

    distance: Array = real(unit="m")


class Height(Signal):
    """A Gaussian belief about the height: mean and variance."""

    mean: Array = real(unit="m")
    variance: Array = real(unit="m^2")


def sonar(height: float, *, events: int, seed: int) -> Iterator[tuple[int, Range]]:
    """Readings about 50 ms apart, never closer than 45 ms."""
    random = np.random.default_rng(seed)
    time = 0
    for _ in range(events):
        echo = 8.0 if random.random() < 0.1 else 0.0
        yield time, Range(distance=height + echo + NOISE * random.standard_normal())
        time += round(random.uniform(45e6, 55e6))


@block
def average(belief: Height, reading: Range, *, noise: float) -> Height:
    """Kalman update of a constant with one reading of standard deviation `noise`."""
    gain = belief.variance / (belief.variance + noise**2)
    return Height(
        mean=belief.mean + gain * (reading.distance - belief.mean), variance=(1.0 - gain) * belief.variance
    )


@graph
def altimeter(sonar: Stream[Range], *, longest: float):
    """The height, from all readings that are not too long."""
    plausible = sonar.filter(lambda reading: reading.distance < longest, name="plausible")
    belief = delay(Height(mean=0.0, variance=100.0), name="belief")
    height = average(belief, plausible, noise=NOISE)
    belief.feed(height)
    collect(plausible, "plausible")
    return {"height": height}


def main() -> None:
    built = altimeter.build(sonar=aperiodic(max_rate=25), longest=5.0)
    result = simulate(built, {"sonar": sonar(1.5, events=400, seed=3)})
    last = result.height[-1]
    print(f"{result.ticks} readings, {len(result.plausible)} plausible")
    print(f"height {last.mean:.4f} m +- {np.sqrt(last.variance):.4f} m (true: 1.5 m)")


if __name__ == "__main__":
    main()
