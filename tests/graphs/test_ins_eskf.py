"""`ins_eskf`: accurate on both flights, and the same in every engine."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DataError, Flight, Result, Series, find_graph, load_flight, lower, simulate
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.signals import Belief
from tests.support import ENGINES, flat_state, same

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FLOWGRAPH_DATA", ROOT.parent / "shared" / "datasets"))
EUROC = DATA / "euroc" / "MH_01_easy"
needs_euroc = pytest.mark.skipif(
    not EUROC.is_dir(), reason="needs EuRoC MH_01_easy: set FLOWGRAPH_DATA to the folder that holds euroc/"
)


@cache
def sim(duration: float = 4.0, seed: int = 0) -> Case:
    settings = {"duration": str(duration)}
    return find_graph("ins_eskf").case(load_flight("sim", seed=seed, settings=settings))


@cache
def euroc() -> Case:
    flight = load_flight(f"euroc:{EUROC}", settings={"leica.time_offset": "-0.135"})
    return find_graph("ins_eskf").case(flight)


@cache
def played(make: Callable[[], Case], engine: str) -> Result:
    case = make()
    return simulate(case.graph, case.inputs, engine=engine)


@cache
def long_sim() -> Case:
    return sim(20.0)


def equal(a: Result, b: Result) -> None:
    """DESIGN section 5: states within 1e-9 max(1, |x|), covariances within 1e-6 sqrt(P_ii P_jj)."""
    assert a.ticks == b.ticks
    x, y = a["belief"], b["belief"]
    np.testing.assert_array_equal(x.time, y.time)
    for name in ("position", "velocity", "attitude", "gyro_bias", "accelerometer_bias"):
        bound = 1e-9 * np.maximum(1.0, np.abs(x[name]))
        assert (np.abs(x[name] - y[name]) <= bound).all(), name
    variance = np.einsum("nii->ni", x["covariance"])
    scale = np.sqrt(variance[:, :, None] * variance[:, None, :])
    assert (np.abs(x["covariance"] - y["covariance"]) <= 1e-6 * scale).all()
    for name in set(a.series) - {"belief"}:
        np.testing.assert_array_equal(a[name].time, b[name].time)
        np.testing.assert_allclose(a[name]["residual"], b[name]["residual"], rtol=0.0, atol=1e-9)


def test_belief_at_every_tick_and_innovation_where_there_was_a_measurement():
    case = sim()
    result = played(sim, "python")
    flight: Any = case.inputs
    assert result["belief"].time.tolist() == sorted({*flight["imu"].time, *flight["position"].time})
    assert result["position_innovation"].time.tolist() == flight["position"].time.tolist()
    assert result["attitude_innovation"].time.tolist() == flight["attitude"].time.tolist()


@pytest.mark.parametrize("engine", ENGINES[1:])
def test_engines_agree_on_the_simulated_flight(engine):
    equal(played(sim, "python"), played(sim, engine))


def test_accuracy_on_the_simulated_flight():
    score = long_sim().score(played(long_sim, "reference"))
    assert score["position_rmse_m"] <= 0.02
    assert score["tilt_rmse_deg"] <= 0.4
    assert score["attitude_rmse_deg"] <= 0.6
    assert score["position_3sigma"] >= 0.98


def test_innovations_are_as_large_as_the_filter_expects():
    nis = played(long_sim, "reference")["position_innovation"].nis[4:]
    assert 2.0 <= nis.mean() <= 4.2  # 3 on average


def test_attitudes_stay_unit_and_covariances_symmetric_and_positive():
    belief = played(sim, "python")["belief"]
    np.testing.assert_allclose(np.linalg.norm(belief.attitude, axis=-1), 1.0, atol=1e-12)
    P = belief.covariance
    np.testing.assert_array_equal(P, P.mT)
    assert np.linalg.eigvalsh(P).min() > 0.0


def test_measurements_make_it_better():
    case: Any = sim()
    blind = {**case.inputs, "position": case.inputs["position"][:1], "attitude": case.inputs["attitude"][:1]}
    seen, unseen = case.score(played(sim, "python")), case.score(simulate(case.graph, blind))
    assert unseen["position_rmse_m"] > 2.0 * seen["position_rmse_m"]


def test_resumed_in_another_engine_it_ends_where_it_would_have():
    case: Any = sim()
    cut = 2_000_000_000
    head = simulate(case.graph, {n: s[s.time < cut] for n, s in case.inputs.items()}, engine="xla")
    tail = simulate(case.graph, {n: s[s.time >= cut] for n, s in case.inputs.items()}, state=head.state)
    whole = flat_state(played(sim, "python").state)
    for name, array in flat_state(tail.state).items():
        np.testing.assert_allclose(array, whole[name], rtol=1e-9, atol=1e-9, err_msg=name)


def test_in_float32_it_is_nearly_as_good():
    case = sim()
    single = simulate(case.graph, case.inputs, engine="reference", dtype="float32")["belief"]
    double = played(sim, "python")["belief"]
    assert np.abs(single.position - double.position).max() < 0.02
    assert geodesic_angle(single.attitude, double.attitude).max() < 0.1


def test_a_graph_that_was_built_twice_gives_the_same_bits():
    settings = {"duration": "4.0"}
    again = find_graph("ins_eskf").case(load_flight("sim", settings=settings))
    same(played(sim, "python"), simulate(again.graph, again.inputs))


def test_its_state_is_a_belief():
    result = played(sim, "python")
    assert set(result.state["registers"]["belief"]) == set(Belief._fields)


def test_its_pipeline_uses_small_factorizations_as_one_operation():
    ops = [i.op for i in lower(sim().graph).instructions]
    assert ops.count("solve") == 2
    assert lower(sim().graph).faults == ()


def test_a_flight_without_a_position_is_refused():
    imu = load_flight("sim", settings={"duration": "1"}).streams["imu"]
    with pytest.raises(DataError, match="this flight lacks what ins_eskf needs") as error:
        find_graph("ins_eskf").case(Flight("bare", {"imu": imu}))
    assert error.value.got == "imu"


# -- EuRoC ---------------------------------------------------------------------------------------------


@needs_euroc
def test_accuracy_on_euroc():
    score = euroc().score(played(euroc, "python"))
    assert score["position_rmse_m"] <= 0.0075
    assert score["tilt_rmse_deg"] <= 0.4
    assert score["attitude_rmse_deg"] <= 2.4
    assert 0.0 < score["position_3sigma"] <= 1.0
    assert 0.0 < score["tilt_3sigma"] <= 1.0


@needs_euroc
def test_engines_agree_on_the_first_seconds_of_euroc():
    case: Any = euroc()
    start = case.inputs["imu"].time[0]
    inputs = {n: s[s.time < start + 4_000_000_000] for n, s in case.inputs.items()}
    results = [simulate(case.graph, inputs, engine=engine) for engine in ENGINES]
    equal(results[0], results[1])
    equal(results[0], results[2])


@needs_euroc
@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES[1:])
def test_engines_agree_on_the_whole_of_euroc(engine):
    equal(played(euroc, "python"), played(euroc, engine))


def test_series_can_be_cut_by_time():
    imu: Series = sim().inputs["imu"]  # type: ignore[call-overload, index]
    assert len(imu[imu.time < 10_000_000]) == 2
