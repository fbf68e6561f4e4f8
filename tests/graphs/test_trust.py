"""How far a filter trusts its measurements: outliers that count for less, noise whose size is learned."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import DeclarationError, Flight, Series, find_graph, load_flight, simulate
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.kalman.learned import LEAST, learned_scale
from flowgraph.blocks.signals import KalmanInnovation
from flowgraph.cli.options import case_of
from flowgraph.types import unflatten
from tests.graphs.estimation import engines_agree

CAPTURED = [
    "kalman", "ins_eskf",
    *(pytest.param(n, marks=pytest.mark.slow) for n in ("async_kalman", "ekf", "ukf", "ins_ekf_pose")),
]  # fmt: skip
OTHERS = [
    ("attitude_mekf", "sim:thesis", ("sensors=body_rate,magnetic_attitude",), "magnetic_attitude", 2.0),
    ("gnss_ins", "sim:drive", ("gps.rate=4",), "gps_velocity", 5.0),
    ("outdoor_eskf", "sim:thesis", ("sensors=imu,gps,gps2,altimeter,magnetometer,optical_flow",),
     "altimeter", 5.0),
    ("ins_ukf_velocity", "course", (), "motion", 3.0),
]  # fmt: skip


def with_outliers(flight: Flight, stream: str, by: float) -> Flight:
    """A tenth of the readings, but the first ones, off by so much (m and what its units are, or rad)."""
    series = flight.streams[stream]
    rows = np.random.default_rng(1).random(len(series)) < 0.1
    rows[:4] = False
    leaves = {name: np.array(values) for name, values in series.leaves.items()}
    for name, values in leaves.items():
        if name == "attitude":
            turn = from_rotation_vector(np.array([0.0, 0.0, min(by, 2.0)]), xp=np)
            values[rows] = multiply(values[rows], np.broadcast_to(turn, values[rows].shape), xp=np)
        elif name != "covariance":
            values[rows] += by
    made = Series(series.time, unflatten(series.type, iter(leaves.values())), type=series.type, name=stream)
    return replace(flight, streams={**flight.streams, stream: made})


@cache
def flown(data: str, settings: tuple[str, ...] = ("imu.rate=100",), graph: str = "ekf") -> Flight:
    return case_of(graph, data, ["duration=12", *settings], 0)[1]


def error(name: str, flight: Flight, **settings: Any) -> dict[str, float]:
    case = find_graph(name).case(flight, **settings)
    return case.score(simulate(case.graph, case.inputs))


def of(score: dict[str, float]) -> float:
    return next(score[key] for key in ("position_rmse_m", "attitude_rmse_deg") if key in score)


@pytest.mark.parametrize("robust", ["huber", "student_t"])
@pytest.mark.parametrize("name", CAPTURED)
def test_a_flight_full_of_outliers_is_nearly_as_good(name, robust):
    """A tenth of the poses is off by 3 m and 2 rad; a Kalman filter believes them."""
    clean = flown("sim")
    dirty = with_outliers(clean, "vicon", 3.0)
    usual, spoilt, mended = (
        of(error(name, f, robust=r)) for f, r in ((clean, "none"), (dirty, "none"), (dirty, robust))
    )
    assert spoilt > 20.0 * usual
    assert mended < (3.0 if robust == "student_t" else 8.0) * usual
    assert of(error(name, clean, robust=robust)) < 1.2 * usual


@pytest.mark.slow
@pytest.mark.parametrize(("name", "data", "settings", "stream", "by"), OTHERS)
def test_other_sensors_have_outliers_too(name, data, settings, stream, by):
    clean = flown(data, settings, name)
    dirty = with_outliers(clean, stream, by)
    spoilt, mended = (of(error(name, dirty, robust=r)) for r in ("none", "student_t"))
    assert mended < 0.8 * spoilt
    assert mended < 1.6 * of(error(name, clean))


@pytest.mark.parametrize(
    "name", ["kalman", *(pytest.param(n, marks=pytest.mark.slow) for n in ("ekf", "ins_eskf"))]
)
@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_noise_that_is_told_wrong_is_learned(name, factor):
    """By the means of five flights."""
    scores: list[list[dict[str, float]]] = []
    for seed in range(5):
        flight = load_flight("sim", seed=seed, settings={"duration": "30", "imu.rate": "100"})
        noise = factor * flight.info["position_noise"]
        kinds: Any = ({"position_noise": noise}, {"position_noise": noise, "adaptive": 20.0}, {})
        scores.append([error(name, flight, settle=8.0, **s) for s in kinds])
    told, learned, right = (np.mean([of(s[k]) for s in scores]) for k in range(3))
    assert learned < 1.4 * right or learned < 0.95 * told
    if factor < 1.0:
        assert np.mean([s[1]["nees_mean"] for s in scores]) < 0.8 * np.mean(
            [s[0]["nees_mean"] for s in scores]
        )
    key = next(key for key in scores[0][0] if key.endswith("nis_mean"))
    off = np.abs(np.log([[s[k][key] for s in scores] for k in range(2)])).mean(axis=1)
    assert off[1] < 0.6 * off[0]


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"robust": "huber", "adaptive": 30.0}, {"robust": "student_t"}])
@pytest.mark.parametrize("name", ["ekf", "ins_eskf", "ukf"])
def test_engines_agree(name, settings):
    flight = load_flight("sim", seed=0, settings={"duration": "2", "imu.rate": "100"})
    case = find_graph(name).case(with_outliers(flight, "vicon", 3.0), gate=0.9999999, **settings)
    engines_agree(case.graph, case.inputs)


def test_a_record_without_a_measurement_is_no_outlier():
    """`kalman` has such records: with no part, there is nothing to weigh."""
    score = error("kalman", flown("sim"), robust="huber")
    assert of(score) < 0.03


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(DeclarationError, match="none or huber or student_t"):
        find_graph("ekf").case(flown("sim"), robust="cauchy")
    with pytest.raises(DeclarationError, match=r"'adaptive' is too small[\s\S]*above 1"):
        find_graph("ekf").case(flown("sim"), adaptive=1.0)


def test_a_scale_follows_the_nis():
    def after(nis: float, *, accepted: bool = True, parts: float = 3.0, scale: float = 2.0) -> float:
        innovation = KalmanInnovation(
            residual=np.zeros(3), covariance=np.eye(3), nis=np.float64(nis),
            parts=np.float64(parts), accepted=np.bool_(accepted),
        )  # fmt: skip
        return float(learned_scale.step(np.float64(scale), innovation, memory=10.0, xp=np))

    assert after(3.0) == 2.0
    assert after(6.0) == pytest.approx(2.2)
    assert after(0.0) == pytest.approx(1.8)
    assert after(6.0, accepted=False) == 2.0
    assert after(0.0, parts=0.0) == 2.0
    assert after(1e9) == pytest.approx(2.0 * 1.9)
    assert after(0.0, scale=LEAST) == LEAST
