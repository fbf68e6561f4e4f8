"""A run that is fed with live events: `push` makes a tick, a `sink` sees values at once, `state` is kept.

Two sensors come in as they come: wheel speed often, distance marks now and then. Half-way the state is
saved to a file, and a second run goes on from it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from flowgraph import Run, Scalar, Stream, block, delay, graph, load_state, save_state, sink


@block
def advance(distance: Scalar, speed: Scalar | None, mark: Scalar | None, *, dt: float) -> Scalar:
    """A mark says where we are; without one, the speed just read holds for the time since the last tick."""
    if speed is not None and mark is None:
        return distance + speed * dt
    return mark


@graph
def odometer(speed: Stream[Scalar], mark: Stream[Scalar], *, show):
    """Distance along a track in m, from wheel speed in m/s and distance marks in m."""
    before = delay(0.0, name="distance")
    distance = advance(before, speed, mark)
    before.feed(distance)
    sink(distance, show)
    return {"distance": distance}


EVENTS = [
    (0, {"speed": 2.0}),
    (1_000_000_000, {"speed": 2.0}),
    (2_000_000_000, {"speed": 3.0}),
    (2_500_000_000, {"mark": 5.25}),
    (3_000_000_000, {"speed": 3.0, "mark": 7.0}),
    (4_000_000_000, {"speed": 1.0}),
]


def main() -> None:
    built = odometer.build(show=lambda distance: print(f"  distance {float(distance):.2f} m"))
    first = Run(built)
    for time, values in EVENTS[:3]:
        first.push(time, **values)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "state.npz"
        save_state(first.state, file)
        print("saved and resumed")
        second = Run(built, state=load_state(file))
    for time, values in EVENTS[3:]:
        second.push(time, **values)
    last = float(second.state["registers"]["distance"])
    print(f"{first.ticks + second.ticks} ticks, last distance {last:.2f} m")


if __name__ == "__main__":
    main()
