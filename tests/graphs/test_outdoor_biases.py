"""The outdoor filters with biases: found where a flight says that there are any, smoothed, and the same in
every engine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import DeclarationError, Series, simulate
from flowgraph.graphs.benches.biases import found_biases, true_biases
from flowgraph.graphs.outdoor_eskf import outdoor_eskf
from flowgraph.graphs.rbpf_outdoor import rbpf_outdoor
from tests.graphs.estimation import engines_agree, ratios
from tests.graphs.estimation import outdoor as flight

BIASED = {"gyro__bias": 0.05, "accelerometer__bias": 0.3}


def ended(result: Any) -> tuple[np.ndarray, np.ndarray]:
    found = found_biases(result)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("seeds", "seconds", "least"),
    [
        ((0, 1), 6.0, {"velocity_rmse_mps": 1.8}),  # one of the two has small biases
        pytest.param(
            range(6), 8.0, {"position_rmse_m": 1.5, "velocity_rmse_mps": 2.5, "attitude_rmse_deg": 1.3},
            marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_biases_of_several_flights_are_found(seeds, seconds, least):
    """Told of them, as the flights say, the filter is as honest as without any; else it is farther off (1.8,
    3.1 and 1.4 times over six flights of 8 s), and sure of it."""
    off, ours, theirs = [], [], []
    for seed in seeds:
        f = flight(seed, seconds, **BIASED)
        cases = [outdoor_eskf.case(f), outdoor_eskf.case(f, biases=False)]
        runs = [simulate(case.graph, case.inputs) for case in cases]
        told, untold = (case.score(run) for case, run in zip(cases, runs, strict=True))
        ours.append(told)
        theirs.append(untold)
        mean, deviations = ended(runs[0])
        assert (deviations[:3] < 0.015).all()
        off.append((mean - true_biases(f)) / deviations)
    assert np.sqrt(np.mean(np.square(off))) < 1.3
    rms = lambda scores, name: np.sqrt(np.mean([score[name] ** 2 for score in scores]))
    for name, times in least.items():
        assert rms(theirs, name) > times * rms(ours, name), name
    assert np.mean([score["nees_mean"] for score in ours]) < 12.0
    assert all(score["position_3sigma"] > 0.98 for score in ours)


@pytest.mark.slow
def test_particles_find_biases_too():
    cases, runs = [], []
    for seed in range(2):
        f = flight(seed, 4.0, **BIASED)
        cases += [rbpf_outdoor.case(f, particles=200, seed=seed), outdoor_eskf.case(f)]
        runs += [simulate(case.graph, case.inputs, seed=seed) for case in cases[-2:]]
    scores = [case.score(run) for case, run in zip(cases, runs, strict=True)]
    for ratio in ratios(scores[::2], scores[1::2]).values():
        assert ratio < 1.4
    for seed in range(2):
        truth = flight(seed, 4.0, **BIASED).truth
        assert truth is not None
        gyro = ended(runs[2 * seed])[0][:3]
        np.testing.assert_allclose(gyro, truth["gyro_bias"][-1], atol=0.04)


def test_biases_are_estimated_where_a_flight_says_that_there_are_any():
    plain, biased = flight(), flight(**BIASED)
    assert "gyro_bias" not in simulated(outdoor_eskf.case(plain)).leaves
    assert "gyro_bias" not in simulated(outdoor_eskf.case(biased, biases=False)).leaves
    for case in (
        outdoor_eskf.case(biased),
        outdoor_eskf.case(plain, biases=True),
        outdoor_eskf.case(plain, gyro_bias=0.02),
    ):
        assert "gyro_bias" in simulated(case).leaves
    with pytest.raises(DeclarationError, match=r"gyro_bias[\s\S]*estimate no biases"):
        outdoor_eskf.case(biased, biases=False, gyro_bias=0.02)


def simulated(case: Any) -> Series:
    """The belief of the first tenth of a second."""
    inputs = {name: s[s.time < 100_000_000] for name, s in case.inputs.items()}
    belief = simulate(case.graph, inputs)["belief"]
    assert isinstance(belief, Series)
    return belief


@pytest.mark.parametrize("way", ["rts", pytest.param("batch", marks=pytest.mark.slow)])
def test_with_biases_it_is_smoothed(way):
    """Root mean squares of six flights: 0.75 times; on one so short the filter may have the better luck."""
    cases = [outdoor_eskf.case(flight(seed, 2.0, **BIASED), smooth=way) for seed in range(6)]
    scores = [case.score(simulate(case.graph, case.inputs)) for case in cases]
    rms = lambda name: np.sqrt(np.mean([score[name] ** 2 for score in scores]))
    assert rms("smoothed_position_rmse_m") < 0.8 * rms("position_rmse_m")


@pytest.mark.slow
@pytest.mark.parametrize("graph", [rbpf_outdoor, outdoor_eskf])
def test_with_biases_the_engines_agree(graph):
    pytest.importorskip("jax")
    few: dict[str, Any] = {"particles": 30} if graph is rbpf_outdoor else {}
    case = graph.case(flight(0, 0.6, **BIASED), gate=0.99, **few)
    engines_agree(case.graph, case.inputs)
