"""The outdoor filters: the sensors' Jacobians, both filters on the same streams, and the same in every
engine."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DataError, DeclarationError, Flight, Series, simulate
from flowgraph.blocks.flights.worlds import load_world
from flowgraph.blocks.geometry import geodesic_angle
from flowgraph.blocks.outdoor import OutdoorSensors, attitude_of_two, outdoor_flight
from flowgraph.blocks.outdoor_belief import (
    FLOW,
    OUTDOOR,
    FieldObserver,
    PositionObserver,
    observe_distance,
    observe_flow,
)
from flowgraph.graphs.outdoor_eskf import outdoor_eskf
from flowgraph.graphs.rbpf_outdoor import rbpf_outdoor
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn

SENSORS = "imu,gps,gps2,altimeter,magnetometer,optical_flow"


@functools.cache
def flight(seed: int = 0, duration: float = 3.0, world: str = "thesis", **settings: float) -> Flight:
    named = {k.replace("__", "."): v for k, v in settings.items()}
    return load_world(world, seed=seed, settings={"sensors": SENSORS, "duration": duration, **named})


def both(seeds: range, particles: int, duration: float, engine: str = "python") -> dict[str, float]:
    """How many times the error of the error-state filter ours is, over all flights."""
    squares = {name: np.zeros(2) for name in ("rbpf", "eskf")}
    for seed in seeds:
        cases: dict[str, Case] = {
            "rbpf": rbpf_outdoor.case(flight(seed, duration), particles=particles, seed=seed),
            "eskf": outdoor_eskf.case(flight(seed, duration)),
        }
        for name, case in cases.items():
            score = case.score(simulate(case.graph, case.inputs, engine=engine, seed=seed))
            squares[name] += np.square([score["position_rmse_m"], score["attitude_rmse_deg"]])
    position, attitude = np.sqrt(squares["rbpf"] / squares["eskf"])
    return {"position": float(position), "attitude": float(attitude)}


def test_particles_follow_the_error_state_filter():
    ratio = both(range(2), particles=300, duration=4.0)
    assert ratio["position"] < 1.25
    assert ratio["attitude"] < 1.25


@pytest.mark.slow
def test_on_twenty_flights_particles_are_nearly_as_good_as_the_error_state_filter():
    """With every sensor as noisy as the simulated flights have it when left out."""
    ratio = both(range(20), particles=1000, duration=10.0, engine="c")
    assert ratio["position"] < 1.15
    assert ratio["attitude"] < 1.15


def test_the_error_state_filter_knows_how_wrong_it_is():
    case = outdoor_eskf.case(flight(1, 10.0))
    result = simulate(case.graph, case.inputs)
    for name in ("gps", "gps2", "magnetometer", "altimeter", "optical_flow"):
        innovation = result[f"{name}_innovation"]
        assert 0.7 < innovation["nis"].mean() / innovation["parts"].mean() < 1.3, name
    score = case.score(result)
    assert score["position_3sigma"] > 0.98
    assert score["tilt_3sigma"] > 0.97


@pytest.mark.parametrize(
    ("observe", "space"),
    [
        (PositionObserver((0.1, -0.2, 0.3)), None),
        (FieldObserver((0.0, 25e-6, -43e-6), 5e-6), None),
        (observe_distance, None),
        (observe_flow, FLOW),
    ],
)
def test_a_jacobian_is_the_derivative(observe, space):
    random = np.random.default_rng(3)
    x = random.normal(size=17)
    x[2] = 4.0
    x[6:10], x[13:17] = (1.0, 0.2, -0.3, 0.4), (1.0, -0.1, 0.2, 0.3)
    for at in (slice(6, 10), slice(13, 17)):
        x[at] /= np.linalg.norm(x[at])
    h, H = observe(x, np)
    minus = (lambda a, b: a - b) if space is None else (lambda a, b: space.minus(a, b, np))
    step = 1e-6
    for k, d in enumerate(np.eye(15) * step):
        slope = minus(observe(OUTDOOR.plus(x, d, np), np)[0], observe(OUTDOOR.plus(x, -d, np), np)[0])
        np.testing.assert_allclose(H[:, k], slope / (2.0 * step), atol=1e-6 * max(1.0, np.abs(h).max()))


@pytest.mark.parametrize("graph", [rbpf_outdoor, outdoor_eskf])
def test_the_engines_agree(graph):
    pytest.importorskip("jax")
    settings: dict[str, Any] = {"particles": 50} if graph is rbpf_outdoor else {}
    case = graph.case(flight(0, 1.0), **settings)
    engines_agree(case.graph, case.inputs)


def test_they_are_lowered_and_drawn():
    names = ("predict", "fuse_gps", "fuse_gps2", "fuse_altimeter", "fuse_flow")
    is_lowered_and_drawn(
        rbpf_outdoor.case(flight(), particles=10), *names, "fuse_field", "resample", "picture"
    )
    is_lowered_and_drawn(outdoor_eskf.case(flight()), *names, "fuse_magnetometer", "picture")


def test_the_start_is_read_from_the_first_force_and_field():
    f = flight(0, 3.0)
    assert f.truth is not None
    _, _, start = outdoor_flight(f, "test")
    off = np.radians(geodesic_angle(start.attitude, f.truth["attitude"][0]))
    assert off < 3.0 * np.hypot(np.sqrt(2.0) * start.spread.tilt, start.spread.heading)
    exact = attitude_of_two([0.0, 0.0, 9.81], [0.0, 25e-6, -43e-6], earth=[0.0, 25e-6, -43e-6])
    np.testing.assert_allclose(exact, [1.0, 0.0, 0.0, 0.0], atol=1e-12)


def test_a_dead_sensor_is_no_hindrance():
    """Where one stream ends early the others carry on."""
    f = flight(2, 4.0)
    cut = {name: s[s.time < 2_000_000_000] if name == "gps2" else s for name, s in f.streams.items()}
    case = rbpf_outdoor.case(dataclasses.replace(f, streams=cut), particles=300)
    assert case.score(simulate(case.graph, case.inputs))["position_rmse_m"] < 0.6


# Bad input.


@pytest.mark.parametrize("graph", [rbpf_outdoor, outdoor_eskf])
def test_a_flight_without_a_sensor_is_refused(graph):
    f = flight()
    less = {name: s for name, s in f.streams.items() if name != "gps2"}
    with pytest.raises(DataError, match=f"lacks what {graph.name} needs"):
        graph.case(dataclasses.replace(f, streams=less))


def test_a_flight_that_does_not_tell_its_noise_is_refused():
    with pytest.raises(DataError, match=r"does not say what rbpf_outdoor must know[\s\S]*no imu_noise"):
        rbpf_outdoor.case(dataclasses.replace(flight(), info={}))


def test_a_gap_in_optical_flow_is_refused():
    f = flight()
    flow: Series = f.streams["optical_flow"]
    some = flow[np.arange(len(flow)) != 3]
    with pytest.raises(DataError, match="row 3: optical flow has a gap"):
        rbpf_outdoor.case(dataclasses.replace(f, streams={**f.streams, "optical_flow": some}))


@pytest.mark.parametrize("setting", [{"particles": 0}, {"resample_below": -0.1}, {"settle": -1.0}])
def test_settings_out_of_range_are_refused(setting):
    with pytest.raises(DeclarationError, match=next(iter(setting))):
        rbpf_outdoor.case(flight(), **setting)


def test_sensors_without_noise_are_refused():
    _, sensors, _ = outdoor_flight(flight(), "test")
    assert isinstance(sensors, OutdoorSensors)
    with pytest.raises(DeclarationError, match=r"cannot be used[\s\S]*gps=0.0"):
        dataclasses.replace(sensors, gps=0.0)
