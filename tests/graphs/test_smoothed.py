"""Every filter over a model is smoothed by a setting: better than the filter, and the same in all engines."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DeclarationError, Flight, Series, load_flight, simulate
from flowgraph.blocks.kalman import backwards, forwards, rauch_tung_striebel, sizes_of, smoother
from flowgraph.cli.options import case_of
from flowgraph.data.registry import find_graph, graph_names
from flowgraph.graphs.benches import engine_of
from flowgraph.graphs.benches.thesis import Noise, bound_of, fly, smoothed_errors
from tests.graphs.estimation import outdoor, smooth
from tests.graphs.library import OWN
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


WORKS = "works"
TABLE = {
    "async_kalman": (WORKS, WORKS),
    "attitude_mekf": (WORKS, WORKS),
    "augmented_complementary": ("its gains are set by hand",) * 2,
    "complementary": ("its gains are set by hand",) * 2,
    "ekf": (WORKS, WORKS),
    "gnss_ins": (WORKS, WORKS),
    "gyro_integration": ("nothing corrects it",) * 2,
    "imu_calibration": ("its last belief is the smoothed one",) * 2,
    "ins_ekf_pose": (WORKS, WORKS),
    "ins_eskf": (WORKS, WORKS),
    "ins_particle": ("moved by the pose too",) * 2,
    "ins_ukf_pose": (WORKS, WORKS),
    "ins_ukf_velocity": (WORKS, WORKS),
    "kalman": (WORKS, WORKS),
    "marg": ("no one belief",) * 2,
    "orientation_complementary": ("its gains are set by hand",) * 2,
    "outdoor_eskf": (WORKS, WORKS),
    "particle": (WORKS, "its start is a cloud"),
    "quaternion_ukf": (WORKS, "calibrated in the run"),
    "rbpf_indoor": ("a Kalman filter of its own",) * 2,
    "rbpf_outdoor": ("a Kalman filter of its own",) * 2,
    "roll_pitch": ("taken by itself",) * 2,
    "tag_pose": ("taken by itself",) * 2,
    "tracker": (WORKS, WORKS),
    "ukf": (WORKS, WORKS),
}
"""Of each graph, what `smooth=rts` (and `lag`) and `smooth=batch` do: work, or refuse with a reason."""


def test_the_table_has_every_graph():
    assert set(TABLE) == set(graph_names())


@pytest.mark.parametrize("name", [n for n in TABLE if n != "imu_calibration"])
@pytest.mark.parametrize("setting", ["smooth=rts", "lag=0.2", "smooth=batch"])
def test_a_setting_works_or_says_why_not(name, setting):
    """That a case is made; the figures are those of the tests about it."""
    said = TABLE[name][setting == "smooth=batch"]
    data, settings = ("course", []) if name == "tag_pose" else OWN.get(name, ("sim", []))
    make = partial(case_of, name, data, ["duration=0.5", *settings, setting], 0)
    if said == WORKS:
        case: Any = make()[0]
        assert case.score.smoothing
    else:
        with pytest.raises(DeclarationError, match=said):
            make()


def test_a_setting_is_refused_from_python_too():
    with pytest.raises(DeclarationError, match=r"cannot be smoothed: its last|cannot be smoothed: nothing"):
        find_graph("gyro_integration").case(smooth(1, 1.0), smooth="rts")


@pytest.mark.parametrize("name", ["kalman", "async_kalman"])
def test_the_batch_of_a_linear_filter_is_its_smoother(name):
    """Where the positions come with the controls, whose steps both then drive alike."""
    rts, batch = (scored(made(name, 1.8, smooth=how)) for how in ("rts", "batch"))
    for key in ("smoothed_position_rmse_m", "smoothed_nees_mean"):
        assert batch[key] == pytest.approx(rts[key], rel=1e-9)
    assert rts["smoothed_position_rmse_m"] < 0.95 * rts["position_rmse_m"]


@pytest.mark.parametrize(
    "name",
    [
        "attitude_mekf", pytest.param("ins_ukf_velocity", marks=pytest.mark.slow), "particle", "imm",
        pytest.param("particles", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_others_are_smoothed_too(name):
    """On average over a few flights: better than the filter, and with `lag` in between or near."""
    figure = {"attitude_mekf": "attitude_rmse_deg", "ins_ukf_velocity": "attitude_rmse_deg"}.get(
        name, "position_rmse_m"
    )
    graph, more = ("tracker", [f"method={name}"]) if name in ("imm", "particles") else (name, [])
    data, settings = OWN.get(graph, ("sim", []))
    settings = [s.replace("particles=60", "particles=300") for s in settings]
    few = ["particles=300"] if name == "particles" else []
    found = []
    for seed in range(3):
        given = ["duration=2.5", *settings, *more, *few, "smooth=rts", "lag=0.4"]
        score = scored(case_of(graph, data, given, seed)[0])
        found.append([score[figure], score[f"smoothed_{figure}"], score[f"lagged_{figure}"]])
    usual, smoothed, lagged = np.sqrt(np.mean(np.square(found), axis=0))
    assert smoothed < 0.97 * usual
    assert lagged < 1.02 * usual


@pytest.mark.slow
def test_the_batch_outdoors_and_of_velocities_is_no_worse_than_the_smoother():
    for name, figure in (
        ("outdoor_eskf", "position_rmse_m"),
        ("ins_ukf_velocity", "attitude_rmse_deg"),
        ("gnss_ins", "position_rmse_m"),
    ):
        data, settings = OWN[name]
        rts, batch = (
            scored(case_of(name, data, ["duration=2", *settings, f"smooth={how}"], 0)[0])[
                f"smoothed_{figure}"
            ]
            for how in ("rts", "batch")
        )
        assert batch < 1.1 * rts, name


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
