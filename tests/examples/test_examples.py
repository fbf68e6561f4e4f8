"""Each example runs, prints what it promises, and computes what an independent calculation gives."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import aperiodic, periodic, simulate

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
OWN = ("udp_live", "watched_live")
"""Those with arguments, which have tests of their own."""

FILES = sorted(f for f in EXAMPLES.glob("*.py") if f.stem not in OWN)


def run(name: str) -> dict[str, Any]:
    """The names of an example after it ran as a script."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_every_example_says_what_it_shows_and_prints(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(file.stem)["__doc__"].strip().endswith(".")
    assert capsys.readouterr().out.strip()


@pytest.fixture(scope="module")
def track() -> tuple[np.ndarray, np.ndarray]:
    """Times (ns) and noisy positions of something that moves at 1 m/s."""
    seconds = np.arange(60)
    noise = np.random.default_rng(5).normal(0.0, np.sqrt(5.0), len(seconds))
    return seconds * 10**9, seconds + noise


def constant_velocity(track: tuple[np.ndarray, np.ndarray], engine: str) -> tuple[np.ndarray, np.ndarray]:
    graph = run("constant_velocity_kalman")["constant_velocity"]
    output = simulate(graph.build(z=periodic("1s")), {"z": track}, engine=engine).output
    return output["0"], output["1"]


def test_the_kalman_example_has_at_most_25_lines() -> None:
    assert len((EXAMPLES / "constant_velocity_kalman.py").read_text().splitlines()) <= 25


@pytest.mark.parametrize("engine", ["python", "reference", "xla"])
def test_kalman_agrees_with_weighted_least_squares(track: tuple[np.ndarray, np.ndarray], engine: str) -> None:
    """The filter gives the solution of one least-squares problem over all steps, solved at once."""
    if engine == "xla":
        pytest.importorskip("jax", reason="the XLA engine needs JAX")
    x, P = constant_velocity(track, engine)
    n, g = 8, np.array([0.005, 0.1])  # the noise of a step is 0.1 g g^T: one number a step
    # unknowns: the state before the first step (2), then one random acceleration a step (n)
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    states = [np.hstack([np.eye(2), np.zeros((2, n))])]
    for k in range(n):
        step = F @ states[-1]
        step[:, 2 + k] += g
        states.append(step)
    A = np.array([s[0] for s in states[1:]])
    prior = np.diag([1 / 1000.0, 1 / 1000.0, *[1 / 0.1] * n])
    information = prior + A.T @ A / 5.0
    mean = np.linalg.solve(information, A.T @ track[1][:n] / 5.0 + prior @ np.array([2.0, 0.0, *[0.0] * n]))
    assert x[n - 1] == pytest.approx(states[-1] @ mean, abs=1e-9)
    covariance = states[-1] @ np.linalg.inv(information) @ states[-1].T
    assert P[n - 1] == pytest.approx(covariance, rel=1e-9)


def test_kalman_first_update_by_hand(track: tuple[np.ndarray, np.ndarray]) -> None:
    x, P = constant_velocity(track, "python")
    prior = 1000.0 + 1000.0 + 0.1 * 0.005**2  # variance of the position after one step
    across = 1000.0 + 0.1 * 0.005 * 0.1
    innovation = track[1][0] - 2.0
    assert x[0] == pytest.approx(
        [2.0 + prior / (prior + 5.0) * innovation, across / (prior + 5.0) * innovation], rel=1e-12
    )
    assert P[0, 0, 0] == pytest.approx(prior * 5.0 / (prior + 5.0), rel=1e-9)


def test_kalman_equals_filterpy(track: tuple[np.ndarray, np.ndarray]) -> None:
    reason = "filterpy is the peer of this example: pip install 'flowgraph-filters[bench]'"
    kalman = pytest.importorskip("filterpy.kalman", reason=reason)
    common = pytest.importorskip("filterpy.common", reason=reason)
    peer = kalman.KalmanFilter(dim_x=2, dim_z=1)
    peer.x = np.array([2.0, 0.0])
    peer.F = np.array([[1.0, 1.0], [0.0, 1.0]])
    peer.H = np.array([[1.0, 0.0]])
    peer.P *= 1000.0
    peer.R = 5
    peer.Q = common.Q_discrete_white_noise(dim=2, dt=0.1, var=0.1)
    x, P = constant_velocity(track, "python")
    for k, z in enumerate(track[1]):
        peer.predict()
        peer.update(z)
        assert np.abs(x[k] - peer.x).max() <= 1e-10
        assert np.abs(P[k] - peer.P).max() <= 1e-10


@pytest.mark.parametrize("engine", ["python", "reference", "xla"])
def test_own_block_agrees_with_numpy(engine: str) -> None:
    if engine == "xla":
        pytest.importorskip("jax", reason="the XLA engine needs JAX")
    values = np.random.default_rng(2).normal(-3.0, 0.5, 40)
    graph = run("own_block")["statistics"].build()
    result = simulate(graph, {"x": (np.arange(40), values)}, engine=engine)
    assert result.mean.value == pytest.approx([values[: k + 1].mean() for k in range(40)], rel=1e-12)
    assert result.spread.value == pytest.approx(
        [values[: k + 1].std(ddof=1) for k in range(1, 40)], rel=1e-12
    )
    assert result.spread.time.tolist() == list(range(1, 40))


def test_own_sensor_gives_the_mean_of_the_plausible_readings() -> None:
    example = run("own_sensor")
    readings = list(example["sonar"](1.5, events=300, seed=9))
    kept = np.array([reading.distance for _, reading in readings if reading.distance < 5.0])
    assert 200 < len(kept) < 300
    graph = example["altimeter"].build(sonar=aperiodic(max_rate=25), longest=5.0)
    result = simulate(graph, {"sonar": iter(readings)})
    assert result.plausible.distance == pytest.approx(kept)
    weight = 1 / 0.05**2
    information = 0.01 + weight * len(kept)
    assert result.height[-1].mean == pytest.approx(weight * kept.sum() / information, rel=1e-12)
    assert result.height[-1].variance == pytest.approx(1 / information, rel=1e-9)
    assert abs(result.height[-1].mean - 1.5) < 5 * np.sqrt(result.height[-1].variance)


def test_live_run_shows_each_distance(capsys: pytest.CaptureFixture[str]) -> None:
    run("live")
    shown = [
        line.split()[1] for line in capsys.readouterr().out.splitlines() if line.startswith("  distance")
    ]
    # 2 m/s over 1 s, 3 m/s over 1 s, a mark at 5.25, a mark at 7, 1 m/s over 1 s
    assert shown == ["0.00", "2.00", "5.00", "5.25", "7.00", "8.00"]


def test_a_live_run_in_the_browser_says_where(capsys: pytest.CaptureFixture[str]) -> None:
    found = runpy.run_path(str(EXAMPLES / "watched_live.py"))
    found["main"](["--seconds", "0.5"])
    first, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"open http://127\.0\.0\.1:\d+/ in a browser on this machine", first)
    assert last.startswith("50 ticks, last place 0.")


@pytest.mark.slow
def test_packets_over_udp_are_filtered_as_they_come(capsys: pytest.CaptureFixture[str]) -> None:
    """Each that came is in a tick or in a count; the recorded run of what arrived is the same to the bit."""
    found = run("udp_live")["FOUND"]
    assert found["same"]
    live, came, sent = found["live"], found["came"], found["sent"]
    assert sent == {"imu": 1500, "position": 15}
    assert 0 < came["imu"] < 1500  # some are lost on purpose, and more where the machine is busy
    for name, n in came.items():
        none = sum(
            live.counts[f"{name}.{kind}"] for kind in ("late", "twice", "dropped", "unclocked", "absent")
        )
        assert n == none + len(live.arrived[name]) + live.counts[f"{name}.refused"]
    assert found["result"].ticks == len(np.union1d(*(live.arrived[name].time for name in came))) > 0
    assert "the same to the bit" in capsys.readouterr().out


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_the_tracker_of_a_small_vehicle_is_switched_off_after_its_unit(seed: int) -> None:
    mav = runpy.run_path(str(EXAMPLES / "mav_flight.py"))["mav"]
    flight = mav(seed=seed, duration=6.0)
    unit, tracker = (flight.streams[name].time for name in ("imu", "leica"))
    steps = np.diff(np.union1d(unit, tracker))
    assert 0.9 < (flight.truth.time[-1] - unit[-1]) / 1e9 < 2.1
    assert tracker[-1] > unit[-1]
    assert steps.max() >= 50_000_000  # as long as a step of the filter becomes there
    assert np.median(steps) == 5_000_000
