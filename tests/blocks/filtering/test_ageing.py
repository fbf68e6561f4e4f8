"""A control that is held for too long: how unsure a belief becomes by it, by every method."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Array, DeclarationError, Series, Signal, Stream, graph, real, simulate
from flowgraph.blocks.filtering import (
    Ageing,
    LinearMeasurement,
    LinearModel,
    MotionModel,
    StateSpace,
    ensemble,
    euclidean,
    extended,
    filtered,
    information,
    linear,
    particles,
    square_root,
    unscented,
)
from flowgraph.blocks.signals import Steering
from tests.blocks.filtering.test_filtered import CAR, GPS, START, Fix, driven
from tests.support import all_engines, both_quick

MS = 1_000_000


class Push(Signal):
    """An acceleration."""

    acceleration: Array = real(unit="m/s^2")


class Tick(Signal):
    """A measurement of next to nothing."""

    value: Array = real(1)


LINE = StateSpace(position=euclidean(1), velocity=euclidean(1))
SILENT = LinearModel(np.eye(2, 2, 1), [[0.0], [1.0]], np.zeros((2, 2)), space=LINE)
NOTHING = LinearMeasurement(LINE, [[1.0, 0.0]], noise=1e12)


def _fall(x, u, dt, xp):
    a = u.acceleration[..., None]
    return x.position + x.velocity * dt + 0.5 * a * dt * dt, x.velocity + a * dt


FALL = MotionModel(LINE, _fall)
OFTEN = np.arange(41) * 50 * MS


@graph
def line(push: Stream[Push], tick: Stream[Tick], *, motion=SILENT, method=None, held=None):
    """A point that is pushed, at times that are known and with a velocity that nothing disturbs."""
    start = LINE.gaussian(position=(0.0, 1e-6), velocity=(0.0, 1e-6))
    return filtered(motion, {NOTHING: tick}, control=push, held=held, start=start, method=method)


def inputs(pushed: np.ndarray) -> dict[str, Series]:
    return {
        "push": Series(pushed, Push(acceleration=np.sin(pushed * 1e-9))),
        "tick": Series(OFTEN, Tick(value=np.zeros((len(OFTEN), 1)))),
    }


@pytest.mark.parametrize("motion", [SILENT, FALL])
@pytest.mark.parametrize("method", [extended(), square_root(), unscented()])
def test_after_a_gap_a_velocity_is_off_by_the_spread_times_the_gap(motion, method):
    """Pushes end at 0.5 s. At an age T beyond `after` the variance has grown by spread^2 (T^2 - after^2)."""
    held = Ageing(after=0.1, spread=0.7)
    built = line.build(motion=motion, method=method, held=held)
    found = simulate(built, inputs(OFTEN[:11]))["output"]
    age = np.maximum(OFTEN * 1e-9 - 0.5, 0.0)
    expected = 0.49 * np.maximum(age**2 - 0.01, 0.0)
    np.testing.assert_allclose(found["covariance"][:, 1, 1], expected, atol=1e-9)
    plain = simulate(line.build(motion=motion, method=method), inputs(OFTEN[:11]))["output"]
    np.testing.assert_allclose(found["mean"], plain["mean"], atol=1e-9)


def test_particles_and_ensembles_spread_likewise():
    held = Ageing(after=0.1, spread=(0.7,))
    for method in (particles(4000), ensemble(4000)):
        for motion in (SILENT, FALL):
            built = line.build(motion=motion, method=method, held=held)
            found = simulate(built, inputs(OFTEN[:11]), engine="reference")["output"]
            deviation = np.sqrt(found["covariance"][-1, 1, 1])
            assert deviation == pytest.approx(0.7 * np.sqrt(1.5**2 - 0.01), rel=0.05)


@graph
def car(steering: Stream[Steering], fix: Stream[Fix], *, method=None, held=None, gate=None):
    """A car whose steering may stay away."""
    return filtered(CAR, {GPS: fix}, control=steering, held=held, start=START, method=method, gate=gate)


@pytest.mark.parametrize(
    ("method", "apart"), [(extended(), 1e-12), (information(), 1e-12), (unscented(), 3e-2)]
)
def test_nothing_changes_while_controls_come(method, apart):
    """With more directions sigma points lie farther out, which differs in what the model is curved by."""
    _, flown = driven(2.0)
    held = Ageing(after=0.2, spread=(0.3, 1.0))
    with_, without = (simulate(car.build(method=method, held=h), flown)["output"] for h in (held, None))
    for leaf in ("mean", "covariance"):
        np.testing.assert_allclose(with_[leaf], without[leaf], rtol=1e-12, atol=apart)


@pytest.mark.parametrize("engines", [both_quick, pytest.param(all_engines, marks=pytest.mark.slow)])
def test_a_gap_of_the_steering_is_doubted_in_the_engines(engines):
    """After two seconds without steering the filter is less sure, and honest."""
    states, flown = driven(6.0)
    steering = flown["steering"]
    keep = (steering.time < 2000 * MS) | (steering.time >= 4000 * MS)
    flown = {**flown, "steering": steering[keep]}
    held = Ageing(after=0.2, spread=(0.3, 1.0))
    found = engines(car.build(method=extended(), held=held), flown)["output"]
    plain = simulate(car.build(method=extended()), flown)["output"]
    during = (found.time > 3500 * MS) & (found.time < 4000 * MS)
    assert (found["covariance"][during, 2, 2] > 4.0 * plain["covariance"][during, 2, 2]).all()
    at = np.searchsorted(np.arange(len(states)) * 50 * MS, found.time)
    assert (np.abs(states[at, 2] - found["mean"][:, 2]) < 4.0 * np.sqrt(found["covariance"][:, 2, 2])).all()


def test_what_does_not_fit_the_control_is_refused():
    for wrong in (Ageing(0.1, (1.0, 2.0, 3.0)), Ageing(0.0, 1.0), Ageing(0.1, -1.0)):
        with pytest.raises(DeclarationError, match=r"filtered.held: this ageing does not fit[\s\S]*or 2"):
            car.build(held=wrong)
    assert line.build(method=linear(), held=Ageing(0.1, 1.0)) is not None
