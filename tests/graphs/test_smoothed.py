"""Every filter over a model is smoothed by a setting: better than the filter, and the same in all engines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DeclarationError, Flight, Series, load_flight, simulate
from flowgraph.blocks.kalman import backwards, forwards, rauch_tung_striebel, sizes_of, smoother
from flowgraph.data.registry import find_graph
from flowgraph.graphs.benches import engine_of
from flowgraph.graphs.benches.thesis import Noise, bound_of, fly, smoothed_errors
from tests.graphs.estimation import smooth
from tests.graphs.test_outdoor import flight as outdoor
from tests.recordings import recordings

POSES = ("ekf", "ukf", "ins_eskf", "ins_ekf_pose", "ins_ukf_pose")


def made(name: str, duration: float = 2.5, **settings: object) -> Case:
    flight = {"outdoor_eskf": lambda: outdoor(0, duration), "tracker": lambda: load_flight("sim:plane")}
    return find_graph(name).case(flight.get(name, lambda: smooth(1, duration))(), **settings)


def scored(case: Case) -> dict[str, float]:
    return case.score(simulate(case.graph, case.inputs))


@pytest.mark.parametrize("name", [*POSES, "outdoor_eskf", "tracker"])
def test_a_run_is_smoothed_by_a_setting(name):
    plain = made(name)
    case = made(name, smooth="rts", lag=0.4)
    score = scored(case)
    assert score["position_rmse_m"] == scored(plain)["position_rmse_m"]  # the filter is as it was
    assert score["smoothed_position_rmse_m"] < score["position_rmse_m"]
    if name != "outdoor_eskf":  # whose receivers all err alike over a short flight
        assert score["smoothed_position_rmse_m"] < score["lagged_position_rmse_m"] < score["position_rmse_m"]
        assert score["smoothed_position_rmse_m"] < 0.85 * score["position_rmse_m"]
    if name != "tracker":
        assert score["smoothed_attitude_rmse_deg"] < 1.1 * score["attitude_rmse_deg"]
        assert {"smoothed_tilt_rmse_deg", "smoothed_heading_rmse_deg"} <= set(score)
    assert 0.2 < score["smoothed_nees_mean"] / score["nees_mean"] < 3.0
    assert not any(key.startswith(("smoothed", "lagged")) for key in scored(plain))


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) for n in POSES[:4]] + ["tracker"])
def test_a_batch_is_no_worse_than_the_smoother(name):
    """And of a linear model it is the smoother."""
    rts, batch = (scored(made(name, 1.8, smooth=how)) for how in ("rts", "batch"))
    assert batch["smoothed_position_rmse_m"] < 1.02 * rts["smoothed_position_rmse_m"]
    assert batch["smoothed_position_rmse_m"] < 0.85 * batch["position_rmse_m"]
    if name == "tracker":
        for key in ("smoothed_position_rmse_m", "smoothed_nees_mean"):
            assert batch[key] == pytest.approx(rts[key], rel=1e-9)


def test_a_loss_is_a_setting_of_a_batch():
    flight = load_flight("sim:plane")
    seen = flight.streams["position"]
    places = seen["position"] + 9.0 * (np.arange(len(seen)) % 6 == 3)[:, None]
    wrong = Series(seen.time, seen.values.replace(position=places), name="position")
    bad = Flight(flight.name, {"position": wrong}, flight.truth, flight.info)
    plain, robust = (
        scored(find_graph("tracker").case(bad, smooth="batch", loss=loss)) for loss in ("none", "huber")
    )
    assert robust["smoothed_position_rmse_m"] < 0.6 * plain["smoothed_position_rmse_m"]


def test_the_smoother_of_a_pose_filter_is_a_pipeline_too():
    case = made("ukf", 1.5, smooth="rts")
    result = simulate(case.graph, case.inputs)
    score: Any = case.score
    prior, posterior, cross, space, _ = score.steps(result)
    host = rauch_tung_striebel(prior, posterior, cross, space=space)
    graph = smoother.build(space=space, sizes=sizes_of(space))
    for engine in ("python", "reference", "c"):
        played = simulate(graph, {"step": backwards(prior, posterior, cross)}, engine=engine)
        found = forwards(played["smoothed"])
        np.testing.assert_allclose(found["mean"], host["mean"], atol=1e-9, err_msg=engine)
        np.testing.assert_allclose(found["covariance"], host["covariance"], atol=1e-9, err_msg=engine)


def test_what_has_no_batch_says_so():
    with pytest.raises(DeclarationError, match=r"this graph has no batch estimate[\s\S]*smooth=rts"):
        made("outdoor_eskf", smooth="batch")
    with pytest.raises(DeclarationError, match="no smoother that goes back"):
        made("tracker", smooth="rts", method="imm")
    with pytest.raises(DeclarationError, match=r"particles have no smoother[\s\S]*smoothed_cloud"):
        made("tracker", lag=0.5, method="particles")


@pytest.mark.slow
def test_smoothed_runs_are_honest_and_at_their_bound():
    """Over 12 flights of the thesis, a mean NEES each: 9 within their spread (over 24, 9.2 and 0.25)."""
    noise = Noise.of("HHH")
    flown = [fly(seed, noise) for seed in range(12)]
    errors = smoothed_errors("eskf", flown, noise, engine_of("auto", many=True))
    off = abs(errors.nees.mean() - 9.0)
    assert off < 2.5 * errors.nees.std(ddof=1) / np.sqrt(len(flown))
    assert off < 0.9
    found = np.sqrt([errors.position.mean(), errors.attitude.mean()])
    np.testing.assert_allclose(found / bound_of(flown, noise, smoothing=True), 1.0, atol=0.08)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "position", "tilt", "heading"), [("rts", 1.2, 0.15, 0.55), ("batch", 0.7, 0.12, 0.4)]
)
def test_on_a_real_flight_it_is_a_millimetre(how, position, tilt, heading):
    settings = {"leica.time_offset": "-0.135"}
    flight = load_flight(f"euroc:{recordings('euroc') / 'MH_01_easy'}", settings=settings)
    case = find_graph("ins_eskf").case(flight, smooth=how)
    score = case.score(simulate(case.graph, case.inputs, engine="c"))
    assert 1e3 * score["smoothed_position_rmse_m"] < position
    assert score["smoothed_tilt_rmse_deg"] < tilt
    assert score["smoothed_heading_rmse_deg"] < heading
