"""The simulated world: its derivatives belong together, its ways are optimal, a vehicle can fly them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flowgraph.blocks.flights.worlds import load_world
from flowgraph.blocks.geometry import rotations as g
from flowgraph.blocks.inertial import GRAVITY
from flowgraph.blocks.world import (
    Hover,
    KeyPoint,
    Limits,
    Quadrotor,
    RoundTrip,
    carried_by_thrust,
    figures,
    join,
    thesis_flight,
)
from flowgraph.blocks.world.thesis import ROUNDS, random_key_points
from flowgraph.errors import DataError, DeclarationError

WAVES = np.random.default_rng(2).uniform(0.6, 3.1, 18)  # rad/s, and as phases rad

WORLDS = {
    "thesis": thesis_flight(0),
    "hover": Hover(drift=0.3).shaped(WAVES),
    "rest": Hover(),
    "roundtrip": RoundTrip(),
}


@pytest.mark.parametrize("name", WORLDS)
def test_derivatives_belong_together(name):
    world, h = WORLDS[name], 1e-5
    t = np.linspace(0.013, world.duration - 0.013, 997)  # beside the key points, where the jerk jumps
    t = t[np.abs(t - np.rint(t)) > 10 * h]
    now, before, after = world.at(t), world.at(t - h), world.at(t + h)
    slope = lambda name: (getattr(after, name) - getattr(before, name)) / (2 * h)
    for path, derivative in itertools.pairwise(("position", "velocity", "acceleration", "jerk")):
        np.testing.assert_allclose(getattr(now, derivative), slope(path), atol=1e-5, err_msg=derivative)
    turn = g.multiply(g.conjugate(before.attitude, xp=np), after.attitude, xp=np)
    np.testing.assert_allclose(now.rate, g.to_rotation_vector(turn, xp=np) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(now.attitude, axis=-1), 1.0, atol=1e-14)
    assert np.einsum("ni,ni->n", before.attitude, after.attitude).min() > 0.99  # no jump of sign


@pytest.mark.parametrize("name", ["thesis", "hover", "rest"])
def test_thrust_is_along_body_z_by_the_shortest_arc_and_carries_all(name):
    world = WORLDS[name]
    motion = world.at(np.linspace(0.0, world.duration, 500))
    force = motion.acceleration - np.array(GRAVITY)
    np.testing.assert_allclose(motion.thrust, np.linalg.norm(force, axis=-1), rtol=1e-12)
    np.testing.assert_allclose(motion.specific_force[:, :2], 0.0, atol=1e-12)
    up = np.broadcast_to([0.0, 0.0, 1.0], force.shape)
    np.testing.assert_allclose(motion.attitude, g.between_vectors(up, force, xp=np), atol=1e-12)
    np.testing.assert_allclose(np.cos(motion.tilt), motion.rotation[:, 2, 2], atol=1e-12)
    down = motion.to_body(GRAVITY)
    np.testing.assert_allclose(motion.specific_force, motion.coordinate_acceleration - down, atol=1e-12)


GIVEN = [c for c in itertools.product((True, False), repeat=3) if any(c)]


@pytest.mark.parametrize("given_", GIVEN)
def test_each_end_state_is_reached_and_no_other_way_has_less_jerk(given_):
    """The seven end states, against a minimisation over polynomials of the eighth degree."""
    random, T, degree = np.random.default_rng(3), 1.7, 8
    start, goal = random.normal(size=(3, 3)), random.normal(size=(3, 3))
    ends = [tuple(x) if on else None for x, on in zip(goal, given_, strict=True)]
    way = join([KeyPoint(T, *ends)], position=start[0], velocity=start[1], acceleration=start[2])
    at_start, at_end = way.at(np.array([0.0])), way.at(np.array([T]))
    for k in range(3):
        np.testing.assert_allclose(at_start[k][0], start[k], atol=1e-12)
        if given_[k]:
            np.testing.assert_allclose(at_end[k][0], goal[k], atol=1e-10)

    powers = np.arange(degree + 1)
    falling = lambda k: np.array([np.prod(np.arange(n, n - k, -1.0)) for n in powers])
    row = lambda k, t: falling(k) * np.where(powers >= k, float(t) ** np.maximum(powers - k, 0), 0.0)
    exponent = np.maximum(powers[:, None] + powers - 5, 1)
    H = np.outer(falling(3), falling(3)) * T**exponent / exponent  # integral of jerk squared
    rows = [row(k, 0.0) for k in range(3)] + [row(k, T) for k in range(3) if given_[k]]
    values = [*start, *(goal[k] for k in range(3) if given_[k])]
    A, b = np.array(rows), np.array(values)
    kkt = np.block([[H, A.T], [A, np.zeros((len(A), len(A)))]])
    best = np.linalg.lstsq(kkt, np.vstack([np.zeros((degree + 1, 3)), b]), rcond=None)[0][: degree + 1]
    np.testing.assert_allclose(way.cost, np.einsum("ki,kl,li->", best, H, best), rtol=1e-6, atol=1e-9)
    times = np.linspace(0.0, T, 7)
    smooth = np.stack([row(0, t) for t in times]) @ best
    np.testing.assert_allclose(way.at(times)[0], smooth, atol=1e-6)


def test_primitives_join_without_jumps():
    flight = thesis_flight(4).primitives
    inner = flight.start[1:]
    before = flight.within(np.arange(len(inner)), flight.seconds[:-1])
    for old, new in zip(before[:3], flight.at(inner)[:3], strict=True):
        np.testing.assert_allclose(old, new, atol=1e-9)
    assert flight.duration == 20.0
    with pytest.raises(ValueError, match="read-only"):
        flight.coefficients[0] = 0.0


@pytest.mark.parametrize("bad", [lambda: KeyPoint(1.0), lambda: KeyPoint(0.0, (0.0, 0.0, 1.0))])
def test_a_key_point_gives_something_and_takes_time(bad):
    with pytest.raises(DeclarationError, match="this key point fixes no way") as caught:
        bad()
    assert "one or more of position, velocity and acceleration" in str(caught.value)


def test_no_key_point_is_no_way():
    with pytest.raises(DeclarationError, match="there is no key point"):
        join([])


def dense(flight):
    return flight.at(np.linspace(0.0, flight.duration, 20 * 400))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31))
@example(70886)  # the thrust changes by a tenth in two milliseconds
def test_feasible_is_what_a_dense_check_says(seed):
    """Never feasible where a sample breaks a limit; and feasible where all samples keep well within."""
    flight = Quadrotor.along(random_key_points(seed))
    loose, tight = Limits(4.0, 45.0, 60.0), Limits(4.0 * 0.9, 45.0 * 1.1, 60.0 * 1.1, resolution=2e-4)
    motion = dense(flight)
    rate = np.linalg.norm(motion.rate, axis=-1).max()
    keeps = motion.thrust.min() >= 4.0 and motion.thrust.max() <= 45.0 and rate <= 60.0
    if flight.feasible(loose):
        assert keeps
    jerk = np.linalg.norm(np.gradient(motion.acceleration, flight.duration / (20 * 400 - 1), axis=0), axis=-1)
    upper = jerk / motion.thrust * np.sqrt(2.0 / (1.0 + np.cos(motion.tilt)))  # jerk along the thrust too
    if keeps and upper.max() <= 30.0:  # where the jerk steps, the difference shows half of it
        assert flight.feasible(tight)


def test_each_limit_refuses():
    up = [KeyPoint(1.0, position=(0.0, 0.0, 0.5), velocity=(0.0,) * 3, acceleration=(0.0,) * 3)]
    side = [KeyPoint(1.0, position=(1.0, 0.0, 0.0), velocity=(0.0,) * 3, acceleration=(0.0,) * 3)]
    assert Quadrotor.along(up).feasible()
    assert not Quadrotor.along(up).feasible(Limits(most_thrust=12.0))
    assert not Quadrotor.along(up).feasible(Limits(least_thrust=7.0))
    rate = np.linalg.norm(dense(Quadrotor.along(side)).rate, axis=-1).max()
    assert Quadrotor.along(side).feasible(Limits(rate=1.3 * rate))
    assert not Quadrotor.along(side).feasible(Limits(rate=0.99 * rate))


@pytest.mark.parametrize("seed", range(4))
def test_thesis_flights_are_feasible_start_at_rest_and_repeat(seed):
    flight, again, other = thesis_flight(seed), thesis_flight(seed), thesis_flight(seed + 100)
    assert (flight.primitives.coefficients == again.primitives.coefficients).all()
    assert (flight.primitives.coefficients != other.primitives.coefficients).any()
    motion, limits = dense(flight), Limits()
    assert limits.least_thrust <= motion.thrust.min() <= motion.thrust.max() <= limits.most_thrust
    assert np.linalg.norm(motion.rate, axis=-1).max() <= limits.rate
    start = flight.at(0.0)
    np.testing.assert_array_equal([start.position, start.velocity, start.acceleration], 0.0)


def test_key_points_are_drawn_as_the_thesis_says():
    draws = [random_key_points(0, tried=k)[:3] for k in range(2000)]
    parts = lambda points: [
        x for p in points for x in (p.position, p.velocity, p.acceleration) if x is not None
    ]
    rounds = np.array([np.ravel(parts(points)) for points in draws])
    means = [0, 0.75, 1, 1, 1, 1, 0, 0, 0, 1, 1, 0.8, -1, -1, 1, 0, 0, 0]
    variances = np.repeat([0.6, 0.2, 0.1, 0.6, 0.6, 0.2], 3)
    np.testing.assert_allclose(rounds.mean(0), means, atol=5 * np.sqrt(0.6 / 2000))
    np.testing.assert_allclose(rounds.var(0), variances, rtol=0.15)
    points = random_key_points(1)
    assert [p.seconds for p in points] == [1.0, 1.0, 2.0] * ROUNDS
    assert points[1].velocity is None
    assert points[2].acceleration is None


def test_the_family_is_as_hard_as_its_chapter_says():
    found = figures(thesis_flight(seed) for seed in range(24))
    assert 6.1 < found.acceleration < 6.9
    assert 28.5 < found.tilt < 32.0
    assert 2.0 < found.rate < 2.4
    wilder = figures(thesis_flight(seed, limits=Limits(5.0, 30.0, 35.0)) for seed in range(24))
    assert 7.3 < wilder.acceleration < 8.9
    assert 33.0 < wilder.tilt < 40.0
    assert 2.4 < wilder.rate < 3.2
    assert "RMS acceleration" in str(found)
    assert "over 24 flights" in str(found)


@pytest.mark.parametrize(
    ("limits", "seeds"),
    [(Limits(), [2]), (Limits(5.0, 30.0, 35.0), range(3)), (Limits(1.0, 40.0, 60.0), range(3))],
)
def test_it_is_the_first_feasible_draw(limits, seeds):
    """Draws that are thrown away after a few looks are infeasible ones."""
    for seed in seeds:
        draws = (Quadrotor.along(random_key_points(seed, tried=k)) for k in range(20_000))
        first = next(flight for flight in draws if flight.feasible(limits))
        found = thesis_flight(seed, limits=limits)
        np.testing.assert_array_equal(found.primitives.coefficients, first.primitives.coefficients)


def test_no_feasible_flight_is_an_error_that_says_so():
    with pytest.raises(DataError, match="no random flight is feasible"):
        thesis_flight(0, limits=Limits(most_thrust=10.0), attempts=3)


def test_round_trip_goes_out_and_back_on_each_axis():
    world = RoundTrip(angle=0.8, trip=4.0, rest=1.0, duration=15.0)
    ends = world.at(np.array([0.0, 0.9, 5.0, 10.0, 15.0]))
    np.testing.assert_allclose(ends.attitude, [[1.0, 0.0, 0.0, 0.0]] * 5, atol=1e-12)
    out = g.to_rotation_vector(world.at(np.array([3.0, 8.0, 13.0])).attitude, xp=np)
    np.testing.assert_allclose(out, 0.8 * np.eye(3), atol=1e-12)
    motion = world.at(np.linspace(0.0, 15.0, 100))
    np.testing.assert_allclose(motion.specific_force, motion.to_body([0.0, 0.0, 9.81]), atol=1e-12)


def test_hover_is_at_rest_or_drifts_as_much_as_it_says():
    rest = Hover(point=(1.0, 2.0, 3.0)).at(np.arange(0.0, 20.0, 0.1))
    np.testing.assert_array_equal(rest.position, [[1.0, 2.0, 3.0]] * len(rest))
    np.testing.assert_array_equal(rest.rate, 0.0)
    np.testing.assert_allclose(rest.thrust, 9.81)
    flight = load_world("hover", seed=1, settings={"duration": 2000, "drift": 0.2, "sensors": "vicon"})
    drift = flight.info["world"].at(np.arange(0.0, 2000.0, 0.5))
    np.testing.assert_allclose(drift.position.std(0), 0.2, rtol=0.05)
    speeds = flight.info["world"].waves[:9] / (2.0 * np.pi)
    assert 0.1 <= speeds.min() < speeds.max() <= 0.5
    with pytest.raises(DeclarationError, match="nobody has drawn how this body drifts"):
        Hover(drift=0.1).at(0.0)


def test_times_outside_are_refused():
    with pytest.raises(DataError, match="this time is outside the world") as caught:
        thesis_flight(0).at([3.0, 20.5])
    assert "seconds from 0 to 20" in str(caught.value)


def test_upside_down_has_no_shortest_arc_and_is_not_feasible():
    still = np.zeros((1, 3))
    almost = carried_by_thrust(still, still, np.array([[1e-3, 0.0, -20.0]]), still)
    assert np.isfinite(almost.attitude).all()
    assert np.degrees(almost.tilt[0]) > 179.9
    across = [KeyPoint(1.0, acceleration=(-5.0, 0.0, -30.0))]  # slowly, and never far from upside down
    passes = Quadrotor.along(across, acceleration=(5.0, 0.0, -30.0))
    assert not passes.feasible(Limits(least_thrust=1.0, most_thrust=99.0, rate=1e3))
