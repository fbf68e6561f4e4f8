"""Scores as blocks: equal to the scorers of recorded runs, in every engine."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Scalar, Series, Stream, Tick, graph, simulate
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.metrics import (
    nis_score,
    nis_summary,
    pose_errors,
    pose_score,
    running_extremes,
    running_mean,
    running_rms,
    running_share,
    settle_time,
)
from flowgraph.blocks.signals import KalmanInnovation, NavigationState, PoseBelief
from flowgraph.errors import DeclarationError
from tests.support import MS, all_engines, both_quick, same

TICKS = 60


def flown(seed: int, wide: float = 1.0) -> tuple[Series, Series]:
    """A random walk of a pose with its truth, and beliefs whose errors are `wide` times what they claim."""
    rng = np.random.default_rng(seed)
    time = np.arange(TICKS, dtype=np.int64) * 100 * MS
    p, v, turn = (np.cumsum(rng.normal(size=(TICKS, 3)) * s, axis=0) for s in (0.3, 0.1, 0.4))
    q = from_rotation_vector(turn, xp=np)
    root = np.tril(rng.normal(size=(TICKS, 9, 9)) * 0.01) + 0.05 * np.eye(9)
    error = wide * (root @ rng.normal(size=(TICKS, 9, 1)))[..., 0]
    belief = PoseBelief(
        position=p - error[:, :3],
        velocity=v - error[:, 3:6],
        attitude=multiply(q, from_rotation_vector(-error[:, 6:], xp=np), xp=np),
        covariance=root @ root.mT,
    )
    still = np.zeros((TICKS, 3))
    truth = NavigationState(position=p, velocity=v, attitude=q, gyro_bias=still, accelerometer_bias=still)
    return Series(time, belief), Series(time, truth)


@graph
def scored(belief: Stream[PoseBelief], truth: Stream[NavigationState], end: Stream[Tick], *, settle="1s"):
    return {"score": pose_score(belief, truth, end=end, settle=settle)}


def at(*times: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array(times, dtype=np.int64), np.ones(len(times), dtype=bool)


@pytest.mark.parametrize("engine", ["c", pytest.param("xla", marks=pytest.mark.slow)])
def test_the_score_of_a_pose_is_that_of_the_recorded_run_in_every_engine(engine: str) -> None:
    belief, truth = flown(1, wide=1.3)
    given = {"belief": belief, "truth": truth, "end": at(int(belief.time[30]), int(belief.time[-1]))}
    built = scored.build()
    result = both_quick(built, given)
    same(result, simulate(built, given, engine=engine), exact=False)
    for k, last in enumerate((30, TICKS - 1)):
        want = pose_errors(belief[: last + 1], truth)
        for name, found in result["score"].leaves.items():
            assert found[k] == pytest.approx(want[name], rel=1e-9, abs=1e-12), name
    assert 0.0 < result["score"]["nees_inside"][-1] < 1.0, "or the band was not tried"
    assert 0.0 < result["score"]["position_3sigma"][-1] < 1.0


@pytest.mark.parametrize(("seed", "settle"), [(2, 0.0), (3, 2.5)])
def test_a_score_leaves_out_what_settles_and_ticks_without_a_truth(seed: int, settle: float) -> None:
    belief, truth = flown(seed)
    seldom = truth[::3]
    built = scored.build(settle=round(settle * 1e9))
    result = both_quick(built, {"belief": belief, "truth": seldom, "end": at(int(belief.time[-1]))})
    held = np.isin(belief.time, seldom.time) & (belief.time >= round(settle * 1e9))
    want = pose_errors(belief[held], truth, settle=0.0)
    for name, found in result["score"].leaves.items():
        assert found[0] == pytest.approx(want[name], rel=1e-9, abs=1e-12), name


def test_the_score_of_innovations_is_that_of_the_recorded_ones() -> None:
    rng = np.random.default_rng(4)
    parts = rng.integers(0, 4, 50).astype(float)
    nis = np.array([np.sum(rng.normal(size=int(n)) ** 2) for n in parts]) * 1.5
    accepted = rng.uniform(size=50) < 0.8
    eye = np.broadcast_to(np.eye(3), (50, 3, 3))
    said = KalmanInnovation(
        residual=np.zeros((50, 3)), covariance=eye, nis=nis, parts=parts, accepted=accepted
    )
    series = Series(np.arange(50, dtype=np.int64) * MS, said)

    @graph
    def summed(innovation: Stream[KalmanInnovation], end: Stream[Tick]):
        return nis_score(innovation, end=end)

    built = summed.build(sizes={"m": 3})
    result = all_engines(built, {"innovation": series, "end": at(49 * MS)})
    want = nis_summary(series) | {"nis_parts": float(parts.sum())}
    for name, found in result.output.leaves.items():
        assert found[0] == pytest.approx(want[name], rel=1e-9), name
    assert want["nis_rejected"] > 0.0


@graph
def running(x: Stream[Scalar]):
    extremes = running_extremes(x)
    return {
        "mean": running_mean(x),
        "rms": running_rms(x),
        "share": running_share(x, low=-1.0, high=0.5),
        "least": extremes.map(lambda e: e.least),
        "most": extremes.map(lambda e: e.most),
        "settled": settle_time(x, within=0.7),
    }


def test_running_figures_are_those_of_all_values_so_far() -> None:
    x = np.random.default_rng(5).normal(size=40) * np.exp(-np.arange(40) / 15.0)
    time = 3 * MS + np.cumsum(np.full(40, 250 * MS))
    result = all_engines(running.build(), {"x": (time, x)})
    for k in (0, 7, 39):
        seen = x[: k + 1]
        outside = np.flatnonzero(np.abs(seen) > 0.7)
        want = {
            "mean": seen.mean(),
            "rms": np.sqrt(np.mean(seen**2)),
            "share": np.mean((seen >= -1.0) & (seen <= 0.5)),
            "least": seen.min(),
            "most": seen.max(),
            "settled": 0.25 * outside[-1] if len(outside) else 0.0,
        }
        for name, value in want.items():
            assert result[name].value[k] == pytest.approx(value, rel=1e-12), (name, k)


def test_a_score_of_many_seeds_returns_a_row_each() -> None:
    belief, truth = flown(6)
    given = {"belief": belief, "truth": truth, "end": at(int(belief.time[-1]))}
    batch = simulate(scored.build(), given, seeds=[1, 2], engine="c")
    assert batch["score"].position_rmse_m.shape == (2, 1)


def test_innovations_of_an_unknown_size_are_refused() -> None:
    @graph
    def scored(innovation: Stream[KalmanInnovation], end: Stream[Tick]):
        return nis_score(innovation, end=end)

    with pytest.raises(DeclarationError, match=r"of an unknown size(.*\n)*.*sizes=\{'m': 3\}"):
        scored.build()
    assert scored.build(sizes={"m": 3}).sources
