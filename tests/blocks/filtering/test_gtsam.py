"""The batch estimate is what another library's least squares over the same factors gives: GTSAM, where it is
there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import Array, Series, Signal, Stream, graph, real, simulate
from flowgraph.blocks.filtering import (
    Loss,
    MeasurementModel,
    MotionModel,
    estimate_batch,
    extended,
    filtered,
    huber,
    smooth,
)
from flowgraph.blocks.geometry import SE, StateSpace
from flowgraph.blocks.geometry.rotations import to_matrix

gtsam: Any = pytest.importorskip("gtsam")

POSE, DT, N = StateSpace(pose=SE(3)), 0.5, 24
Q, R = np.array([0.02, 0.03, 0.02, 0.004, 0.003, 0.006]), np.array([0.04, 0.09, 0.16])
P0 = np.array([0.5, 0.4, 0.3, 0.05, 0.06, 0.3])


class Twist(Signal):
    """Velocity and rate of a body, m/s and rad/s."""

    twist: Array = real(6)


class Place(Signal):
    """A measured position, m."""

    position: Array = real(3)


ROBOT = MotionModel(
    POSE, lambda x, u, w, dt, xp: POSE.plus(POSE.plus(x.array, u.twist * dt, xp), w * dt, xp), density=Q
)
SEEN = MeasurementModel(POSE, lambda x, xp: x.array[..., :3], noise=R)
START = POSE.gaussian(pose=(np.array([1.0, 2.0, 0.5, 1.0, 0.0, 0.0, 0.0]), np.sqrt(P0)))


@graph
def followed(twist: Stream[Twist], place: Stream[Place]):
    return filtered(ROBOT, {SEEN: place}, control=twist, start=START, method=extended(), smoothing=True)


def recorded() -> tuple[Series, Series]:
    """Odometry at every tick, positions at every second; of these one in five far off."""
    random, t = np.random.default_rng(4), np.arange(N) * DT
    twist = np.stack([2.0 + 0 * t, 0.3 * np.sin(t), 0.2 * np.cos(t), 0.2 * np.sin(t), 0.1 * t, 0.4 + 0 * t]).T
    x, track = np.asarray(POSE.plus(START.mean, random.normal(size=6) * np.sqrt(P0), np)), []
    for k in range(N):
        if k:
            x = np.asarray(POSE.plus(x, twist[k] * DT + random.normal(size=6) * np.sqrt(Q * DT), np))
        track.append(x)
    places = np.stack(track)[::2, :3] + random.normal(size=(N // 2, 3)) * np.sqrt(R)
    places[3::5] += 1.5
    return Series.from_seconds(t, Twist(twist=twist)), Series.from_seconds(t[::2], Place(position=places))


def pose3(x: np.ndarray) -> Any:
    return gtsam.Pose3(gtsam.Rot3(np.asarray(to_matrix(x[3:], xp=np))), gtsam.Point3(*x[:3]))


def noise(variances: np.ndarray) -> Any:
    """In GTSAM's order, which has rotations first."""
    order = [3, 4, 5, 0, 1, 2] if len(variances) == 6 else [0, 1, 2]
    return gtsam.noiseModel.Diagonal.Variances(variances[order])


@pytest.mark.parametrize("loss", [None, pytest.param(huber(), marks=pytest.mark.slow)])
def test_poses_by_odometry_and_positions(loss: Loss | None):
    twist, place = recorded()
    result = simulate(followed.build(), {"twist": twist, "place": place})
    batch = estimate_batch(
        ROBOT, {SEEN: place}, start=START, around=smooth(result, POSE), control=result["control"], loss=loss,
        settled=1e-7, rounds=60,
    )  # fmt: skip
    factors, first = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(gtsam.PriorFactorPose3(0, pose3(START.mean), noise(P0)))
    seen = noise(R)
    if loss is not None:  # ours is of the mean square of three numbers
        robust = gtsam.noiseModel.mEstimator.Huber.Create(loss.width * np.sqrt(3.0))
        seen = gtsam.noiseModel.Robust.Create(robust, seen)
    for k in range(N):
        if k:
            step = pose3(np.asarray(POSE.plus(POSE.rest, twist["twist"][k] * DT, np)))
            factors.add(gtsam.BetweenFactorPose3(k - 1, k, step, noise(Q * DT)))
        if k % 2 == 0:
            factors.add(gtsam.GPSFactor(k, gtsam.Point3(*place["position"][k // 2]), seen))
        first.insert(k, pose3(result["posterior"]["mean"][k]))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-15)
    settings.setAbsoluteErrorTol(1e-15)
    settings.setMaxIterations(400)
    found = gtsam.LevenbergMarquardtOptimizer(factors, first, settings).optimize()
    spread = gtsam.Marginals(factors, found)
    moved = 0.0
    for k in range(N):
        other, own = found.atPose3(k), batch["mean"][k]
        np.testing.assert_allclose(other.translation(), own[:3], atol=1e-6)
        np.testing.assert_allclose(other.rotation().matrix(), to_matrix(own[3:], xp=np), atol=1e-6)
        order = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
        covariance = batch["covariance"][k]
        np.testing.assert_allclose(
            spread.marginalCovariance(k)[order], covariance, atol=2e-5 * np.trace(covariance)
        )
        moved = max(moved, np.abs(smooth(result, POSE)["mean"][k, :3] - own[:3]).max())
    assert moved > 1e-2  # and no smoother's
