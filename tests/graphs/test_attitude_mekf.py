"""`attitude_mekf`: it reaches the bound of its two sensors, knows how wrong it is, and refuses outliers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, Flight, Series, load_flight, simulate, simulate_many
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    geodesic_angle,
    multiply,
    to_rotation_vector,
)
from flowgraph.blocks.metrics import nees, posterior_bound
from flowgraph.blocks.orientation import predict_turn, start_turn
from flowgraph.blocks.signals import Attitude, BodyRate
from flowgraph.graphs import attitude_mekf
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn


@cache
def flight(seed: int = 0, world: str = "thesis", **settings: str) -> Flight:
    named = {name.replace("rate_", "rate.").replace("attitude_", "attitude."): v
             for name, v in settings.items()}  # fmt: skip
    sensors = {"sensors": "body_rate,magnetic_attitude"}
    return load_flight(f"sim:{world}", seed=seed, settings={**sensors, **named})


def test_a_step_turns_the_belief_and_its_covariance():
    """By samples of the attitude and the rate: the spread about the estimate, in its own body axes."""
    random = np.random.default_rng(0)
    P = np.diag([1e-4, 4e-4, 9e-4])
    begin = start_turn([0.8, 0.0, 0.6, 0.0])
    w, dt, noise = np.array([2.0, -1.0, 0.5]), 0.3, 0.03
    turned = predict_turn.step(
        type(begin)(mean=begin.mean, covariance=P), BodyRate(rate=w), noise=noise, dt=dt, xp=np
    )
    off = random.multivariate_normal(np.zeros(3), P, 100_000)
    more = random.standard_normal((100_000, 3)) * noise * np.sqrt(dt)
    true = multiply(begin.mean, from_rotation_vector(off, xp=np), xp=np)
    true = multiply(true, from_rotation_vector(w * dt, xp=np), xp=np)
    true = multiply(true, from_rotation_vector(more, xp=np), xp=np)
    error = to_rotation_vector(multiply(conjugate(turned.mean, xp=np), true, xp=np), xp=np)
    np.testing.assert_allclose(error.T @ error / len(error), turned.covariance, atol=2e-5)


def test_it_runs_at_every_reading_of_either():
    case: Any = attitude_mekf.case(flight(duration="2", magnetic_attitude_rate="37"))
    result = simulate(case.graph, case.inputs)
    both = {*case.inputs["body_rate"].time, *case.inputs["magnetic_attitude"].time}
    assert result["belief"].time.tolist() == sorted(both)
    assert result["innovation"].time.tolist() == case.inputs["magnetic_attitude"].time.tolist()
    np.testing.assert_allclose(np.linalg.norm(result["belief"].attitude, axis=-1), 1.0, atol=1e-12)


@pytest.mark.parametrize(("turn", "settings"), [("0", {"gate": 0.999}), ("1", {})])
def test_engines_agree(turn, settings):
    made = flight(duration="2", magnetic_attitude_rate="37", body_rate_turn=turn)
    case = attitude_mekf.case(made, **settings)
    engines_agree(case.graph, case.inputs)


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(attitude_mekf.case(flight(duration="2")), "predict", "update")


def test_it_reaches_the_bound_and_knows_it():
    """Over 20 flights: within 3 % of the posterior Cramér-Rao bound, with a NEES of 3."""
    flights = [flight(seed) for seed in range(20)]
    cases = [attitude_mekf.case(f) for f in flights]
    many = simulate_many(
        cases[0].graph, [c.inputs for c in cases], range(20), engine="c",
        init=[{"belief": start_turn(f.streams["magnetic_attitude"]["attitude"][0])} for f in flights],
    )  # fmt: skip
    found, truth = many["belief"], [f.truth for f in flights if f.truth is not None]
    q = np.stack([t["attitude"] for t in truth])
    settled = found.time >= 1_000_000_000
    error = to_rotation_vector(multiply(conjugate(found.attitude, xp=np), q, xp=np), xp=np)[:, settled]
    turn = multiply(conjugate(q[0, :-1], xp=np), q[0, 1:], xp=np)
    F = np.stack([jacobian(r) for r in to_rotation_vector(turn, xp=np)])
    bound = posterior_bound(
        F, np.eye(3) * 0.1 * 0.005**2, np.eye(3), np.eye(3) * 0.1, start=np.eye(3),
        measured=np.isin(found.time, flights[0].streams["magnetic_attitude"].time),
    )  # fmt: skip
    least = np.trace(bound[settled], axis1=1, axis2=2).mean()  # it is turned only: the same for each flight
    assert 0.97 < np.sqrt(np.mean(np.sum(error**2, axis=-1)) / least) < 1.03
    honest = nees(error, found.covariance[:, settled])
    assert honest.mean() / 3.0 == pytest.approx(1.0, abs=0.05)


def jacobian(turn: np.ndarray) -> np.ndarray:
    """R(Exp(turn))^T, by what it does to each axis."""
    inverse = from_rotation_vector(-turn, xp=np)
    vectors = np.concatenate([np.zeros((3, 1)), np.eye(3)], axis=1)
    moved = multiply(multiply(inverse, vectors, xp=np), conjugate(inverse, xp=np), xp=np)
    return np.asarray(moved[:, 1:].T)


@pytest.mark.parametrize("row", [100, 400])
def test_a_gate_refuses_an_outlier(row):
    """Half a turn off: without a gate it moves the estimate, with one it is refused."""
    plain = flight(duration="10")
    seen = plain.streams["magnetic_attitude"]
    wrong = seen["attitude"].copy()
    wrong[row] = multiply(wrong[row], np.array([0.0, 1.0, 0.0, 0.0]), xp=np)
    streams = {**plain.streams, "magnetic_attitude": Series(seen.time, Attitude(attitude=wrong))}
    struck = Flight(plain.name, streams, plain.truth, plain.info)
    moved = {}
    for gate in (None, 0.9999):
        case, clean = (attitude_mekf.case(f, gate=gate) for f in (struck, plain))
        result = simulate(case.graph, case.inputs)
        apart = geodesic_angle(result.belief.attitude, simulate(clean.graph, clean.inputs).belief.attitude)
        moved[gate] = apart.max()
    assert moved[None] > 1.5 > 2.0 * moved[0.9999]
    assert case.score(result)["nis_rejected"] == 1.0


@pytest.mark.parametrize(("world", "most"), [("roundtrip", 4.5), ("hover", 4.5), ("thesis", 4.5)])
def test_other_worlds(world, most):
    case = attitude_mekf.case(flight(3, world))
    assert case.score(simulate(case.graph, case.inputs))["attitude_rmse_deg"] < most


def test_what_is_missing_is_said():
    with pytest.raises(DataError, match="body_rate") as caught:
        attitude_mekf.case(load_flight("sim"))
    assert "sensors=body_rate,magnetic_attitude" in str(caught.value)
    unsaid = flight(duration="2")
    unsaid = Flight(unsaid.name, unsaid.streams, unsaid.truth, {})
    with pytest.raises(DataError, match="rate_noise"):
        attitude_mekf.case(unsaid)
    assert attitude_mekf.case(unsaid, rate_noise=0.3, attitude_noise=0.3).graph


def without_rates(base: Flight, first: float, last: float) -> Flight:
    """The flight of which nothing comes between these times, s."""

    def cut(series: Series) -> Series:
        return series[(series.seconds <= first) | (series.seconds >= last)]

    return replace(base, streams={name: cut(series) for name, series in base.streams.items()})


def test_a_rate_that_does_not_come_is_less_and_less_believed():
    made = without_rates(flight(duration="4"), 2.0, 2.6)
    found, scores = {}, {}
    for how in ("grow", "keep"):
        case = attitude_mekf.case(made, held_noise=how, settle=2.7)
        result = simulate(case.graph, case.inputs)
        found[how], scores[how] = result["belief"], case.score(result)
        assert any(n.startswith("bridged: body_rate: a gap of 0.6") for n in case.notes)
    before = found["grow"].seconds < 2.0
    np.testing.assert_array_equal(found["grow"]["covariance"][before], found["keep"]["covariance"][before])
    assert scores["grow"]["total_rmse_deg"] < 0.7 * scores["keep"]["total_rmse_deg"]


@pytest.mark.parametrize("gap", [0.3, 1.0])
def test_the_first_attitude_after_a_gap_is_worth_what_the_gap_left(gap):
    """After T s the turn is as uncertain as rate T is: T^2 rad / 2 in the deviation's growth w."""
    made = without_rates(flight(duration="4"), 2.0, 2.0 + gap)
    case = attitude_mekf.case(made)
    innovation = simulate(case.graph, case.inputs)["innovation"]
    k = int(np.searchsorted(innovation.seconds, 2.0 + gap))
    step = np.median(np.diff(made.streams["body_rate"].seconds))
    part = innovation.seconds[k] - innovation.seconds[k - 1] - 4.0 * step
    grown = innovation["covariance"][k, 0, 0] - innovation["covariance"][k - 1, 0, 0]
    assert grown == pytest.approx(2.0 * (part + 4.0 * step - 0.5 * part) * part, rel=0.2)
