"""A tracker of your own, in a file: a car that says how it is steered, and is seen by GPS.

    flowgraph run examples/own_tracker.py:tracker --data examples/own_tracker.py:drive --out out/car
    flowgraph tune examples/own_tracker.py:tracker --data examples/own_tracker.py:drive --seeds 2 \
        --fit fix_noise=0.3:30 --fit turn_noise=0.001:1
    flowgraph run examples/own_tracker.py:tracker --data examples/own_tracker.py:drive --set smooth=rts
    flowgraph lower examples/own_tracker.py:tracker --data examples/own_tracker.py:drive --target c -o out/c
    flowgraph batch examples/own_tracker_study.toml

Nothing of it is known to the library. The model says what the state is, how it moves and what is seen of it;
`tracker` is a filter of that model, and `drive` makes a flight to try it on. The script writes such a flight
to a table as a logger would, and runs the filter on it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from flowgraph import Array, Flight, Series, Signal, Stream, graph, load_flight, real, simulate, write_table
from flowgraph.blocks.filtering import (
    MeasurementModel,
    Method,
    MotionModel,
    StateSpace,
    angle,
    euclidean,
    extended,
    filtered,
    particles,
    unscented,
)
from flowgraph.data.registry import find_graph


class Steering(Signal):
    """What the driver does."""

    rate: Array = real(unit="rad/s")
    acceleration: Array = real(unit="m/s^2")


class Fix(Signal):
    """Where the receiver sees the car."""

    position: Array = real(2, unit="m", frame="world")


class Car(Signal):
    """What is true of the car."""

    position: Array = real(2, unit="m", frame="world")
    heading: Array = real(unit="rad")
    speed: Array = real(unit="m/s")


CAR = StateSpace(position=euclidean(2), heading=angle(), speed=euclidean(1))
START = CAR.gaussian(position=((0.0, 0.0), 1.0), heading=(0.3, 0.1), speed=(5.0, 0.5))
METHODS: dict[str, Callable[[], Method]] = {
    "extended": extended,
    "unscented": unscented,
    "particles": lambda: particles(500),
}


def moved(x, u: Steering, w, dt, xp):
    along = xp.concat([xp.cos(x.heading), xp.sin(x.heading)], axis=-1)
    return CAR.plus(x, velocity=(x.speed * along, u.rate + w[..., 0], u.acceleration + w[..., 1]), dt=dt)


def seen(x, v, xp):
    return x.position + v


def car(turn_noise: float, push_noise: float) -> MotionModel:
    return MotionModel(CAR, moved, density=np.diag([turn_noise**2, push_noise**2]))


@graph
def tracker(
    steering: Stream[Steering],
    fix: Stream[Fix],
    *,
    fix_noise: float = 2.0,
    turn_noise: float = 0.02,
    push_noise: float = 0.2,
    method: str = "extended",
    smoothing: bool = False,
):
    """A car, by what its driver does and where it is seen."""
    gps = MeasurementModel(CAR, seen, noise=fix_noise**2 * np.eye(2))
    motion = car(turn_noise, push_noise)
    chosen = METHODS[method]()
    return filtered(motion, {gps: fix}, control=steering, start=START, method=chosen, smoothing=smoothing)


def drive(
    *,
    seed: int = 0,
    duration: float = 30.0,
    gps: float = 2.0,
    wheel: float = 0.02,
    pedal: float = 0.2,
) -> Flight:
    """A drive of so many seconds, steered at 20 Hz and seen at 2 Hz; with these noises."""
    rng, model = np.random.default_rng(seed), car(wheel, pedal)
    time = np.arange(0, round(duration * 1e9), 50_000_000)
    told = Steering(rate=0.3 * np.sin(time * 1e-9), acceleration=0.4 * np.cos(0.7e-9 * time))
    x = rng.multivariate_normal(START.mean, START.covariance)[None]
    states = []
    for k in range(len(time)):
        w = rng.normal(size=(1, 2)) * np.array([wheel, pedal]) / np.sqrt(0.05)
        held = Steering(rate=told.rate[max(k - 1, 0)], acceleration=told.acceleration[max(k - 1, 0)])
        x = model.carry(x, held, w, 0.05 * (k > 0), np)
        states.append(x[0])
    truth = np.array(states)
    fix = Fix(position=truth[::10, :2] + gps * rng.normal(size=truth[::10, :2].shape))
    return Flight(
        f"drive-{seed}",
        {"steering": Series(time, told), "fix": Series(time[::10], fix)},
        truth=Series(time, Car(position=truth[:, :2], heading=truth[:, 2], speed=truth[:, 3])),
    )


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "drive.csv"
        write_table(drive(seed=1), table)
        print(table.read_text().splitlines()[0])
        flight = load_flight(f"table:{table}")
    case = find_graph(f"{__file__}:tracker").case(flight, smooth="rts")
    for name, value in case.score(simulate(case.graph, case.inputs)).items():
        print(f"{name:<28}{value:.4g}")


if __name__ == "__main__":
    main()
