"""Readings that cannot be, in every graph that takes an inertial unit: spikes, gaps, NaN, jumps of stamps.

Four seconds after a fault the error is within twice its usual value, or the run says by name what happened;
it always does the latter. The default suite plays the quick graphs; `pytest -m slow
tests/graphs/test_faults.py` plays the others.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    DataError,
    DeclarationError,
    Flight,
    Series,
    find_graph,
    load_flight,
    simulate,
)
from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.models.pose import start_pose
from flowgraph.blocks.signals import Imu, Pose
from flowgraph.cli.options import case_of
from flowgraph.data.registry import graph_names
from flowgraph.graphs.benches import fault_kinds as kinds
from flowgraph.graphs.benches.fault_kinds import HOUR
from flowgraph.types import unflatten
from tests.graphs.estimation import engines_agree
from tests.graphs.library import OWN

BEGINS, OVER, LASTS = 2.0, 6.0, 9.0
"""s after the first reading: the fault, from when on errors count, and the end."""

NOT_INERTIAL = {"tag_pose", "particle", "imu_calibration", "attitude_mekf", "tracker"}
"""They take images, velocities in the plane, counts of converters, and commanded rates, ranges."""

QUICK = {
    "async_kalman", "augmented_complementary", "ekf", "gyro_integration", "ins_eskf", "kalman",
    "orientation_complementary", "roll_pitch",
}  # fmt: skip
GRAPHS = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
    for name in graph_names()
    if name not in NOT_INERTIAL
]


@cache
def flown(name: str) -> tuple[Flight, dict[str, Any]]:
    """A flight that a graph takes, and settings of the graph."""
    data, settings = OWN.get(name, ("sim", ["imu.rate=100"]))
    few = [s for s in settings if s.startswith("particles")]
    _, flight = case_of(name, data, [f"duration={LASTS:g}", *settings], 0)
    return flight, {"particles": 200} if few else {}


def with_leaves(series: Series, leaves: dict[str, np.ndarray], *, gaps: bool = False) -> Series:
    values = unflatten(series.type, iter([leaves[name] for name in series.leaves]))
    return Series(series.time, values, type=series.type, name=series.name, gaps=gaps)


def spike(flight: Flight) -> Flight:
    """One reading of each control that is off by 200 rad/s, and by some hundreds of m/s^2."""
    return kinds.faulty(flight, kinds.controls_of(flight), kinds.spikes, BEGINS, 1, 10.0)


def nan(flight: Flight) -> Flight:
    return kinds.faulty(flight, kinds.controls_of(flight), kinds.nan, BEGINS, 0.01)


def gap(flight: Flight, *, length: float = 1.0) -> Flight:
    return kinds.faulty(flight, kinds.controls_of(flight), kinds.gap, BEGINS, length)


def aid(flight: Flight) -> Flight:
    return kinds.faulty(flight, kinds.aids_of(flight), kinds.gap, BEGINS, 3.0)


def jump(flight: Flight, *, at: float = BEGINS) -> Flight:
    return kinds.jump(flight, at)


SAID = {
    "spike": ("warning: ", "beyond"),
    "nan": ("", "finite"),
    "gap": ("bridged: ", "a gap of 1.01 s"),
    "jump": ("bridged: ", "a pause of 3600.01 s"),
}
"""How a note on a fault begins, and what else is in it."""

UNSEEN = {
    *((name, fault) for name in ("gyro_integration", "complementary") for fault in ("spike", "gap")),
    *(("ins_ukf_velocity", fault) for fault in ("spike", "gap", "aid", "jump")),
}
"""Faults that last, since no sensor tells what turned while nobody looked (`gyro_integration`, the heading of
`complementary`), or where the body went (`ins_ukf_velocity`)."""

UNGATED = {
    "ins_eskf", "ins_ekf_pose", "ins_ukf_pose", "ins_particle", "rbpf_outdoor", "outdoor_eskf", "marg",
    "quaternion_ukf", "kalman", "async_kalman", "augmented_complementary", "gnss_ins",
}  # fmt: skip
"""Filters in which a spike that neither a range nor a gate refuses lasts: it throws them off by 30 m/s and
3 rad, and a filter that believes each measurement takes it for a bias, or one of the aids for a liar."""

SLOWER = {"outdoor_eskf": 3.0, "gnss_ins": 3.0, "rbpf_outdoor": 10.0}
"""How many times the usual error is right after a spike: the usual one is the mean of a dozen readings of a
receiver, and a small cloud that was thrown comes back by the grace of its draws; it warns of it."""


def key_of(score: dict[str, float]) -> str:
    keys = ("position_rmse_m", "attitude_rmse_deg", "total_rmse_deg")
    return next(key for key in keys if key in score)


def played(name: str, flight: Flight, **settings: Any) -> tuple[dict[str, float], tuple[str, ...]]:
    """The score, errors counted from OVER on, and the notes; the estimate is finite."""
    truth = flight.truth
    assert truth is not None
    jumped = HOUR if np.diff(truth.time).max() > 1e12 else 0.0
    case = find_graph(name).case(flight, settle=OVER + jumped, **flown(name)[1], **settings)
    result = simulate(case.graph, case.inputs)
    assert case.estimate is not None
    for leaf in result[case.estimate].leaves.values():
        assert np.isfinite(leaf).all()
    return case.score(result), case.remarks(result)


@cache
def usual(name: str) -> dict[str, float]:
    return played(name, flown(name)[0])[0]


def gates(name: str) -> list[dict[str, Any]]:
    prepare = find_graph(name).prepare
    assert prepare is not None
    return [{}, {"gate": 0.999}] if "gate" in prepare.__annotations__ else [{}]


@pytest.mark.parametrize("fault", [spike, nan, gap, aid, jump], ids=lambda fault: fault.__name__)
@pytest.mark.parametrize("name", GRAPHS)
def test_a_fault_is_over_soon_or_said(name, fault):
    kind = fault.__name__
    made = fault(flown(name)[0])
    for settings in gates(name):
        if "optical_flow" in made.streams and kind in ("aid", "jump"):
            with pytest.raises(DataError, match="optical flow has a gap"):
                played(name, made, **settings)
            continue
        score, notes = played(name, made, **settings)
        if kind in SAID and (name, kind) != ("roll_pitch", "jump"):  # it remembers nothing
            begins, holds = SAID[kind]
            assert any(note.startswith(begins) and holds in note for note in notes), notes
        if (name, kind) in UNSEEN or (kind == "spike" and not settings and name in UNGATED):
            assert any(note.startswith(("bridged: ", "warning: ")) for note in notes)
        else:
            key = key_of(score)
            more = SLOWER.get(name, 2.0) if kind == "spike" else 2.0
            assert score[key] < more * usual(name)[key]


@pytest.mark.parametrize("name", GRAPHS)
def test_a_range_refuses_a_spike(name):
    """What is beyond the range of the sensor is absent, and counted."""
    flight = flown(name)[0]
    ranges = {"gyro_range": 35.0}
    if name != "orientation_complementary":  # it has no accelerometer
        ranges["specific_force_range"] = 160.0
    score, notes = played(name, spike(flight), **ranges)
    key = key_of(score)
    assert score[key] < 2.0 * usual(name)[key]
    (said,) = [note for note in notes if note.startswith("refused: ") and "gyro.range=35 rad/s" in note]
    assert "1 of " in said
    assert not any(note.startswith("warning: ") and "refuses such" in note for note in notes)


# -- what is not a number --------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [[150], [0], [150, 151, 300, 500]])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_control_that_is_not_finite_is_one_that_did_not_come(rows, value):
    base = flown("ins_eskf")[0]
    imu = base.streams["imu"]
    gyro = np.array(imu["gyro"])
    gyro[rows, 1] = value
    broken = with_leaves(imu, {**imu.leaves, "gyro": gyro}, gaps=True)
    kept = np.ones(len(imu), dtype=bool)
    kept[rows] = False
    results = []
    for series in (broken, imu[kept]):
        case = find_graph("ins_eskf").case(replace(base, streams={**base.streams, "imu": series}))
        results.append(simulate(case.graph, case.inputs)["belief"])
    for leaf, values in results[0].leaves.items():
        np.testing.assert_array_equal(values, results[1][leaf])


def test_a_nan_that_nobody_said_is_data_is_refused():
    base = flown("ekf")[0]
    imu = base.streams["imu"]
    force = np.array(imu["specific_force"])
    force[200] = np.nan
    case = find_graph("ekf").case(
        replace(
            base, streams={**base.streams, "imu": with_leaves(imu, {**imu.leaves, "specific_force": force})}
        )
    )
    with pytest.raises(DataError, match="a value is not finite"):
        simulate(case.graph, case.inputs)


def test_a_unit_that_reads_nothing_is_refused():
    base = flown("ekf")[0]
    imu = base.streams["imu"]
    none = with_leaves(imu, {n: np.full_like(v, np.nan) for n, v in imu.leaves.items()}, gaps=True)
    with pytest.raises(
        DataError, match=r"no reading of imu is left for ekf[\s\S]*901 of 901 readings are not"
    ):
        find_graph("ekf").case(replace(base, streams={**base.streams, "imu": none}))


def in_part(base: Flight, field: str, columns: list[int], first: int) -> Flight:
    """The flight whose motion capture does not see some entries of a field, but in its first rows."""
    vicon = base.streams["vicon"]
    values = np.array(vicon[field])
    values[first:, columns] = np.nan
    return replace(
        base,
        streams={**base.streams, "vicon": with_leaves(vicon, {**vicon.leaves, field: values}, gaps=True)},
    )


@pytest.mark.parametrize(("field", "columns", "parts"), [
    ("position", [0], 5.0), ("position", [0, 1, 2], 3.0), ("attitude", [2], 3.0),
])  # fmt: skip
@pytest.mark.parametrize("name", [
    "ekf", pytest.param("ukf", marks=pytest.mark.slow), "ins_ekf_pose", "ins_particle", "rbpf_indoor",
])  # fmt: skip
def test_a_measurement_corrects_by_its_finite_entries(name, field, columns, parts):
    made = in_part(flown("ekf")[0], field, columns, 12)
    few = {"ins_particle": {"particles": 100}, "rbpf_indoor": {"particles": 100, "unknown_yaw": False}}
    case = find_graph(name).case(made, **few.get(name, {}))
    result = simulate(case.graph, case.inputs)
    found = result["innovation"]["parts"]
    assert (found[:12] == 6.0).all()
    assert (found[12:] == parts).all()
    belief, truth = result["belief"], made.truth
    assert truth is not None
    seen = [k for k in range(3) if field != "position" or k not in columns]
    rows = np.searchsorted(truth.time, belief.time[-50:])
    off = belief["position"][-50:] - truth["position"][rows]
    assert np.abs(off[:, seen]).max(initial=0.0) < 0.2


def test_a_filter_that_takes_whole_measurements_takes_no_parts():
    base = flown("ekf")[0]
    made = in_part(base, "position", [0], 30)
    case = find_graph("augmented_complementary").case(made)
    assert isinstance(case.inputs, dict)
    assert len(case.inputs["vicon"]) == 30
    assert any(note.startswith("skipped: vicon: ") for note in case.notes)
    assert np.isfinite(simulate(case.graph, case.inputs)["pose"]["position"]).all()


@pytest.mark.slow
def test_the_linear_filter_holds_the_control_of_a_record_that_has_none():
    """At a time of a position, so that the record stays."""
    base = flown("kalman")[0]
    imu, vicon = base.streams["imu"], base.streams["vicon"]
    force = np.array(imu["specific_force"])
    force[np.searchsorted(imu.time, vicon.time[10])] = np.nan
    broken = with_leaves(imu, {**imu.leaves, "specific_force": force}, gaps=True)
    case = find_graph("kalman").case(replace(base, streams={**base.streams, "imu": broken}))
    result = engines_agree(case.graph, case.inputs)
    assert len(result["innovation"]) == len(vicon)
    whole = find_graph("kalman").case(base)
    best = whole.score(simulate(whole.graph, whole.inputs))
    assert case.score(result)["position_rmse_m"] < 1.1 * best["position_rmse_m"]


# -- ranges ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("setting", ["gyro.range", "specific_force.range"])
def test_a_range_is_set_on_the_command_line(setting):
    case, _ = case_of("ins_eskf", "sim", ["duration=3", f"{setting}=10.5"], 0)
    assert any(note.startswith("refused: imu: ") and f"{setting}=10.5" in note for note in case.notes) == (
        setting == "specific_force.range"
    )


def test_a_range_of_what_is_not_read_is_refused():
    flight = flown("orientation_complementary")[0]
    with pytest.raises(DeclarationError, match=r"setting 'specific_force\.range' has nothing to act on"):
        find_graph("orientation_complementary").case(flight, specific_force_range=160.0)
    with pytest.raises(DeclarationError, match="gyro_range"):
        find_graph("ekf").case(flown("ekf")[0], gyro_range=-1.0)
    with pytest.raises(DataError, match=r"no reading of imu is left[\s\S]*specific_force\.range=0\.001"):
        find_graph("ekf").case(flown("ekf")[0], specific_force_range=0.001)


# -- jumps -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["grow", "keep"])
@pytest.mark.parametrize("name", ["ins_eskf", "ekf"])
def test_over_a_pause_of_all_streams_a_belief_stays(name, how):
    case = find_graph(name).case(jump(flown(name)[0], at=2.1), held_noise=how)
    belief = simulate(case.graph, case.inputs)["belief"]
    k = int(np.argmax(np.diff(belief.time))) + 1
    for field in ("position", "velocity", "attitude"):
        np.testing.assert_array_equal(belief[field][k], belief[field][k - 1])
    wider = belief["covariance"][k, 0, 0] > 1.1 * belief["covariance"][k - 1, 0, 0]
    assert wider == (how == "grow")


def test_the_plane_stays_over_a_jump():
    base = load_flight("sim:plane", seed=0, settings={"duration": "9"})
    errors = []
    for flight, settle in ((base, OVER), (jump(base), OVER + HOUR)):
        case = find_graph("particle").case(flight, particles=300, settle=settle)
        errors.append(case.score(simulate(case.graph, case.inputs))["position_rmse_m"])
    assert errors[1] < 2.0 * errors[0]


@pytest.mark.parametrize("name", ["ekf", "gyro_integration", "outdoor_eskf", "marg"])
@pytest.mark.slow
def test_engines_agree_over_faults(name):
    flight = flown(name)[0]
    made = gap(flight, length=0.5)
    case = find_graph(name).case(made if name == "outdoor_eskf" else jump(made))
    engines_agree(case.graph, case.inputs)


@pytest.mark.parametrize("name", ["particle", "rbpf_indoor", "ins_particle", "rbpf_outdoor"])
@pytest.mark.slow
def test_clouds_agree_over_faults(name):
    flight = flown(name)[0]
    made = gap(flight, length=0.5)
    case = find_graph(name).case(made if name == "rbpf_outdoor" else jump(made), particles=30)
    python, reference = (simulate(case.graph, case.inputs, engine=e) for e in ("python", "reference"))
    for leaf, values in python[str(case.estimate)].leaves.items():
        np.testing.assert_array_equal(values, reference[str(case.estimate)][leaf])


# -- no reading yet --------------------------------------------------------------------------------------


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.0, 0.0, -9.81), (0.0, 0.0, -1.62)])
@pytest.mark.parametrize("name", ["ekf", "ukf", "augmented_complementary"])
def test_before_the_first_reading_nothing_accelerates(name, gravity):
    """Poses come before the unit reads; where no force is needed to stay, none is taken for read."""
    from flowgraph.blocks.models.unscented_pose import start_state
    from flowgraph.blocks.signals import PoseEstimate

    level = np.array([1.0, 0.0, 0.0, 0.0])
    time = np.arange(0, 1_000_000_000, 250_000_000)
    still = Pose(position=np.zeros((4, 3)), attitude=np.tile(level, (4, 1)))
    late = Imu(gyro=np.zeros((1, 3)), specific_force=-np.array([gravity]))
    inputs = {"vicon": Series(time, still), "imu": Series(np.array([900_000_000]), late)}
    starts: dict[str, Any] = {
        "ekf": lambda: start_pose(np.zeros(3), level),
        "ukf": lambda: start_state(np.zeros(3), level),
        "augmented_complementary": lambda: PoseEstimate(np.zeros(3), np.zeros(3), level),
    }
    more: dict[str, Any] = {
        "noise": ImuNoise(1e-3, 1e-2, 0.0, 0.0),
        "position_noise": 0.1,
        "attitude_noise": 0.1,
    }
    graph = find_graph(name).build(
        start=starts[name](), gravity=gravity, **({} if name == "augmented_complementary" else more)
    )
    found = simulate(graph, inputs)["pose" if name == "augmented_complementary" else "belief"]
    np.testing.assert_allclose(found["velocity"], 0.0, atol=0.03)
    np.testing.assert_allclose(found["position"], 0.0, atol=0.03)


def parts_of(graph: str, flight: Flight, changes: dict[str, tuple[str, list[int]]], **settings: Any) -> Any:
    """The case of a flight whose streams lack entries of a field in all readings but the first ten."""
    streams = dict(flight.streams)
    for name, (field, columns) in changes.items():
        values = np.array(streams[name][field])
        values[10:, columns] = np.nan
        streams[name] = with_leaves(streams[name], {**streams[name].leaves, field: values}, gaps=True)
    return find_graph(graph).case(replace(flight, streams=streams), **settings)


def test_points_of_the_plane_are_weighed_by_the_entries_there_are():
    base = load_flight("sim:plane", seed=0, settings={"duration": "6"})
    case = parts_of("particle", base, {"position": ("position", [0])}, particles=300)
    belief = simulate(case.graph, case.inputs)["belief"]
    whole = find_graph("particle").case(base, particles=300)
    usual = simulate(whole.graph, whole.inputs)["belief"]
    late, best = (np.sqrt(b["covariance"][-1].diagonal()) for b in (belief, usual))
    assert late[1] < 1.3 * best[1]
    assert late[0] > 1.5 * best[0]
    assert base.truth is not None
    off = np.abs(belief["position"][-1] - base.truth["position"][-1])
    assert (off < 4.0 * late).all()


@pytest.mark.parametrize("changes", [
    {"gps": ("position", [2]), "gps2": ("position", [0, 2]), "magnetometer": ("field", [1])},
    pytest.param({"optical_flow": ("displacement", [0])}, marks=pytest.mark.slow),
    pytest.param({"optical_flow": ("turn", [1]), "gps": ("position", [0, 1, 2])}, marks=pytest.mark.slow),
])  # fmt: skip
def test_the_outdoor_particles_take_the_entries_there_are(changes):
    """Fields, and each half of optical flow, which are of the body, as a whole."""
    data, settings = OWN["rbpf_outdoor"]
    _, base = case_of("rbpf_outdoor", data, ["duration=2", "gps.rate=10", "gps2.rate=10", *settings], 0)
    case = parts_of("rbpf_outdoor", base, changes, particles=60, gate=0.999)
    result = simulate(case.graph, case.inputs)
    for name, (field, columns) in changes.items():
        if field == "position" and len(columns) == 3:
            assert len(result[f"{name}_innovation"]) == 10
            continue
        parts = result[f"{name}_innovation"]["parts"]
        whole = 6 if name == "optical_flow" else 3
        assert (parts[:10] == whole).all()
        assert (parts[10:] == whole - (len(columns) if field == "position" else 3)).all()
    assert case.score(result)["position_rmse_m"] < 0.3
