"""A live run in the browser: a robot pushes what its sensors say, and a page shows it as it goes on.

    python examples/watched_live.py --seconds 60

prints an address. The page there has the diagram with what is on its wires, the outputs over time, and what
became of the events: here one beacon in ten comes late and one in fifty is lost.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from flowgraph import Live, LiveView, Scalar, Stream, aperiodic, block, delay, graph


@block
def follow(place: Scalar, speed: Scalar | None, beacon: Scalar | None, *, dt: float) -> Scalar:
    """Carry the place on by the speed; a beacon moves it half of the way to where it says."""
    moved = place if speed is None else place + speed * dt
    return moved if beacon is None else moved + 0.5 * (beacon - moved)


@graph
def rover(speed: Stream[Scalar], beacon: Stream[Scalar]):
    """Distance along a rail in m, from wheel speed in m/s and beacons that know where they stand."""
    before = delay(0.0, name="place")
    place = follow(before, speed, beacon)
    before.feed(place)
    return {"place": place}


def drive(live: Live, seconds: float, rate: float = 100.0) -> None:
    """Push what the sensors of a robot say, as it happens."""
    draw, begun = np.random.default_rng(0), time.perf_counter()
    for k in range(int(seconds * rate)):
        time.sleep(max(begun + k / rate - time.perf_counter(), 0.0))
        now = int(k / rate * 1e9)
        live.push(now, speed=np.float64(1.0 + 0.1 * draw.normal()))
        if k % 10 == 0 and draw.uniform() > 0.02:
            stamp = now - (30_000_000 if draw.uniform() < 0.1 and k else 0)
            live.push(stamp, beacon=np.float64(k / rate + 0.05 * draw.normal()))


def main(arguments: list[str] | None = None) -> None:
    asked = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    asked.add_argument("--seconds", type=float, default=60.0)
    asked.add_argument("--port", type=int, default=0)
    given = asked.parse_args(arguments)
    built = rover.build(speed=aperiodic(), beacon=aperiodic())
    with LiveView(built, title="a robot on a rail", port=given.port) as view:
        print(f"open {view.url} in a browser on this machine", flush=True)
        with Live(built, lateness="20ms", watcher=view) as live:
            drive(live, given.seconds)
        result = live.result()
        counts = {name: n for name, n in live.counts.items() if n}
        print(f"{result.ticks} ticks, last place {result.place['value'][-1]:.2f} m, {counts}")


if __name__ == "__main__":
    main()
