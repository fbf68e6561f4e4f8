"""Filters that lose track: gates that shut, controls that do not come, and how they find back."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Flight, Series, find_graph, load_flight, simulate
from flowgraph.blocks.geometry import from_rotation_vector, multiply, rotate
from flowgraph.blocks.kalman import Held, bridge
from flowgraph.blocks.signals import Attitude, Gaussian, Pose, Position, Velocity
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn

GATED = ("ins_eskf", "ekf", "ukf", "ins_ekf_pose", "ins_ukf_pose")
"""Filters of a pose that can refuse a measurement."""


@cache
def flight(duration: float = 6.0, seed: int = 1) -> Flight:
    return load_flight("sim", seed=seed, settings={"duration": str(duration)})


def with_stream(base: Flight, name: str, series: Series) -> Flight:
    return replace(base, streams={**base.streams, name: series})


def changed(series: Series, **fields: Any) -> Series:
    """The series with other values in some of its fields."""
    values = {n: np.array(getattr(series.values, n)) for n in series.values._fields} | fields
    return Series(series.time, type(series.values)(**values), name=series.name)


def outliers(base: Flight, rows: slice, by: float) -> Flight:
    """The flight with poses that are off by `by` metres in some rows."""
    position = np.array(base.streams["vicon"]["position"])
    position[rows] += by
    return with_stream(base, "vicon", changed(base.streams["vicon"], position=position))


def refused(score: dict[str, float]) -> float:
    return sum(value for key, value in score.items() if key.endswith("nis_rejected"))


@pytest.mark.parametrize("name", ["kalman", *GATED])
def test_a_gate_refuses_what_is_too_far_off_to_be_squared(name):
    base = flight(2.0)
    case = find_graph(name).case(outliers(base, slice(4, 5), 1e160), gate=0.999)
    result = simulate(case.graph, case.inputs)
    usual = find_graph(name).case(base, gate=0.999)
    score, right = case.score(result), usual.score(simulate(usual.graph, usual.inputs))
    assert refused(score) >= 1
    assert score["position_rmse_m"] < 1.5 * right["position_rmse_m"]


@pytest.mark.slow
@pytest.mark.parametrize("name", GATED)
@pytest.mark.parametrize("wrong", [1, 3])
def test_the_count_of_refusals_is_that_of_the_run(name, wrong):
    made = outliers(flight(), slice(-wrong, None), 30.0)
    case = find_graph(name).case(made, gate=0.9999999)
    assert refused(case.score(simulate(case.graph, case.inputs))) == wrong
    open_ = find_graph(name).case(made)
    assert refused(open_.score(simulate(open_.graph, open_.inputs))) == 0.0


def test_a_count_knows_of_positions_and_attitudes_apart():
    base = flight()
    q = np.array(base.streams["vicon"]["attitude"])
    q[-2:] = q[-2:][:, [1, 0, 3, 2]]  # half a turn
    made = with_stream(base, "vicon", changed(base.streams["vicon"], attitude=q))
    case = find_graph("ins_eskf").case(made, gate=0.9999999)
    score = case.score(simulate(case.graph, case.inputs))
    assert (score["position_nis_rejected"], score["attitude_nis_rejected"]) == (0.0, 2.0)


def refused_in_a_row(name: str, rows: int) -> tuple[str, ...]:
    case = find_graph(name).case(outliers(flight(), slice(-rows, None), 30.0), gate=0.9999999)
    return tuple(n for n in case.remarks(simulate(case.graph, case.inputs)) if n.startswith("refused:"))


@pytest.mark.parametrize("name", ["ins_eskf", "ekf", "ins_ukf_pose"])
def test_refusals_in_a_row_are_a_note(name):
    assert not [said for said in refused_in_a_row(name, 3) if "in a row" in said]
    (said,) = refused_in_a_row(name, 6)
    assert "measurements in a row" in said


# -- truths with gaps, and truths of a part --------------------------------------------------------------


def masked(base: Flight, rows: slice, fields: tuple[str, ...]) -> Flight:
    """The flight whose truth is NaN in some rows."""
    assert base.truth is not None
    new = {name: np.array(base.truth[name]) for name in fields}
    for values in new.values():
        values[rows] = np.nan
    return replace(base, truth=changed(base.truth, **new))


def cut(base: Flight, rows: slice) -> Flight:
    """The flight whose truth lacks some rows."""
    assert base.truth is not None
    kept = np.ones(len(base.truth), dtype=bool)
    kept[rows] = False
    return replace(base, truth=base.truth[kept])


GAP = slice(600, 900)  # of a truth at 200 Hz: 1.5 s


@pytest.mark.parametrize("hole", [
    lambda base: cut(base, GAP),
    lambda base: masked(base, GAP, ("position",)),
    lambda base: masked(base, GAP, ("attitude",)),
])  # fmt: skip
@pytest.mark.parametrize("name", ["ins_eskf", "ekf", "gyro_integration"])
def test_nothing_is_compared_across_a_gap_of_the_truth(name, hole):
    case = find_graph(name).case(hole(flight()))
    whole = find_graph(name).case(flight())
    result = simulate(case.graph, case.inputs)
    score, full = case.score(result), whole.score(simulate(whole.graph, whole.inputs))
    for key in ("position_rmse_m", "attitude_rmse_deg", "total_rmse_deg"):
        if key in score:
            assert score[key] < 1.2 * full[key]
    left = int(full["compared_ticks"] - score["compared_ticks"])
    assert left in (300, 301)  # the row after one that is NaN is not told from its neighbours
    assert any(n.startswith(f"skipped: truth: {left} ticks (1.5") for n in case.remarks(result))


def test_a_truth_of_few_rows_is_compared_all_along():
    base = flight()
    assert base.truth is not None
    sparse = replace(base, truth=base.truth[::100])  # 2 Hz
    case = find_graph("ins_eskf").case(sparse)
    result = simulate(case.graph, case.inputs)
    assert case.score(result)["compared_ticks"] == 1001
    assert not [n for n in case.remarks(result) if "truth:" in n]


def told(base: Flight, *fields: str) -> Flight:
    """The flight with a truth of these fields alone."""
    kinds: dict[str, Any] = {"attitude": Attitude, "position": Position, "velocity": Velocity}
    assert base.truth is not None
    if fields == ("position", "attitude"):
        values: Any = Pose(base.truth["position"], base.truth["attitude"])
    else:
        values = kinds[fields[0]](base.truth[fields[0]])
    return replace(base, truth=Series(base.truth.time, values, name="truth"))


FIGURES = {"position": "position_rmse_m", "attitude": "attitude_rmse_deg", "velocity": "velocity_rmse_mps"}


@pytest.mark.parametrize("fields", [("attitude",), ("position",), ("velocity",), ("position", "attitude")])
@pytest.mark.parametrize("name", ["ins_eskf", "ekf", "ukf", "ins_ukf_pose", "complementary", "async_kalman"])
def test_a_truth_of_a_part_is_compared_in_that_part(name, fields):
    if name == "async_kalman" and "attitude" not in fields:
        with pytest.raises(DataError, match="the acceleration in the world is not known"):
            find_graph(name).case(told(flight(), *fields))
        return
    case = find_graph(name).case(told(flight(), *fields))
    result = simulate(case.graph, case.inputs)
    score, notes = case.score(result), case.remarks(result)
    has = set(result[case.estimate].leaves)
    for name_, figure in FIGURES.items():
        assert (figure in score) == (name_ in fields and name_ in has), figure
    for name_ in {"position", "attitude"} & has - set(fields):
        assert f"skipped: the truth has no {name_}: errors of it are left out" in notes


# -- first readings that cannot start a filter -----------------------------------------------------------


@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("reading", [0.0, 1e-9])
@pytest.mark.parametrize("name", ["ins_eskf", "gyro_integration", "complementary", "quaternion_ukf"])
def test_a_first_reading_of_no_force_is_passed_over(name, reading, rows):
    base = flight(3.0)
    force = np.array(base.streams["imu"]["specific_force"])
    force[:rows] = reading
    case = find_graph(name).case(with_stream(base, "imu", changed(base.streams["imu"], specific_force=force)))
    whole = find_graph(name).case(base)
    key = "attitude_rmse_deg" if name in ("ins_eskf", "complementary") else "total_rmse_deg"
    scores = [c.score(simulate(c.graph, c.inputs))[key] for c in (case, whole)]
    assert scores[0] == pytest.approx(scores[1], abs=0.5)


@pytest.mark.parametrize("name", ["ins_eskf", "gyro_integration", "complementary"])
def test_no_force_at_all_is_refused(name):
    base = flight(3.0)
    force = np.zeros((len(base.streams["imu"]), 3))
    with pytest.raises(DataError, match="no reading of the accelerometer shows where up is"):
        find_graph(name).case(with_stream(base, "imu", changed(base.streams["imu"], specific_force=force)))


def test_a_first_field_of_zero_is_passed_over():
    base = load_flight("sim:thesis", seed=1, settings={"sensors": "all", "duration": "3"})
    field = np.array(base.streams["magnetometer"]["field"])
    field[0] = 0.0
    case = find_graph("marg").case(
        with_stream(base, "magnetometer", changed(base.streams["magnetometer"], field=field))
    )
    found = simulate(case.graph, case.inputs)["belief"]
    assert np.isfinite(found["attitude"]).all()
    assert np.isfinite(found["covariance"]).all()


# -- controls that do not come ---------------------------------------------------------------------------


AIDED = (*GATED, "kalman", "async_kalman")


def without(base: Flight, first: float, last: float, *more: tuple[float, float]) -> Flight:
    """The flight without the readings of its IMU between these times, s."""
    imu = base.streams["imu"]
    t = imu.time * 1e-9
    kept = np.ones(len(imu), dtype=bool)
    for a, b in ((first, last), *more):
        kept &= (t <= a) | (t >= b)
    found = with_stream(base, "imu", imu[kept])
    vicon = found.streams["vicon"]
    on_imu = np.isin(vicon.time, found.streams["imu"].time)  # kalman wants both at once
    return with_stream(found, "vicon", vicon[on_imu])


@pytest.mark.parametrize("gate", [None, 0.999])
@pytest.mark.parametrize(("name", "gap"), [
    *((name, ((2.0, 3.0),)) for name in AIDED),
    *((name, gap) for name in ("ins_eskf", "ekf") for gap in (((2.0, 2.3), (4.0, 4.5)), ((1.5, 4.0),))),
])  # fmt: skip
def test_after_a_gap_of_the_imu_a_filter_is_where_it_was(name, gap, gate):
    """Half a second after the last gap the error is as if there had been none, and the gap is a note.

    A gate takes ten measurements to find back after a long one: `ekf` is thrown off by 2.5 s without readings
    on 7 of 16 seeds, and back on all.
    """
    longest = max(b - a for a, b in gap)
    after = 0.5 if gate is None or longest < 2.0 else 2.5
    base, settle = flight(5.5 + after), gap[-1][1] + after
    case = find_graph(name).case(without(base, *gap[0], *gap[1:]), gate=gate, settle=settle)
    whole = find_graph(name).case(base, gate=gate, settle=settle)
    result = simulate(case.graph, case.inputs)
    score, usual = case.score(result), whole.score(simulate(whole.graph, whole.inputs))
    assert score["position_rmse_m"] < 3.0 * usual["position_rmse_m"] + 0.05
    (said,) = [n for n in case.remarks(result) if n.startswith("bridged:")]
    assert f"{longest:g} s (usual step 0.005 s)" in said


@pytest.mark.slow
@pytest.mark.parametrize("name", GATED)
def test_the_noise_of_a_held_control_can_be_kept(name):
    made = without(flight(), 2.0, 2.9)
    grown, kept = (find_graph(name).case(made, held_noise=how) for how in ("grow", "keep"))
    wide, narrow = (simulate(c.graph, c.inputs)[c.estimate] for c in (grown, kept))
    before = wide.time < 2.0e9
    for field in ("position", "covariance"):
        np.testing.assert_array_equal(wide[field][before], narrow[field][before])
    at = int(np.searchsorted(wide.time, 2.9e9))
    assert wide["covariance"][at, 0, 0] > 10.0 * narrow["covariance"][at, 0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ins_eskf", "ekf", "ins_ukf_pose", "async_kalman"])
def test_engines_agree_over_a_gap_and_a_shut_gate(name):
    made = outliers(without(flight(), 2.0, 2.5), slice(14, 22), 20.0)
    case = find_graph(name).case(made, gate=0.999)
    engines_agree(case.graph, case.inputs)
    is_lowered_and_drawn(case, "bridge", "find_back")


def test_fresh_controls_are_bridged_to_the_bit():
    """A filter that could bridge, over controls that come as they should."""
    made = find_graph("ins_eskf").case(flight())
    assert "bridge" not in {call.path for _, call in made.graph.calls}
    prior = Gaussian(np.zeros(6), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.3)
    age = np.float64(0.0)
    for k in range(5):
        age, after = bridge.step(
            age, prior, None if k % 2 else 1.0, held=Held(0.05), position=0, velocity=3, dt=0.02, xp=np
        )
        np.testing.assert_array_equal(after.covariance, prior.covariance)
    _, after = bridge.step(
        np.float64(0.2), prior, 1.0, held=Held(0.05), position=0, velocity=3, dt=0.3, xp=np
    )
    np.testing.assert_allclose(np.diag(after.covariance - prior.covariance)[3:], 25.0 * 2 * 0.35 * 0.3)
    assert np.linalg.eigvalsh(after.covariance).min() > 0.0


# -- a gate that has shut --------------------------------------------------------------------------------


def spiked(base: Flight, row: int, field: str, by: float) -> Flight:
    values = np.array(base.streams["imu"][field])
    values[row, 0] += by
    return with_stream(base, "imu", changed(base.streams["imu"], **{field: values}))


@pytest.mark.slow
@pytest.mark.parametrize("made", [
    pytest.param(lambda: spiked(flight(16.0), 500, "specific_force", 2000.0), id="a spike of the force"),
    pytest.param(lambda: spiked(flight(16.0), 500, "gyro", 200.0), id="a spike of the rate"),
    pytest.param(lambda: outliers(flight(16.0), slice(8, 20), 50.0), id="a run of outliers"),
])  # fmt: skip
@pytest.mark.parametrize("name", ["ins_eskf", "ekf", "ins_ukf_pose"])
def test_a_gate_opens_again(name, made):
    """Three seconds after the fault, at four poses a second, the error is that of a flight without one."""
    case = find_graph(name).case(made(), gate=0.999, settle=8.0)
    whole = find_graph(name).case(flight(16.0), gate=0.999, settle=8.0)
    score, usual = (c.score(simulate(c.graph, c.inputs)) for c in (case, whole))
    assert score["position_rmse_m"] < 2.0 * usual["position_rmse_m"]
    assert refused(score) >= 5


@pytest.mark.parametrize("rows", [1, 4])
def test_a_few_outliers_change_nothing_but_that_they_are_not_used(rows):
    made = outliers(flight(), slice(10, 10 + rows), 50.0)
    patient, never = (find_graph("ekf").case(made, gate=0.999, patience=p) for p in (5, 1000))
    a, b = (simulate(c.graph, c.inputs)["belief"] for c in (patient, never))
    np.testing.assert_array_equal(a["covariance"], b["covariance"])


# -- where a filter starts -------------------------------------------------------------------------------


def turned(base: Flight, angle: float) -> Flight:
    """The flight with all that is of the world turned about the vertical."""
    about_z = from_rotation_vector(np.array([0.0, 0.0, angle]), xp=np)

    def of(series: Series) -> Series:
        new: dict[str, Any] = {}
        for name in {"position", "velocity"} & set(series.leaves):
            new[name] = rotate(about_z, series[name], xp=np)
        if "attitude" in series.leaves:
            new["attitude"] = multiply(about_z, series["attitude"], xp=np)
        return changed(series, **new) if new else series

    assert base.truth is not None
    streams = {name: of(series) for name, series in base.streams.items()}
    return replace(base, streams=streams, truth=of(base.truth))


def of_positions(base: Flight) -> Flight:
    """The flight with positions in place of poses."""
    vicon = base.streams["vicon"]
    leica = Series(vicon.time, Position(position=vicon["position"]), name="leica")
    return replace(base, streams={"imu": base.streams["imu"], "leica": leica})


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.0, 60.0, 150.0, -100.0])
def test_a_heading_is_found_of_which_nothing_is_known(degrees):
    base = of_positions(turned(flight(20.0, 3), np.radians(degrees)))
    case = find_graph("ins_eskf").case(replace(base, truth=None))
    assert any("nothing is known of the heading" in n for n in case.notes)
    told_ = find_graph("ins_eskf").case(base, settle=15.0)
    result, known = (simulate(c.graph, c.inputs) for c in (case, told_))
    found, best = told_.score(result), told_.score(known)
    assert found["attitude_rmse_deg"] < best["attitude_rmse_deg"] + 0.5


@pytest.mark.parametrize("name", GATED)
@pytest.mark.parametrize(("settings", "said"), [
    ({"start": "truth"}, "assumed: the start is the truth's"),
    ({"start": "file"}, "assumed: the start has the first attitude that was measured"),
    ({"start_heading": 0.3}, "assumed: the heading at the start is 0.3 rad, as it was set"),
])  # fmt: skip
def test_what_was_taken_for_the_start_is_a_note(name, settings, said):
    assert said in find_graph(name).case(flight(), **settings).notes


@pytest.mark.parametrize(("name", "start"), [("ins_eskf", "truth"), ("ins_eskf", "file"), ("ekf", "truth")])
def test_a_start_that_is_not_there_is_refused(name, start):
    base = flight() if start == "truth" else of_positions(flight())
    with pytest.raises(DataError, match="there is no start of this kind for " + name):
        find_graph(name).case(replace(base, truth=None), start=start)
    with pytest.raises(DeclarationError, match="setting 'start' has no such value"):
        find_graph(name).case(base, start="somewhere")
