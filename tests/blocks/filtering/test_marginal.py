"""Rao-Blackwellized particles: exact where the rest is known, and less spread than particles alone."""

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
    LinearMeasurement,
    LinearModel,
    MeasurementModel,
    MotionModel,
    StateSpace,
    angle,
    euclidean,
    extended,
    filtered,
    linear,
    particles,
    rao_blackwellized,
)
from tests.blocks.filtering.test_filtered import point, spots
from tests.support import all_engines, both_quick

MS = 1_000_000


class Value(Signal):
    """A number."""

    value: Array = real()


@pytest.mark.parametrize("engines", [both_quick, pytest.param(all_engines, marks=pytest.mark.slow)])
def test_it_is_equal_in_the_engines_lowered_and_drawn(engines):
    built = point.build(method=rao_blackwellized(50, linear="velocity"), gate=0.999)
    result = engines(built, spots(12))
    assert len(result["innovation"]) == len(result["log_likelihood"]) == 12
    assert {"filter/carry", "filter/weigh", "filter/resample"} <= {
        stage.path for stage in lower(built).stages
    }
    assert "weigh" in built.text()


SWING = StateSpace(phase=angle(), level=euclidean(2))


def _swing(x, w, dt, xp):
    """A phase that goes on by itself turns what is linear, and shakes it more at some times."""
    c, s = xp.cos(x.phase[..., 0]), xp.sin(x.phase[..., 0])
    a, b = x.level[..., 0], x.level[..., 1]
    level = xp.stack([a + (c * b + w[..., 0]) * dt, b + (s * w[..., 1] - 0.3 * a) * dt], axis=-1)
    return x.phase + 2.0 * dt, level


TURNS = MotionModel(SWING, _swing, density=[0.2, 0.1])
SEEN = MeasurementModel(SWING, lambda x, xp: x.level[..., :1] * (1.5 + xp.cos(x.phase)), noise=0.04)


@graph
def swinging(z: Stream[Value], *, method, start):
    """Two numbers that are linear, given a phase."""
    return filtered(TURNS, {SEEN: z}, start=start, method=method)


def test_where_what_is_drawn_is_known_each_particle_is_the_kalman_filter():
    """The phase is known at first and nothing disturbs it: all else is linear, and one particle enough."""
    start = SWING.gaussian(phase=(0.3, 0.0), level=((1.0, -1.0), 1.0))
    rng = np.random.default_rng(1)
    inputs = {"z": Series(np.arange(40) * 100 * MS, Value(value=rng.normal(size=40)))}
    method = rao_blackwellized(3, linear=("level",))
    found = simulate(swinging.build(method=method, start=start), inputs)
    exact = simulate(swinging.build(method=extended(), start=start), inputs)
    for leaf in ("mean", "covariance"):
        np.testing.assert_allclose(found["output"][leaf], exact["output"][leaf], atol=1e-12)
    for name in ("log_likelihood", "innovation"):
        leaf = "value" if name == "log_likelihood" else "nis"
        np.testing.assert_allclose(found[name][leaf], exact[name][leaf], atol=1e-10)


SPACE = StateSpace(slow=euclidean(1), fast=euclidean(1))
PAIR = LinearModel(np.array([[0.0, 1.0], [0.0, -0.2]]), None, np.diag([0.01, 1.0]), space=SPACE)
SUM = LinearMeasurement(SPACE, np.array([[1.0, 0.5]]), noise=0.05)


@graph
def pair(z: Stream[Value], *, method):
    """Two numbers, one of which is drawn."""
    start = SPACE.gaussian(slow=(0.0, 1.0), fast=(0.0, 1.0))
    return filtered(PAIR, {SUM: z}, start=start, method=method)


def test_it_has_the_exact_likelihood_with_less_spread_than_particles():
    rng = np.random.default_rng(2)
    z = np.cumsum(rng.normal(size=15)) * 0.3
    inputs = {"z": Series(np.arange(15) * 100 * MS, Value(value=z))}
    exact = simulate(pair.build(method=linear()), inputs)
    expected = exact["log_likelihood"]["value"].sum()
    spread = []
    for make in (lambda k: rao_blackwellized(100, linear="fast", seed=k), lambda k: particles(100, seed=k)):
        runs = [simulate(pair.build(method=make(k)), inputs, seed=k, engine="reference") for k in range(12)]
        off = np.array([run["log_likelihood"]["value"].sum() - expected for run in runs])
        ratio = np.exp(off)
        assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(len(off)) + 0.02
        spread.append(off.std())
        mean = np.mean([run["output"]["mean"] for run in runs], axis=0)
        assert np.abs(mean - exact["output"]["mean"]).max() < 0.3
    assert spread[0] < 0.85 * spread[1]


def test_a_gate_refuses_and_finds_its_way_back():
    jump = {k: (50.0, 50.0) for k in range(20, 40)}
    method = rao_blackwellized(200, linear="velocity")
    result = simulate(point.build(method=method, gate=0.999), spots(at=jump), engine="reference")
    accepted = result["innovation"]["accepted"]
    assert accepted[:20].all()
    assert not accepted[20:25].any()
    assert accepted[-5:].all()
    assert np.abs(result["output"]["mean"][-1][:2] - 50.0).max() < 2.0


def test_parts_that_do_not_fit_are_refused():
    start = SWING.gaussian(phase=(0.3, 0.0), level=((1.0, -1.0), 1.0))
    for names in (("phase",), ("phase", "level"), ()):
        with pytest.raises(DeclarationError, match="these parts cannot be Gaussian at each particle"):
            swinging.build(method=rao_blackwellized(10, linear=names), start=start)
    with pytest.raises(UnknownNameError, match="speed"):
        swinging.build(method=rao_blackwellized(10, linear="speed"), start=start)
    with pytest.raises(DeclarationError, match="this is no number of particles"):
        rao_blackwellized(0, linear="level")
