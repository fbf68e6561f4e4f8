"""How a graph is made ready for a flight: what is checked first, what the case has, what is documented."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from flowgraph import (
    Case,
    DataError,
    DeclarationError,
    Flight,
    Result,
    Series,
    Stream,
    UnknownNameError,
    find_graph,
    graph,
    simulate,
)
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.scoring.cases import (
    Factors,
    OnFlight,
    PoseAided,
    PoseNoises,
    Scored,
    Smoothed,
    on_flight,
)
from flowgraph.blocks.scoring.settings import Positive
from flowgraph.blocks.scoring.tuning import unbiased_factors
from flowgraph.blocks.signals import Imu
from flowgraph.data.registry import graph_names
from flowgraph.data.settings import parsed_settings, setting_names
from flowgraph.language.declare import GraphFunction

UNIT = ImuNoise(0.01, 0.1, 0.0, 0.0)


@dataclass(frozen=True)
class Held(PoseAided):
    """Controls that are held.

    Args:
        held_noise: grow or keep.
    """

    held_noise: str = "grow"


def a_flight(**info: object) -> Flight:
    imu = Imu(gyro=np.zeros((4, 3)), specific_force=np.ones((4, 3)))
    return Flight("quiet", {"imu": Series(np.arange(4) * 10_000_000, imu, name="imu")}, None, dict(info))


def toy() -> GraphFunction:
    @graph
    def doubled(imu: Stream[Imu], *, gain: float = 2.0):
        """Twice the rate."""
        return {"twice": imu.map(lambda reading: gain * reading.gyro)}

    return doubled


def on_toy(flight: Flight | None = None) -> OnFlight:
    flight = flight or a_flight()
    return OnFlight(toy(), flight, dict(flight.streams))


def registered(**how: object) -> GraphFunction:
    doubled = toy()

    @on_flight(doubled, "imu", **how)  # type: ignore[arg-type]
    def for_flight(on: OnFlight, *, gain: Positive = 2.0, scored: Scored) -> Case:
        return on.case(scored.score(on, pose_errors, estimate="twice"), gain=gain)

    return doubled


def test_the_case_has_what_was_needed_and_what_is_scored():
    case = registered().case(a_flight(), gain=3.0)
    assert isinstance(case.inputs, Mapping)
    assert list(case.inputs) == ["imu"]
    assert case.estimate == "twice"
    assert case.graph.settings["gain"] == 3.0
    assert case.score(simulate(case.graph, case.inputs)) == {}  # neither a truth nor innovations


def test_an_estimate_may_be_said_beside_the_score():
    def score(result: Result) -> dict[str, float]:
        return {}

    assert on_toy().case(score).estimate == "belief"
    assert on_toy().case(score, estimate="twice").estimate == "twice"


def test_settings_are_checked_before_the_flight_is_looked_at():
    with pytest.raises(DeclarationError, match=r"doubled\.gain: setting 'gain' is out of range"):
        registered().case(Flight("empty", {}), gain=0.0)
    with pytest.raises(DataError, match=r"empty: this flight lacks what doubled needs[\s\S]*streams imu"):
        registered().case(Flight("empty", {}))
    with pytest.raises(DataError, match="fly again, or a graph that fits: flowgraph inspect"):
        registered(fix="fly again").case(Flight("empty", {}))


def test_a_setting_that_is_not_there_is_refused_in_code_and_in_words():
    with pytest.raises(UnknownNameError, match="doubled: no setting is called 'gian'"):
        registered().case(a_flight(), gian=1.0)
    prepare = registered().prepare
    assert prepare is not None
    assert setting_names(prepare) == ["gain", "settle", "gyro_range", "specific_force_range", "rewind"]
    with pytest.raises(UnknownNameError, match="did you mean 'gain'"):
        parsed_settings(prepare, {"gian": "1"}, also=(), path="doubled")
    with pytest.raises(DeclarationError, match="finite float"):
        parsed_settings(prepare, {"settle": "soon"}, also=(), path="doubled")


def test_a_flight_is_completed_before_streams_are_looked_for():
    case = registered(told=lambda flight: a_flight()).case(Flight("empty", {}))
    assert isinstance(case.inputs, Mapping)
    assert len(case.inputs["imu"]) == 4


def test_what_is_added_to_a_group_is_a_setting_of_each_graph_that_has_it():
    for _ in range(2):
        doubled = toy()

        @on_flight(doubled)
        def for_flight(on: OnFlight, *, filter: Held) -> Case:
            """Make it."""
            return on.case(lambda result: {}, gain=2.0 if filter.held_noise == "grow" else 1.0)

        assert doubled.prepare is not None
        assert "held_noise" in setting_names(doubled.prepare)
        assert "held_noise: grow or keep." in (doubled.prepare.__doc__ or "")
        mine, _ = parsed_settings(doubled.prepare, {"held_noise": "keep"}, also=(), path="doubled")
        assert mine == {"held_noise": "keep"}


@pytest.mark.parametrize("name", graph_names())
def test_every_setting_of_the_library_is_documented(name):
    prepare = find_graph(name).prepare
    assert prepare is not None
    told = inspect.cleandoc(prepare.__doc__ or "")
    for setting in setting_names(prepare):
        assert re.search(rf"(?m)(^ {{4}}|, |; ){setting}(, \w+)*: ", told), f"{setting} in\n{told}"


def test_factors_are_what_is_set_or_else_what_suits_the_filter():
    on = on_toy(a_flight(imu_noise=UNIT))
    assert Factors().imu_noise(on) == UNIT
    assert Factors().imu_noise(on, (2.0, 3.0)) == UNIT.scaled(gyro=2.0, accelerometer=3.0)
    assert Factors(gyro_factor=5.0).imu_noise(on, (2.0, 3.0)) == UNIT.scaled(gyro=5.0, accelerometer=3.0)
    with pytest.raises(DataError, match="does not say the noise of its imu, and doubled needs it"):
        Factors().imu_noise(on_toy())


def test_a_unit_whose_biases_walk_is_believed_less():
    assert unbiased_factors("doubled", a_flight(imu_noise=UNIT)) == (1.0, 1.0)
    walking = ImuNoise(0.01, 0.1, 1e-4, 0.0)
    assert unbiased_factors("doubled", a_flight(imu_noise=walking)) == (20.0, 20.0)


def test_the_noise_of_a_pose_is_set_or_that_of_the_flight_or_a_guess():
    said = on_toy(a_flight(position_noise=0.5))
    assert PoseNoises().measured(on_toy()) == {"position_noise": 0.004, "attitude_noise": 0.01}
    assert PoseNoises(attitude_noise=0.2).measured(said) == {"position_noise": 0.5, "attitude_noise": 0.2}
    with pytest.raises(DeclarationError, match=r"doubled\.position_noise[\s\S]*the flight's own"):
        PoseNoises().measured(on_toy(a_flight(position_noise=0.0)))


def test_a_score_smooths_where_that_is_a_setting():
    scored, smoothed = Scored(settle=2.0), Smoothed(settle=3.0, smooth="rts", lag=0.5)
    plain, more = (s.score(on_toy(), pose_errors) for s in (scored, smoothed))
    assert (plain.settle, plain.smooth, plain.lag) == (2.0, "none", None)
    assert (more.settle, more.smooth, more.lag) == (3.0, "rts", 0.5)
