"""The outdoor filters: the sensors' Jacobians, both filters on the same streams, and the same in every
engine."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Flight, Series, simulate
from flowgraph.blocks.geometry.rotations import (
    from_rotation_vector,
    geodesic_angle,
    multiply,
    rotate,
    to_matrix,
)
from flowgraph.blocks.kalman.filters import observed
from flowgraph.blocks.outdoor.belief import (
    FLOW,
    OUTDOOR,
    FieldObserver,
    PositionObserver,
    observe_distance,
    observe_flow,
)
from flowgraph.blocks.outdoor.flight import AIDS, OutdoorSensors, attitude_of_two, outdoor_flight
from flowgraph.graphs.outdoor_eskf import outdoor_eskf
from flowgraph.graphs.rbpf_outdoor import rbpf_outdoor
from flowgraph.study import Study, read_table, run_study
from tests.graphs.estimation import SENSORS, engines_agree, is_lowered_and_drawn, ratios
from tests.graphs.estimation import outdoor as flight


def test_particles_follow_the_error_state_filter():
    flown = [flight(seed, 4.0) for seed in range(2)]
    ours = [rbpf_outdoor.case(f, particles=300, seed=k) for k, f in enumerate(flown)]
    theirs = [outdoor_eskf.case(f) for f in flown]
    scores = [
        [case.score(simulate(case.graph, case.inputs, seed=k)) for k, case in enumerate(cases)]
        for cases in (ours, theirs)
    ]
    for ratio in ratios(*scores).values():
        assert ratio < 1.25


@pytest.mark.slow
def test_on_twenty_flights_particles_are_nearly_as_good_as_the_error_state_filter(tmp_path):
    """With every sensor as noisy as the simulated flights have it when left out."""
    pytest.importorskip("pyarrow")
    study = Study(
        graphs=["rbpf_outdoor", "outdoor_eskf"],
        data=["sim:thesis"],
        seeds=20,
        parameters={"sensors": SENSORS, "duration": 5.0},
        engine="c",
        chunk=20,
    )
    assert run_study(study, tmp_path).done == 40
    rows: dict[str, list[Any]] = {name: [] for name in study.graphs}
    for row in read_table(tmp_path):
        rows[row["graph"]].append(row)
    for ratio in ratios(*rows.values()).values():
        assert ratio < 1.15


def test_the_error_state_filter_knows_how_wrong_it_is():
    """Over three flights: a receiver that reads 13 times in one shows its NIS to 0.2."""
    cases = [outdoor_eskf.case(flight(seed, 10.0)) for seed in (1, 2, 3)]
    results = [simulate(case.graph, case.inputs) for case in cases]
    for name in ("gps", "gps2", "magnetometer", "altimeter", "optical_flow"):
        nis, parts = (sum(r[f"{name}_innovation"][leaf].sum() for r in results) for leaf in ("nis", "parts"))
        assert 0.7 < nis / parts < 1.3, name
    scores = [case.score(result) for case, result in zip(cases, results, strict=True)]
    assert np.mean([score["position_3sigma"] for score in scores]) > 0.98
    assert np.mean([score["tilt_3sigma"] for score in scores]) > 0.97


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
    h, H = observed(observe, x, OUTDOOR, space, np)
    minus = (lambda a, b: a - b) if space is None else (lambda a, b: space.minus(a, b, np))
    step = 1e-6
    for k, d in enumerate(np.eye(15) * step):
        slope = minus(observe(OUTDOOR.plus(x, d, np), np), observe(OUTDOOR.plus(x, -d, np), np))
        np.testing.assert_allclose(H[:, k], slope / (2.0 * step), atol=1e-6 * max(1.0, np.abs(h).max()))


@pytest.mark.slow
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
    _, _, start, _ = outdoor_flight(f, "test")
    off = np.radians(geodesic_angle(start.attitude, f.truth["attitude"][0]))
    assert off < 3.0 * np.hypot(np.sqrt(2.0) * start.spread.tilt, start.spread.heading)
    exact = attitude_of_two([0.0, 0.0, 9.81], [0.0, 25e-6, -43e-6], earth=[0.0, 25e-6, -43e-6])
    np.testing.assert_allclose(exact, [1.0, 0.0, 0.0, 0.0], atol=1e-12)


def turned(base: Flight, degrees: float) -> Flight:
    """The flight in a world that is turned about the vertical: what the body reads stays."""
    turn = np.asarray(from_rotation_vector(np.array([0.0, 0.0, np.radians(degrees)]), xp=np))
    about = lambda v: np.asarray(rotate(turn, v, xp=np))
    streams, truth = dict(base.streams), base.truth
    assert truth is not None
    for name in ("gps", "gps2"):
        series = streams[name]
        streams[name] = Series(
            series.time, series.values.replace(position=about(series["position"])), name=name
        )
    values = truth.values.replace(
        position=about(truth["position"]),
        velocity=about(truth["velocity"]),
        attitude=np.asarray(multiply(turn, truth["attitude"], xp=np)),
    )
    field = tuple(about(np.asarray(base.info["magnetic_field"])).tolist())
    return dataclasses.replace(
        base,
        streams=streams,
        truth=Series(truth.time, values, name="truth"),
        info={**base.info, "magnetic_field": field},
    )


def with_first(base: Flight, name: str, field: str, value: float, rows: int) -> Flight:
    """The flight whose stream reads that in its first rows."""
    series = base.streams[name]
    readings = np.array(series[field])
    readings[:rows] = value
    made = Series(series.time, series.values.replace(**{field: readings}), name=name, gaps=True)
    return dataclasses.replace(base, streams={**base.streams, name: made})


@pytest.mark.parametrize(("settings", "said"), [
    ({}, "assumed: the start has the attitude of the first force and field that were measured"),
    ({"start": "truth"}, "assumed: the start is the truth's"),
    ({"start": "unknown_yaw"}, "assumed: nothing is known of the heading at the start: that of the first"),
    ({"start_heading": -2.0}, "assumed: the heading at the start is -2 rad, as it was set"),
])  # fmt: skip
@pytest.mark.parametrize("graph", [rbpf_outdoor, outdoor_eskf])
def test_what_an_outdoor_filter_starts_with_is_a_note(graph, settings, said):
    few: dict[str, Any] = {"particles": 10} if graph is rbpf_outdoor else {}
    case = graph.case(flight(), **settings, **few)
    assert any(note.startswith(said) for note in case.notes)


@pytest.mark.parametrize("degrees", [0.0, 150.0, -90.0])
@pytest.mark.parametrize("graph", [pytest.param(rbpf_outdoor, marks=pytest.mark.slow), outdoor_eskf])
def test_the_field_shows_a_heading_of_which_nothing_is_known(graph, degrees):
    few: dict[str, Any] = {"particles": 200} if graph is rbpf_outdoor else {}
    case = graph.case(turned(flight(1), degrees), start="unknown_yaw", settle=2.0, **few)
    result = simulate(case.graph, case.inputs)
    assert case.score(result)["heading_rmse_deg"] < 4.0


def test_a_heading_that_is_set_is_that_of_an_outdoor_start():
    for heading in (0.4, -2.0, 3.0):
        case = outdoor_eskf.case(flight(), start_heading=heading)
        inputs: Any = case.inputs
        early = {name: s[s.time < 20_000_000] for name, s in inputs.items()}
        R = to_matrix(simulate(case.graph, early)["belief"]["attitude"][0], xp=np)
        assert (
            abs(np.angle(np.exp(1j * (np.arctan2(R[1, 0], R[0, 0]) - heading)))) < 0.35
        )  # 0.29 to 0.31 for -2.0, six flights


@pytest.mark.parametrize(("name", "field", "value"), [
    ("imu", "specific_force", 0.0), ("imu", "specific_force", np.nan),
    ("magnetometer", "field", 0.0), ("magnetometer", "field", np.nan), ("gps", "position", np.nan),
])  # fmt: skip
def test_what_can_start_no_outdoor_filter_is_passed_over(name, field, value):
    base = flight(1)
    case = outdoor_eskf.case(with_first(base, name, field, value, 2), settle=2.0)
    score = case.score(simulate(case.graph, case.inputs))
    usual = outdoor_eskf.case(base, settle=2.0)
    best = usual.score(simulate(usual.graph, usual.inputs))
    for key in ("position_rmse_m", "attitude_rmse_deg"):
        assert score[key] < 2.0 * best[key]  # 1.65 where two of the six fixes of a receiver are gone
    with pytest.raises(DataError, match=f"{name}[\\s\\S]*no reading of"):
        outdoor_eskf.case(with_first(base, name, field, value, len(base.streams[name])))


def test_a_truth_that_begins_later_starts_no_outdoor_filter():
    base = flight()
    assert base.truth is not None
    late = dataclasses.replace(base, truth=base.truth[base.truth.time >= 1_012_000_000])
    with pytest.raises(DataError, match="optical flow has a gap"):
        outdoor_eskf.case(late, start="truth")


def test_a_dead_sensor_is_no_hindrance():
    """Where one stream ends early the others carry on."""
    f = flight(2, 4.0)
    cut = {name: s[s.time < 2_000_000_000] if name == "gps2" else s for name, s in f.streams.items()}
    case = rbpf_outdoor.case(dataclasses.replace(f, streams=cut), particles=300)
    assert case.score(simulate(case.graph, case.inputs))["position_rmse_m"] < 0.6


# Bad input.


@pytest.mark.parametrize("graph", [rbpf_outdoor, outdoor_eskf])
@pytest.mark.parametrize(("left", "lacking"), [("imu", "beside an inertial unit"), ("gps", "needs")])
def test_a_flight_without_a_sensor_is_refused(graph, left, lacking):
    f = flight()
    with pytest.raises(DataError, match=f"lacks what {graph.name} needs.*{lacking if left == 'imu' else ''}"):
        graph.case(dataclasses.replace(f, streams={left: f.streams[left]}))


def test_a_sensor_of_which_nobody_says_the_noise_is_refused():
    _, sensors, *_ = outdoor_flight(flight(), "test")
    less = dataclasses.replace(sensors, gps2=None)
    with pytest.raises(DeclarationError, match=r"nobody says the noise[\s\S]*gps2="):
        less.noise("gps2")


SUBSETS = [
    subset for n in range(1, len(AIDS) + 1) for subset in itertools.combinations(AIDS, n)
]  # fmt: skip


@pytest.mark.parametrize(
    ("graph", "subsets", "biases"),
    [
        (rbpf_outdoor, [s for s in SUBSETS if len(s) == 1], False),
        (outdoor_eskf, [s for s in SUBSETS if len(s) in (1, 4)], False),
        (rbpf_outdoor, [s for s in SUBSETS if len(s) == 1], True),
        (outdoor_eskf, [s for s in SUBSETS if len(s) == 1], True),
        *(
            pytest.param(graph, SUBSETS, biases, marks=pytest.mark.slow)
            for graph in (rbpf_outdoor, outdoor_eskf)
            for biases in (False, True)
        ),
    ],
)
def test_any_subset_of_the_sensors_will_do(graph, subsets, biases):
    """It builds and runs, finite and, where a receiver is there, near where it should be; slowly, all 31."""
    f = flight(1, 0.7)
    few: dict[str, Any] = {"settle": 0.2, "biases": biases}
    few |= {"particles": 40} if graph is rbpf_outdoor else {}
    for subset in subsets:
        case = graph.case(dataclasses.replace(f, streams={n: f.streams[n] for n in ("imu", *subset)}), **few)
        result = simulate(case.graph, case.inputs)
        assert {n for n in AIDS if f"{n}_innovation" in result.series} == set(subset)
        belief = result["belief"]
        assert np.isfinite(belief["covariance"]).all(), subset
        found = result["biases"]["mean"] if "biases" in result.series else belief.leaves.get("gyro_bias")
        assert (found is not None) == biases, subset
        assert found is None or np.isfinite(found).all(), subset
        score = case.score(result)
        assert score["position_rmse_m"] < (1.5 if {"gps", "gps2"} & set(subset) else 3.0), subset
        told = " ".join(case.notes)
        assert ("heading at the start" in told) == ("magnetometer" not in subset)
        assert ("position at the start" in told) == (not {"gps", "gps2"} & set(subset))


def test_a_start_that_nobody_tells_says_how_little_it_knows():
    f = dataclasses.replace(flight(1, 1.0), truth=None)
    case = outdoor_eskf.case(dataclasses.replace(f, streams={n: f.streams[n] for n in ("imu", "altimeter")}))
    told = " ".join(case.notes)
    assert "for all that is known: no receiver" in told
    assert "the heading at the start is 0" in told
    _, _, start, _ = outdoor_flight(
        dataclasses.replace(f, streams={n: f.streams[n] for n in ("imu", "altimeter")}), "t"
    )
    assert start.spread.position == 100.0
    assert start.spread.heading == np.pi


@pytest.mark.slow
@pytest.mark.parametrize("graph", [rbpf_outdoor, outdoor_eskf])
@pytest.mark.parametrize("subset", [("gps",), ("magnetometer", "altimeter"), ("gps2", "optical_flow")])
def test_a_subset_is_equal_in_all_engines(graph, subset):
    pytest.importorskip("jax")
    f = flight(0, 0.6)
    few: dict[str, Any] = {"particles": 30} if graph is rbpf_outdoor else {}
    case = graph.case(dataclasses.replace(f, streams={n: f.streams[n] for n in ("imu", *subset)}), **few)
    engines_agree(case.graph, case.inputs)


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
    _, sensors, *_ = outdoor_flight(flight(), "test")
    assert isinstance(sensors, OutdoorSensors)
    with pytest.raises(DeclarationError, match=r"cannot be used[\s\S]*gps=0.0"):
        dataclasses.replace(sensors, gps=0.0)
