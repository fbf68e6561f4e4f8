"""Plants, controllers and loops, against what they come to when they are worked out elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

from flowgraph import DeclarationError, Scalar, Stream, Tick, graph, simulate, ticks
from flowgraph.blocks.control import (
    DormandPrince,
    late,
    limited,
    pid,
    pid_action,
    plant,
    quadrotor,
    quadrotor_motion,
    regulator,
    state_feedback,
    transfer,
)
from flowgraph.blocks.filtering import filtered
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.kalman import LinearModel
from flowgraph.blocks.signals import FlightCommand
from flowgraph.blocks.statespace import MeasurementModel, MotionModel, runge_kutta
from flowgraph.errors import RunError
from tests.support import MS, all_engines, both_quick, scalars

GAIN, INTEGRAL, DERIVATIVE, FILTER = 10.0, 6.0, 2.0, 0.05


@graph
def continuous(clock: Stream[Tick], step: Stream[Scalar]):
    """A PID loop round 1 / ((s + 0.5) (2 s + 1)), in continuous time."""
    loop = pid_action(GAIN, INTEGRAL, DERIVATIVE, filter=FILTER).then(transfer([1.0], [2.0, 2.0, 0.5]))
    closed = loop.fed_back()
    body = plant(closed.model, start=np.zeros(len(closed.A)), command=0.0, at=clock)
    body.feed(step)
    return body.output.map(lambda x: (closed.C @ x)[0])


@pytest.mark.parametrize("period", ["10ms", "130ms"])
def test_a_pid_loop_in_continuous_time_is_exact_however_seldom_it_is_looked_at(period: str) -> None:
    clock = ticks(period, until="5s")
    given = {"clock": clock, "step": scalars([0], [1.0])}
    found = both_quick(continuous.build(), given).output.value
    # the closed loop as one transfer function, and its response by the roots of that
    numerator = np.polyadd(np.polymul([GAIN, INTEGRAL], [FILTER, 1.0]), [DERIVATIVE, 0.0, 0.0])
    open_loop = np.polymul([FILTER, 1.0, 0.0], [2.0, 2.0, 0.5])
    r, p, k = scipy.signal.residue(numerator, np.polymul(np.polyadd(open_loop, numerator), [1.0, 0.0]))
    assert not len(k)
    want = (r[:, None] * np.exp(p[:, None] * clock.time * 1e-9)).sum(0).real
    np.testing.assert_allclose(found, want, atol=1e-9)
    assert np.ptp(found) > 0.9


@graph
def demanded(clock: Stream[Tick], demand: Stream[Scalar]):
    """The PID example of bdsim: P = 10 and I = 3 in front of 0.5 / (2 s + 1), a demand of 1 from 1 s on."""
    closed = pid_action(10.0, 3.0, 0.0, filter=1.0).then(transfer([0.5], [2.0, 1.0])).fed_back()
    body = plant(closed.model, start=np.zeros(len(closed.A)), command=0.0, at=clock)
    body.feed(demand)
    return body.output.map(lambda x: (closed.C @ x)[0])


def test_the_pid_example_of_bdsim_is_its_closed_loop() -> None:
    clock = ticks("10ms", until="10s")
    found = all_engines(
        demanded.build(), {"clock": clock, "demand": scalars([1000 * MS], [1.0])}
    ).output.value

    # 2 y' = -y + 0.5 (10 e + 3 z), z' = e = r - y, by a solver that knows nothing of blocks
    def loop(t: float, x: np.ndarray) -> list[float]:
        error = 1.0 - x[0]
        return [0.5 * (-x[0] + 0.5 * (10.0 * error + 3.0 * x[1])), error]

    after = clock.time[clock.time >= 1000 * MS] * 1e-9
    solved = scipy.integrate.solve_ivp(
        loop, (1.0, after[-1]), [0.0, 0.0], method="DOP853", t_eval=after, rtol=1e-13, atol=1e-14
    )
    want = np.concatenate([np.zeros(len(found) - len(after)), solved.y[0]])
    np.testing.assert_allclose(found, want, atol=1e-9)
    assert found[-1] == pytest.approx(1.0, abs=0.02)


@graph
def sampled(clock: Stream[Tick], *, lag: int, low: float, high: float):
    """A sampled PID in front of 1 / (s (s + 1)), whose output comes late."""
    system = transfer([1.0], [1.0, 1.0, 0.0])
    body = plant(system.model, start=np.zeros(2), command=0.0, at=clock)
    y = body.output.map(lambda x: (system.C @ x)[0])
    told = pid(
        1.0 - late(y, lag, 0.0), gain=8.0, integral=2.0, derivative=3.0, filter=0.02, low=low, high=high
    )
    body.feed(told)
    return {"y": y, "u": told}


@pytest.mark.parametrize(("lag", "low", "high"), [(0, -np.inf, np.inf), (3, -np.inf, np.inf), (0, -1.5, 1.5)])
def test_a_sampled_pid_does_in_every_engine_what_its_equations_say(lag: int, low: float, high: float) -> None:
    h, n = 0.01, 150
    result = all_engines(sampled.build(lag=lag, low=low, high=high), {"clock": ticks("10ms", until="1.5s")})
    A, B = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([1.0, 0.0])
    both = scipy.linalg.expm(h * np.block([[A, B[:, None]], [np.zeros((1, 3))]]))
    x, u, i, before, slope, ys, us = np.zeros(2), 0.0, 0.0, 0.0, 0.0, [], []
    for k in range(n):
        if k:
            x = both[:2, :2] @ x + both[:2, 2] * u
        ys.append(x[1])
        e = 1.0 - (ys[k - lag] if k >= lag else 0.0)
        if k:
            slope = (0.02 * slope + e - before) / (0.02 + h)
        grown = i + (2.0 * before * h if k else 0.0)
        free = 8.0 * e + grown + 3.0 * slope
        u = min(max(free, low), high)
        if (free - u) * (grown - i) <= 0.0:
            i = grown
        before = e
        us.append(u)
    np.testing.assert_allclose(result["y"].value, ys, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(result["u"].value, us, rtol=1e-9, atol=1e-9)
    if high < 10.0:
        assert max(us) == high


CART = np.array([[0.0, 1.0], [0.0, -0.1]]), np.array([[0.0], [2.0]])


def test_a_regulator_makes_its_cost_least() -> None:
    A, B = CART
    Q, R = np.diag([3.0, 0.5]), np.array([[0.2]])
    K = regulator(A, B, Q, R)

    def cost(K: np.ndarray) -> float:
        closed = A - B @ K
        P = scipy.linalg.solve_continuous_lyapunov(closed.T, -(Q + K.T @ R @ K))
        return float(np.trace(P))

    least = cost(K)
    for d in ([0.02, 0.0], [-0.02, 0.0], [0.0, 0.02], [0.0, -0.02]):
        assert cost(K + np.array([d])) > least
    fine = regulator(A, B, Q * 1e-4, R * 1e-4, period=1e-4)
    np.testing.assert_allclose(fine, K, rtol=1e-3)


@graph
def regulated(clock: Stream[Tick], *, gains):
    body = plant(LinearModel(*CART, np.zeros(2)), start=[1.0, 0.0], command=np.zeros(1), at=clock)
    target = body.output.map(lambda x: 0.0 * x)
    body.feed(limited(state_feedback(body.output, target, gains=gains), low=-1.0, high=1.0))
    return body.output


def test_state_feedback_within_limits_brings_a_cart_home_in_every_engine() -> None:
    A, B = CART
    K = regulator(A, B, np.eye(2), np.eye(1) * 0.1, period=0.05)
    found = all_engines(regulated.build(gains=K), {"clock": ticks("50ms", until="6s")}).output.value
    both = scipy.linalg.expm(0.05 * np.block([[A, B], [np.zeros((1, 3))]]))
    x, limit = np.array([1.0, 0.0]), 0
    for k in range(len(found)):
        np.testing.assert_allclose(found[k], x, atol=1e-9)
        u = np.clip(-K @ x, -1.0, 1.0)
        limit += abs(u[0]) == 1.0
        x = both[:2, :2] @ x + both[:2, 2:] @ u
    assert limit > 0, "or the limit was not tried"
    assert np.abs(found[-1]).max() < 0.01


@graph
def turning(clock: Stream[Tick], command: Stream[FlightCommand]):
    body = quadrotor(at=clock, position=(0.0, 0.0, 2.0), lag=0.05)
    body.feed(command)
    return quadrotor_motion(body.output)


def test_a_quadrotor_moves_as_its_equations_say() -> None:
    """Against an integration of the same equations with rotation matrices, by another rule."""
    time = np.array([0, 400]) * MS
    told = FlightCommand(thrust=np.array([11.0, 8.0]), rate=np.array([[0.5, -0.3, 0.2], [-0.4, 0.6, 0.1]]))
    given = {"clock": ticks("5ms", until="1s"), "command": (time, told)}
    found = simulate(turning.build(), given, engine="reference").output
    from scipy.integrate import solve_ivp  # the judge

    def slope(t: float, x: np.ndarray, u: int) -> np.ndarray:
        v, R, w, f = x[3:6], x[6:15].reshape(3, 3), x[15:18], x[18]
        skew = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        rates = (told.rate[u] - w) / 0.05, [(told.thrust[u] - f) / 0.05]
        return np.concatenate([v, R @ [0.0, 0.0, f] - [0.0, 0.0, 9.81], (R @ skew).ravel(), *rates])

    x = np.concatenate([[0.0, 0.0, 2.0], np.zeros(3), np.eye(3).ravel(), np.zeros(3), [9.81]])
    for u, (begin, end) in enumerate(((0.0, 0.4), (0.4, 0.995))):
        x = solve_ivp(slope, (begin, end), x, args=(u,), rtol=1e-11, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(found["position"][-1], x[:3], atol=1e-6)
    np.testing.assert_allclose(found["velocity"][-1], x[3:6], atol=1e-5)
    np.testing.assert_allclose(found["rate"][-1], x[15:18], atol=1e-7)
    q = scipy.spatial.transform.Rotation.from_matrix(x[6:15].reshape(3, 3)).as_quat()[[3, 0, 1, 2]]
    assert geodesic_angle(found["attitude"][-1], q) < 1e-4


def test_systems_that_are_none_are_refused() -> None:
    with pytest.raises(DeclarationError, match="no system"):
        transfer([1.0, 0.0], [1.0])
    with pytest.raises(DeclarationError, match="no state in it"):
        transfer([1.0, 0.0], [1.0, 1.0]).fed_back()
    with pytest.raises(DeclarationError, match="no linear quadratic regulator"):
        regulator(np.eye(2), [[1.0], [0.0]], np.eye(2), np.eye(1))

    @graph
    def wrong(x: Stream[Scalar]):
        return late(x, -1, 0.0)

    with pytest.raises(DeclarationError, match="no number of ticks"):
        wrong.build()


SWING = StateSpace(euclidean(2))


def pendulum(x: Any, u: Any, xp: Any) -> Any:
    return xp.stack([x[..., 1], -9.81 * xp.sin(x[..., 0]) - 0.1 * x[..., 1] + u])


@graph
def swinging(clock: Stream[Tick], push: Stream[Scalar], *, model: Any):
    body = plant(model, start=np.array([2.9, 0.0]), command=0.0, at=clock)
    body.feed(push)
    return {"output": body.output, "degrees": body.output.map(lambda x: x[0] * (180.0 / np.pi))}


@pytest.mark.parametrize("engine", ["python", "reference", "c"])
def test_a_plant_that_is_solved_to_a_tolerance(engine: str) -> None:
    clock = ticks("250ms", until="4s")
    given = {"clock": clock, "push": scalars([0], [1.5])}
    built = swinging.build(model=DormandPrince(SWING, pendulum))
    result = simulate(built, given, engine=engine)
    found = result["output"]
    np.testing.assert_allclose(result["degrees"].value, np.degrees(found.value[:, 0]), rtol=1e-12)
    fine = scipy.integrate.solve_ivp(
        lambda t, x: pendulum(x, 0.0 if t < 0.0 else 1.5, np), (0.0, 4.0), [2.9, 0.0],
        method="DOP853", t_eval=clock.time * 1e-9, rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(found.value, fine.y.T[: len(found)], atol=1e-6)
    rough = DormandPrince(SWING, pendulum, relative=1e-3, absolute=1e-3)
    coarse = simulate(swinging.build(model=rough), given)["output"]
    assert np.abs(coarse.value - found.value).max() > 1e-5, "the tolerance is taken"


def test_a_solver_refuses_attitudes_and_what_it_cannot_solve() -> None:
    with pytest.raises(DeclarationError, match="an attitude is not added to"):
        DormandPrince(StateSpace(attitude=quaternion()), pendulum)
    falls = DormandPrince(StateSpace(euclidean(1)), lambda x, xp: xp.stack([x[..., 0] ** 2]))
    with pytest.raises(RunError, match="could not be solved"):
        falls.after(np.array([1.0]), None, 2.0)


DRIFTING = StateSpace(position=euclidean(1), speed=euclidean(1))


def dynamics(x: Any, u: Any, t: Any, xp: Any) -> Any:
    """Pushed by u and by a wind that turns with the time, sin 3t."""
    return {"position": x.speed, "speed": u + xp.sin(3.0 * t) + 0.0 * x.speed}


@graph
def blown(clock: Stream[Tick], push: Stream[Scalar], *, model: Any):
    body = plant(model, start=np.zeros(2), command=0.0, at=clock)
    body.feed(push)
    return body.output


@pytest.mark.parametrize("start", ["0s", "7s"])
def test_a_plant_that_depends_on_the_time_is_told_it(start: str) -> None:
    """Whether it is stepped, in every engine, or solved to a tolerance; wherever its clock begins."""
    clock = ticks("20ms", until="1.2s", start=start)
    given = {"clock": clock, "push": scalars([int(clock.time[0])], [0.5])}
    stepped = MotionModel(DRIFTING, runge_kutta(DRIFTING, dynamics, steps=2))
    found = all_engines(blown.build(model=stepped), given).output.value
    solved = simulate(blown.build(model=DormandPrince(DRIFTING, dynamics)), given).output.value
    t, b = clock.time * 1e-9, clock.time[0] * 1e-9
    s = t - b
    speed = 0.5 * s + (np.cos(3.0 * b) - np.cos(3.0 * t)) / 3.0
    place = 0.25 * s**2 + np.cos(3.0 * b) * s / 3.0 - (np.sin(3.0 * t) - np.sin(3.0 * b)) / 9.0
    for got, least in ((found, 1e-9), (solved, 1e-8)):
        np.testing.assert_allclose(got, np.c_[place, speed], atol=least)
    assert np.ptp(np.diff(found[:, 1])) > 0.01, "the wind turns"


def test_a_filter_has_no_time_to_tell_a_motion() -> None:
    def moved(x: Any, w: Any, t: Any, dt: Any, xp: Any) -> Any:
        return x.place + (xp.sin(t) + w) * dt

    space = StateSpace(place=euclidean(1))
    car = MotionModel(space, moved, density=[1.0])
    seen = MeasurementModel(space, lambda x, v, xp: x.place + v, noise=[1.0])

    @graph
    def tracked(fix: Stream[Scalar]):
        return filtered(car, {seen: fix}, start=space.gaussian(place=(0.0, 1.0)))

    with pytest.raises(DeclarationError, match="a filter does not tell a motion the time"):
        tracked.build()


def test_a_plant_without_a_state_of_its_own_to_start_from_is_refused() -> None:
    for model, start in ((dynamics, np.zeros(2)), (LinearModel(*CART, np.zeros(2)), np.zeros(3))):

        @graph
        def odd(clock: Stream[Tick], *, model: Any = model, start: Any = start):
            body = plant(model, start=start, command=0.0, at=clock)
            body.feed(body.output.map(lambda x: x[0]))
            return body.output

        with pytest.raises(DeclarationError, match=r"this is no plant(.*\n)*.*of shape \("):
            odd.build()


def test_steps_tolerances_and_limits_that_are_none_are_refused() -> None:
    for steps in (0, -1, 1.5, True):
        with pytest.raises(DeclarationError, match="a step cannot be taken in so many parts"):
            runge_kutta(DRIFTING, dynamics, steps=steps)  # type: ignore[arg-type]
    for kind in ({"relative": 0.0}, {"absolute": -1e-9}, {"relative": np.nan}):
        with pytest.raises(DeclarationError, match="no step is this good"):
            DormandPrince(SWING, pendulum, **kind)

    @graph
    def held(x: Stream[Scalar]):
        return limited(x, low=1.0, high=-1.0)

    @graph
    def told(x: Stream[Scalar]):
        return pid(x, gain=1.0, low=1.0, high=-1.0)

    for one in (held, told):
        with pytest.raises(DeclarationError, match="nothing between these limits"):
            one.build()
