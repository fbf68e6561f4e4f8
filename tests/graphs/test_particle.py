"""The particle filter in the plane: nearly as good as the exact filter, and the same in every engine."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DataError, DeclarationError, Flight, UnknownNameError, load_flight, simulate
from flowgraph.blocks.metrics.errors import plane_errors
from flowgraph.blocks.models.plane import exact
from flowgraph.graphs.particle import particle
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn


@functools.cache
def flight(seed: int = 0, duration: float = 20.0) -> Flight:
    return load_flight("sim:plane", seed=seed, settings={"duration": str(duration)})


def case(particles: int = 1000, seed: int = 0, **settings: Any) -> Case:
    return particle.case(flight(seed), particles=particles, **settings)


@functools.cache
def apart(particles: int) -> float:
    """How far the mean of the cloud lies from the exact one, RMS over five flights."""
    squares = []
    for seed in range(5):
        made = case(particles, seed)
        found = simulate(made.graph, made.inputs, seed=seed)["belief"]
        squares.append(np.mean((found.position - exact(flight(seed), spread=1.0)["position"]) ** 2))
    return float(np.sqrt(np.mean(squares)))


def test_it_is_nearly_as_good_as_the_exact_filter():
    ours, best = [], []
    for seed in range(5):
        made = case(1000, seed)
        ours.append(made.score(simulate(made.graph, made.inputs, seed=seed))["position_rmse_m"])
        truth = flight(seed).truth
        assert truth is not None
        best.append(plane_errors(exact(flight(seed), spread=1.0), truth)["position_rmse_m"])
    assert np.mean(best) < 0.35
    assert np.mean(ours) < 1.03 * np.mean(best)


def test_its_error_falls_with_the_root_of_the_number_of_particles():
    assert 5.0 < apart(25) / apart(2500) < 20.0  # 10 in theory


def test_its_covariance_is_that_of_the_exact_filter():
    made = case(5000)
    belief, best = simulate(made.graph, made.inputs)["belief"], exact(flight(), spread=1.0)
    ratio = np.trace(belief.covariance, axis1=1, axis2=2) / np.trace(best["covariance"], axis1=1, axis2=2)
    assert 0.97 < ratio.mean() < 1.03


def test_the_engines_agree():
    pytest.importorskip("jax")
    made = particle.case(flight(0, 4.0), particles=100)
    assert np.any(engines_agree(made.graph, made.inputs)["ancestors"]["resampled"])


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(case(10), "move", "weigh", "resample", "average")


def test_the_velocity_is_the_mean_since_the_reading_before():
    quiet = load_flight("sim:plane", settings={"velocity.noise": "1e-9", "position.noise": "1e-9"})
    velocity, position = quiet.streams["velocity"], quiet.streams["position"]
    path = np.cumsum(velocity["velocity"][1:] * 0.05, axis=0)
    at = np.searchsorted(velocity.time[1:], position.time[1:])
    np.testing.assert_allclose(path[at], position["position"][1:], atol=1e-6)


@pytest.mark.parametrize("setting", [{"particles": 0}, {"spread": -1.0}, {"settle": -1.0}])
def test_settings_out_of_range_are_refused(setting):
    with pytest.raises(DeclarationError):
        particle.case(flight(), **setting)


def test_a_flight_without_velocity_is_refused():
    some = flight()
    with pytest.raises(DataError, match=r"lacks what particle needs[\s\S]*velocity, position"):
        particle.case(Flight("bare", {"position": some.streams["position"]}, None, some.info))


def test_a_flight_of_unknown_noise_is_refused():
    with pytest.raises(DataError, match=r"does not say its velocity_noise[\s\S]*--set velocity_noise=0.1"):
        particle.case(Flight("bare", flight().streams))


def test_settings_of_the_plane_are_checked():
    with pytest.raises(UnknownNameError, match="velocity.noize"):
        load_flight("sim:plane", settings={"velocity.noize": "1"})
    with pytest.raises(DeclarationError, match="'duration' is not usable"):
        load_flight("sim:plane", settings={"duration": "-1"})
    with pytest.raises(DeclarationError, match="too large"):
        load_flight("sim:plane", settings={"velocity.rate": "1e8"})
