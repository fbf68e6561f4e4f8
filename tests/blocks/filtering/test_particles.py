"""Particles over any model: beside the exact filter, equal in all engines, and where each proposal helps."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    Array,
    DeclarationError,
    Series,
    Signal,
    Stream,
    UnknownNameError,
    graph,
    lower,
    real,
    simulate,
)
from flowgraph.blocks.filtering import (
    PROPOSALS,
    DiscreteModel,
    LinearMeasurement,
    MeasurementModel,
    MotionModel,
    StateSpace,
    euclidean,
    extended,
    filtered,
    first,
    linear,
    particles,
)
from flowgraph.blocks.signals import Gaussian
from tests.blocks.filtering.test_filtered import PLACE, POINT, driven, point, spots, tracker
from tests.support import all_engines

MS = 1_000_000


class Value(Signal):
    """A number."""

    value: Array = real()


@pytest.mark.parametrize(
    "proposal", ["bootstrap", *(pytest.param(p, marks=pytest.mark.slow) for p in PROPOSALS[1:])]
)
def test_it_is_equal_in_all_engines_lowered_and_drawn(proposal):
    _, inputs = driven(2.0)
    built = tracker.build(method=particles(40, proposal=proposal))
    result = all_engines(built, inputs)
    assert len(result["effective_sample_size"]) == len(inputs["fix"])
    assert {"filter/carry", "filter/resample"} <= {stage.path for stage in lower(built).stages}
    assert "resample" in built.text()


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_the_likelihood_is_the_exact_one_within_its_spread(proposal):
    """Of 12 clouds of 500, the mean of the likelihoods is unbiased."""
    inputs = spots(20)
    exact = simulate(point.build(method=linear()), inputs)
    method = lambda seed: particles(500, proposal=proposal, seed=seed)
    runs = [simulate(point.build(method=method(k)), inputs, seed=k, engine="reference") for k in range(12)]
    expected = exact["log_likelihood"]["value"].sum()
    found = np.array([r["log_likelihood"]["value"].sum() for r in runs])
    ratio = np.exp(found - expected)
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(len(ratio)) + 0.05
    apart = np.mean([r["output"]["mean"] for r in runs], axis=0) - exact["output"]["mean"]
    assert np.abs(apart).max() < 0.35


def _broad(x, z, dt, xp):
    """The motion's own noise, half as wide again, and moved towards what was measured."""
    Q = POINT.discrete(dt, xp, np.float64)[2]
    away = 0.2 * (z - x.position) * dt
    return xp.concat([0.5 * away * dt, away], axis=-1), 2.25 * Q


@pytest.mark.parametrize("proposal", ["bootstrap", "auxiliary"])
def test_with_a_proposal_of_the_users_the_likelihood_is_the_exact_one(proposal):
    inputs = spots(12)
    exact = simulate(point.build(method=linear()), inputs)["log_likelihood"]["value"].sum()
    method = lambda seed: particles(400, proposal=proposal, propose=_broad, seed=seed)
    runs = [simulate(point.build(method=method(k)), inputs, seed=k, engine="reference") for k in range(12)]
    ratio = np.exp([run["log_likelihood"]["value"].sum() - exact for run in runs])
    assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(len(ratio)) + 0.02
    assert ratio.std() < 2.0


@pytest.mark.parametrize("proposal", ["bootstrap", "auxiliary"])
def test_a_proposal_that_is_the_noise_itself_changes_nothing(proposal):
    def own(x, dt, xp):
        return xp.zeros((4,)), POINT.discrete(dt, xp, np.float64)[2]

    inputs = spots(12)
    built = [point.build(method=particles(50, proposal=proposal, propose=f)) for f in (None, own)]
    one, other = (simulate(b, inputs, engine="reference")["output"]["mean"] for b in built)
    np.testing.assert_allclose(other, one, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["bootstrap", "auxiliary"])
def test_a_proposal_of_the_users_is_equal_in_all_engines(proposal):
    all_engines(point.build(method=particles(50, proposal=proposal, propose=_broad), gate=0.999), spots(8))


@pytest.mark.parametrize("proposal", PROPOSALS)
def test_a_gate_refuses_and_finds_its_way_back(proposal):
    jump = {k: (50.0, 50.0) for k in range(20, 40)}
    built = point.build(method=particles(300, proposal=proposal), gate=0.999)
    result = simulate(built, spots(at=jump), engine="reference")
    accepted = result["innovation"]["accepted"]
    assert accepted[:20].all()
    assert not accepted[20:25].any()
    assert accepted[-5:].all()
    assert np.abs(result["output"]["mean"][-1][:2] - 50.0).max() < 2.0
    single = point.build(method=particles(300, proposal=proposal), gate=0.999)
    found = simulate(single, spots(at={20: (50.0, 50.0)}), engine="reference")
    plain = simulate(single, spots(at={20: (np.nan, np.nan)}), engine="reference")
    np.testing.assert_array_equal(found["output"]["mean"][20], found["prior"]["mean"][20])
    assert np.abs(found["output"]["mean"] - plain["output"]["mean"])[:, :2].max() < 0.6


NARROW = DiscreteModel([[1.0]], [[1.0]])
SHARP = LinearMeasurement(NARROW.space, [[1.0]], noise=1e-4)


@graph
def sharp(z: Stream[Value], *, method):
    """A measurement that is much sharper than the prediction."""
    start = Gaussian(mean=np.zeros(1), covariance=np.eye(1))
    return filtered(NARROW, {SHARP: z}, start=start, method=method)


def test_a_guided_cloud_keeps_its_particles_where_a_measurement_is_sharp():
    z = np.cumsum(np.random.default_rng(0).normal(size=30))
    inputs = {"z": Series(np.arange(30) * 100 * MS, Value(value=z))}
    exact = simulate(sharp.build(method=linear()), inputs)
    size, error = {}, {}
    for proposal in ("bootstrap", "guided"):
        result = simulate(sharp.build(method=particles(200, proposal=proposal)), inputs)
        size[proposal] = result["effective_sample_size"]["value"][1:].mean()
        likely = result["log_likelihood"]["value"][1:] - exact["log_likelihood"]["value"][1:]
        error[proposal] = np.abs(likely).mean()
    assert size["guided"] > 190.0, "for a linear model each weight is that of the prediction"
    assert size["bootstrap"] < 20.0
    assert error["guided"] < 0.1 * error["bootstrap"]


LEVEL = StateSpace(level=euclidean(1))


def volatility():
    """Stochastic volatility: x' = 0.95 x + w, z = exp(x/2) v. Nothing of it is seen by a derivative in x."""
    drift = MotionModel(
        LEVEL, lambda x, w, dt, xp: (0.95 * x.level + 0.3 * w * xp.sqrt(dt / 0.1 + 0.0),), density=0.1
    )
    seen = MeasurementModel(LEVEL, lambda x, v, xp: xp.exp(0.5 * x.level) * v, noise=1.0)
    return drift, seen


def test_noise_that_is_multiplied_is_followed_by_particles_and_not_by_a_derivative():
    rng, x, levels, z = np.random.default_rng(1), 0.0, [], []
    for _ in range(300):
        x = 0.95 * x + 0.3 * rng.normal()
        levels.append(x)
        z.append(np.exp(0.5 * x) * rng.normal())
    drift, seen = volatility()
    start = LEVEL.gaussian(level=(0.0, 1.0))

    @graph
    def followed(z: Stream[Value], *, method):
        """The level of a noise."""
        return filtered(drift, {seen: z}, start=start, method=method)

    inputs = {"z": Series(np.arange(300) * 100 * MS, Value(value=np.array(z)))}
    error, likely = {}, {}
    for name, method in {"extended": extended(), "particles": particles(500)}.items():
        result = simulate(followed.build(method=method), inputs, engine="reference")
        error[name] = np.sqrt(np.mean((result["output"]["mean"][:, 0] - levels) ** 2))
        likely[name] = result["log_likelihood"]["value"].sum()
    assert error["particles"] < 0.9 * error["extended"]
    assert likely["particles"] > likely["extended"]


def test_a_cloud_starts_from_the_first_measurement():
    def believe(spot, xp):
        mean = xp.concat([spot.position, xp.asarray([1.0, 0.0])])
        return Gaussian(mean=mean, covariance=xp.asarray(np.diag([0.25, 0.25, 1.0, 1.0])))

    inputs = spots(10)
    result = simulate(point.build(start=first(PLACE, believe), method=particles(2000)), inputs)
    apart = result["output"]["mean"][0][:2] - inputs["spot"]["position"][0]
    assert 0.0 < np.abs(apart).max() < 0.05


def test_what_is_out_of_range_is_refused():
    with pytest.raises(DeclarationError, match=r"this is no number of particles[\s\S]*0"):
        particles(0)
    with pytest.raises(UnknownNameError, match=r"guide"):
        particles(10, proposal="guide")
    with pytest.raises(UnknownNameError, match="scheme"):
        particles(10, scheme="fair")
    with pytest.raises(DeclarationError, match="particles that the model guides have their proposal"):
        particles(10, proposal="guided", propose=lambda x, xp: (0.0, 1.0))
    with pytest.raises(DeclarationError, match=r"particles.propose[\s\S]*z, dt, xp"):
        particles(10, propose=lambda x, a, b, xp: (0.0, 1.0))
    still = MotionModel(LEVEL, lambda x, dt, xp: x)
    seen = MeasurementModel(LEVEL, lambda x, xp: x.level, noise=1.0)

    @graph
    def fixed(z: Stream[Value]):
        """Nothing is drawn."""
        start = LEVEL.gaussian(level=(0.0, 1.0))
        return filtered(still, {seen: z}, start=start, method=particles(10, proposal="guided"))

    with pytest.raises(DeclarationError, match="particles of a motion without noise cannot be guided"):
        fixed.build()
