"""`sim:plane`: a run of its graph, the same in every engine and inside of another graph."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import Flight, Stream, Tick, graph, load_flight, simulate
from flowgraph.blocks.flights.plane import plane


def load(seed: int = 0, **settings: Any) -> Flight:
    return load_flight("sim:plane", seed=seed, settings={n.replace("_", "."): v for n, v in settings.items()})


def errors(flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """What is wrong with velocities, but the first, and positions."""
    truth, velocity, position = flight.truth, flight.streams["velocity"], flight.streams["position"]
    assert truth is not None
    at = lambda time: truth["position"][np.searchsorted(truth.time, time)]
    step = np.diff(velocity.time)[:, None] * 1e-9
    moved = np.diff(at(velocity.time), axis=0) / step
    return (velocity["velocity"][1:] - moved) * np.sqrt(step), position["position"] - at(position.time)


def test_the_errors_are_white_and_as_large_as_said() -> None:
    found = [errors(load(seed, velocity_noise=0.2, position_noise=0.5)) for seed in range(20)]
    rates, places = (np.concatenate(part) for part in zip(*found, strict=True))
    for values, size in ((rates, 0.2), (places, 0.5)):
        bound = 4.0 / np.sqrt(values.size)  # of a standard deviation, four of its own
        np.testing.assert_allclose(values.std() / size, 1.0, atol=bound)
        assert abs(values.mean()) / size < bound
    first = rates.reshape(20, -1, 2)
    assert abs(np.mean(first[:, 1:] * first[:, :-1])) / 0.04 < 4.0 / np.sqrt(first.size)


def test_the_figures_are_of_their_family() -> None:
    """Three waves of standard normal sizes: far from the start, variance 3 (1/2 + 1/2), its phase's too."""
    ends = []
    for seed in range(200):
        truth = load(seed, duration=20).truth
        assert truth is not None
        assert np.abs(truth["position"][0]).max() < 1e-12, "it begins at the origin"
        ends.append(truth["position"][-1])
    square = np.square(ends)
    assert abs(square.mean() - 3.0) < 4.0 * square.std() / np.sqrt(square.size)
    assert len({tuple(e) for e in ends}) == 200


def test_in_a_graph_it_is_what_was_recorded() -> None:
    @graph
    def world(start: Stream[Tick], velocity: Stream[Tick], position: Stream[Tick], *, settings: Any):
        return plane(start, velocity, position, **settings)

    flight = load(3, duration=4)
    made_by = flight.experiment
    assert made_by is not None
    assert made_by.world is plane
    built = world.build(settings=dict(made_by.settings))
    for engine in ("numpy", "python", "reference", "c"):
        found = simulate(built, made_by.ticks, engine=engine, seed=3)
        for name, series in {**flight.streams, "truth": flight.truth}.items():
            assert series is not None
            np.testing.assert_array_equal(found[name].time, series.time)
            for leaf, values in series.leaves.items():
                if engine == "numpy":
                    np.testing.assert_array_equal(found[name][leaf], values)
                np.testing.assert_allclose(found[name][leaf], values, rtol=1e-9, atol=1e-9, err_msg=engine)


@pytest.mark.slow
def test_in_a_graph_it_is_what_was_recorded_in_xla_too() -> None:
    pytest.importorskip("jax")
    flight = load(3, duration=4)
    made_by = flight.experiment
    assert made_by is not None
    found = simulate(plane.build(**made_by.settings), made_by.ticks, engine="xla", seed=3)
    for name, series in flight.streams.items():
        for leaf, values in series.leaves.items():
            np.testing.assert_allclose(found[name][leaf], values, rtol=1e-9, atol=1e-9)


def test_readings_seldom_or_of_an_instant_are_right_too() -> None:
    once = load(duration=0.01)
    assert len(once.streams["velocity"]) == len(once.streams["position"]) == 1
    odd = load(2, velocity_rate=3, position_rate=7, velocity_noise=1e-9, duration=5)
    rates, _ = errors(odd)
    assert np.abs(rates).max() < 1e-6
