"""Backward simulation: within its Monte Carlo error of the exact smoother, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    Array,
    DataError,
    DeclarationError,
    Scalar,
    Series,
    Signal,
    Stream,
    graph,
    real,
    simulate,
)
from flowgraph.blocks.filtering import (
    LinearMeasurement,
    MeasurementModel,
    MotionModel,
    backward_simulation,
    filtered,
    linear,
    particles,
    smooth,
    smoothed_cloud,
)
from flowgraph.blocks.geometry import StateSpace, angle
from flowgraph.blocks.models.tracking import constant_velocity
from flowgraph.blocks.signals import PlanePosition
from tests.blocks.filtering.turning import MOTION, built, driven

POINT = constant_velocity(1.0)
SEEN = LinearMeasurement(POINT.space, np.eye(2, 4), noise=0.09)
START = POINT.space.gaussian(position=((0.0, 0.0), 0.5), velocity=((0.0, 0.0), 1.0))


class Compass(Signal):
    heading: Array = real(1, unit="rad")


@graph
def followed(position: Stream[PlanePosition], *, method):
    return filtered(POINT, {SEEN: position}, start=START, method=method, smoothing=True)


def test_it_is_the_exact_smoother_within_its_monte_carlo_error():
    rng = np.random.default_rng(0)
    t = np.arange(25) * 0.2
    places = np.stack([np.sin(t), np.cos(t) - 1.0], axis=-1) + rng.normal(size=(25, 2)) * 0.3
    inputs = {"position": Series.from_seconds(t, PlanePosition(position=places))}
    exact = smooth(simulate(followed.build(method=linear()), inputs))
    run = simulate(followed.build(method=particles(2000)), inputs)
    m = 400
    found = smoothed_cloud(run["cloud"], POINT, trajectories=m)
    error = np.sqrt(np.einsum("nii->ni", exact["covariance"]) / m)
    off = (found["mean"] - exact["mean"]) / error
    assert np.sqrt(np.mean(off**2)) < 2.5  # the clouds are of draws as well
    filter_off = (run["posterior"]["mean"] - exact["mean"])[:-3] / error[:-3]
    assert np.sqrt(np.mean(filter_off**2)) > 8.0
    traces = [np.einsum("nii->n", s["covariance"]) for s in (found, exact)]
    np.testing.assert_allclose(traces[0].mean() / traces[1].mean(), 1.0, atol=0.08)


def test_trajectories_are_whole():
    """From tick to tick each moves as the model does, so that products of ticks are right too."""
    seen, _ = driven(20)
    run = simulate(followed.build(method=particles(2000)), {"position": seen})
    drawn = backward_simulation(run["cloud"], POINT, trajectories=400)
    assert drawn.shape == (400, 20, 4)
    steps = drawn[:, 1:, :2] - drawn[:, :-1, :2] - 0.05 * (drawn[:, 1:, 2:] + drawn[:, :-1, 2:])
    # what noise of the acceleration leaves of p' - p - (v + v') dt/2: density dt^3 / 12
    assert 0.6 < np.mean(steps**2) / (0.1**3 / 12.0) < 1.6
    again = backward_simulation(run["cloud"], POINT, trajectories=400)
    np.testing.assert_array_equal(drawn, again)


def test_on_a_circle_and_with_a_control():
    space = StateSpace(heading=angle())

    def turn(x, u, w, dt, xp):
        return space.plus(x, velocity=(u[..., None] + w,), dt=dt)

    motion = MotionModel(space, turn, density=np.array([0.01]))
    see = MeasurementModel(space, lambda x, xp: x.heading, noise=np.array([0.01]), measured_space=space)
    start = space.gaussian(heading=(3.0, 0.3))

    @graph
    def turning(rate: Stream[Scalar], heading: Stream[Compass]):
        return filtered(
            motion, {see: heading}, control=rate, start=start, method=particles(500), smoothing=True
        )

    t = np.arange(20) * 0.1
    truth = 3.0 + 0.5 * t
    seen = (truth + np.random.default_rng(0).normal(size=20) * 0.1 + np.pi) % (2.0 * np.pi) - np.pi
    inputs = {
        "rate": Series.from_seconds(t, np.full(20, 0.5)),
        "heading": Series.from_seconds(t, Compass(heading=seen[:, None])),
    }
    run = simulate(turning.build(), inputs)
    found = smoothed_cloud(run["cloud"], motion, control=run["control"])
    off = space.minus(found["mean"], truth[:, None], np)
    assert np.sqrt(np.mean(off**2)) < 0.06
    with pytest.raises(DataError, match="not of the ticks of the clouds"):
        smoothed_cloud(run["cloud"], motion, control=run["control"][1:])


def test_a_motion_without_a_density_is_refused():
    seen, _ = driven(3)
    run = simulate(built(particles(20)), {"position": seen})
    with pytest.raises(DeclarationError, match=r"no density to go back by[\s\S]*each of the 5[\s\S]*in 3"):
        backward_simulation(run["cloud"], MOTION)
