"""The unscented blocks: filterpy's numbers, exact transforms, single precision, means of quaternions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.blocks.geometry import (
    StateSpace,
    angle,
    euclidean,
    from_rotation_vector,
    geodesic_angle,
    multiply,
    quaternion,
    to_rotation_vector,
)
from flowgraph.blocks.kalman import LinearModel, predict_linear, update_extended, update_linear
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.unscented import SigmaPoints, mean_turn, predict_unscented, update_unscented
from flowgraph.language.block import When

DT = 0.1
POSE = StateSpace(euclidean(3), quaternion())


def a_belief(n: int = 4, seed: int = 2, size: float = 1.0) -> Gaussian:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return Gaussian(mean=rng.normal(size=n), covariance=(root @ root.T + 0.1 * np.eye(n)) * size**2)


def a_pose(seed: int = 0, size: float = 0.2) -> Gaussian:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    return Gaussian(
        mean=np.concatenate([rng.normal(size=3), q / np.linalg.norm(q)]),
        covariance=a_belief(6, seed, size).covariance,
    )


def single(belief: Gaussian) -> Gaussian:
    return Gaussian(mean=belief.mean.astype(np.float32), covariance=belief.covariance.astype(np.float32))


def update(prior: Gaussian, z: Any, **settings: Any) -> tuple[Gaussian, Any]:
    posterior, found = update_unscented.step(prior, z, xp=np, **settings)
    assert isinstance(found, When)
    return posterior, found.value if found.present else None


# A vector: filterpy


def turning(x: Any, control: Any, w: Any, dt: Any, xp: Any) -> Any:
    """A point (px, py, heading, speed) that turns; nonlinear in its heading."""
    px, py, h, s = (x[..., k : k + 1] for k in range(4))
    return xp.concat(
        [px + s * dt * xp.cos(h), py + s * dt * xp.sin(h), h + (0.3 + 0.1 * s) * dt, s * (1 - 0.1 * dt)],
        axis=-1,
    )


def ranges(x: Any, xp: Any) -> Any:
    """Its distances from three beacons."""
    beacons = xp.asarray([[3.0, 0.0], [0.0, 4.0], [-2.0, -2.0]], dtype=x.dtype)
    apart = x[..., None, :2] - beacons
    return xp.sqrt(xp.linalg.vecdot(apart, apart))


@pytest.mark.parametrize(("alpha", "beta", "kappa"), [(1.0, 2.0, 0.0), (0.5, 2.0, -1.0), (0.1, 0.0, 1.0)])
def test_it_equals_filterpys_filter_on_a_vector_space(alpha, beta, kappa):
    kalman = pytest.importorskip("filterpy.kalman")
    Q, R = a_belief(4, 7, 0.1).covariance, a_belief(3, 8, 0.2).covariance
    peer = kalman.UnscentedKalmanFilter(
        dim_x=4,
        dim_z=3,
        dt=DT,
        fx=lambda x, dt: turning(x, None, None, dt, np),
        hx=lambda x: ranges(x, np),
        points=kalman.MerweScaledSigmaPoints(4, alpha, beta, kappa),
    )
    belief = a_belief(4, 3, 0.3)
    peer.x, peer.P, peer.Q, peer.R = belief.mean.copy(), belief.covariance.copy(), Q * DT, R
    points, rng, truth = SigmaPoints(alpha, beta, kappa), np.random.default_rng(0), belief.mean + 0.2
    moved = 0.0
    for _ in range(50):
        truth = turning(truth, None, None, DT, np)
        z = ranges(truth, np) + rng.normal(size=3) * 0.3
        belief = predict_unscented.step(belief, None, move=turning, Q=Q, points=points, dt=DT, xp=np)
        peer.predict()
        np.testing.assert_allclose(belief.mean, peer.x, atol=1e-9, rtol=0)
        np.testing.assert_allclose(belief.covariance, peer.P, atol=1e-9, rtol=0)
        belief, innovation = update(belief, z, observe=ranges, R=R, points=points)
        peer.update(z)
        np.testing.assert_allclose(belief.mean, peer.x, atol=1e-9, rtol=0)
        np.testing.assert_allclose(belief.covariance, peer.P, atol=1e-9, rtol=0)
        np.testing.assert_allclose(innovation.residual, peer.y, atol=1e-9)
        np.testing.assert_allclose(innovation.covariance, peer.S, atol=1e-9)
        moved = max(moved, float(np.abs(peer.y).max()))
    assert moved > 0.1


# What is exact


@pytest.mark.parametrize("alpha", [1.0, 1e-3])
def test_on_a_linear_model_it_is_the_kalman_filter(alpha):
    rng = np.random.default_rng(1)
    A, B, H, root = (
        rng.normal(size=(4, 4)),
        rng.normal(size=(4, 2)),
        rng.normal(size=(3, 4)),
        rng.normal(size=4),
    )
    model = LinearModel(A, B, np.outer(root, root))
    F, G, Q = model.discrete(DT, np, float)
    belief, u, z = a_belief(), rng.normal(size=2), rng.normal(size=3)
    R = np.diag([0.1, 0.2, 0.3])
    points = SigmaPoints(alpha)
    prior = predict_unscented.step(
        belief, u, move=lambda x, u, w, dt, xp: x @ F.T + G @ u, Q=Q / DT, points=points, dt=DT, xp=np
    )
    same = predict_linear.step(belief, u, model=model, dt=DT, xp=np)
    tolerance = 1e-13 / alpha**2 if alpha < 1.0 else 1e-11
    np.testing.assert_allclose(prior.mean, same.mean, atol=tolerance)
    np.testing.assert_allclose(prior.covariance, same.covariance, atol=tolerance)
    found, _ = update(same, z, observe=lambda x, xp: x @ H.T, R=R, points=points)
    expected, _ = update_linear.step(same, z, H=H, R=R, xp=np)
    np.testing.assert_allclose(found.mean, expected.mean, atol=tolerance)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=tolerance)


def test_the_deviation_form_is_the_textbooks_weighted_sum():
    n, belief = 4, a_belief(4, 5, 0.3)
    points = SigmaPoints(0.4, 2.0, 0.5)
    scale = points.scale(n)
    root = np.linalg.cholesky(belief.covariance) * scale
    X = np.vstack([belief.mean, belief.mean + root.T, belief.mean - root.T])
    Y = turning(X, None, None, DT, np)
    outer = np.full(2 * n, 0.5 / scale**2)
    Wm = np.concatenate([[1.0 - n / scale**2], outer])
    Wc = Wm + np.eye(2 * n + 1)[0] * (1.0 - points.alpha**2 + points.beta)
    mean = Wm @ Y
    found = predict_unscented.step(belief, None, move=turning, points=points, dt=DT, xp=np)
    np.testing.assert_allclose(found.mean, mean, atol=1e-13)
    np.testing.assert_allclose(found.covariance, (Y - mean).T @ np.diag(Wc) @ (Y - mean), atol=1e-12)


def pushed(x: Any, control: Any, w: Any, dt: Any, xp: Any) -> Any:
    """The point, whose heading is shaken by noise before it moves."""
    shaken = x if w is None else x + xp.concat([0.0 * w, w], axis=-1)
    return turning(shaken, control, None, dt, xp)


def test_noise_with_a_root_of_its_own_is_the_augmented_state():
    """The same as one joint covariance, in blocks, of state and noise (Wan and van der Merwe)."""
    belief, density = a_belief(4, 5, 0.3), a_belief(2, 6, 0.8).covariance
    points = SigmaPoints(0.7)
    found = predict_unscented.step(belief, None, move=pushed, noise=density, points=points, dt=DT, xp=np)
    joint = np.block([[belief.covariance, np.zeros((4, 2))], [np.zeros((2, 4)), density * DT]])
    whole = Gaussian(mean=np.concatenate([belief.mean, np.zeros(2)]), covariance=joint)

    def together(x: Any, control: Any, w: Any, dt: Any, xp: Any) -> Any:
        return np.concatenate([pushed(x[..., :4], None, x[..., 4:], dt, np), x[..., 4:]], axis=-1)

    expected = predict_unscented.step(whole, None, move=together, points=points, dt=DT, xp=np)
    np.testing.assert_allclose(found.mean, expected.mean[:4], atol=1e-13)
    np.testing.assert_allclose(found.covariance, expected.covariance[:4, :4], atol=1e-13)


def test_noise_may_be_added_before_the_points_are_drawn():
    belief, Q = a_belief(4, 5, 0.3), a_belief(4, 6, 0.8).covariance
    settings: dict[str, Any] = {"move": turning, "dt": DT, "xp": np}
    found = predict_unscented.step(belief, None, Q=Q, Q_first=True, **settings)
    wider = Gaussian(mean=belief.mean, covariance=belief.covariance + Q * DT)
    expected = predict_unscented.step(wider, None, **settings)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    after = predict_unscented.step(belief, None, Q=Q, **settings)
    assert np.abs(after.covariance - found.covariance).max() > 1e-3


def test_no_time_changes_nothing():
    belief = a_belief()
    found = predict_unscented.step(
        belief, None, move=pushed, noise=np.eye(2), Q=np.eye(4), points=SigmaPoints(), dt=0.0, xp=np
    )
    np.testing.assert_allclose(found.mean, belief.mean, atol=1e-14)
    np.testing.assert_allclose(found.covariance, belief.covariance, atol=1e-13)


def test_leading_axes_are_batches():
    beliefs = [a_pose(seed) for seed in range(3)]
    many = Gaussian(
        mean=np.stack([b.mean for b in beliefs]), covariance=np.stack([b.covariance for b in beliefs])
    )
    settings: dict[str, Any] = {"observe": seen, "R": np.eye(6) * 0.1, "space": POSE, "measured_space": POSE}
    move = lambda x, u, w, dt, xp: POSE.plus(x, w, xp)
    for mean in ("markley", "kraft"):
        points = SigmaPoints(mean=mean)
        ahead = lambda b, points=points: predict_unscented.step(
            b, None, move=move, noise=np.eye(6), space=POSE, points=points, dt=DT, xp=np
        )
        z = a_pose(9).mean
        found = update_unscented.step(ahead(many), z, xp=np, points=points, **settings)[0]
        for k, belief in enumerate(beliefs):
            one = update_unscented.step(ahead(belief), z, xp=np, points=points, **settings)[0]
            np.testing.assert_allclose(found.mean[k], one.mean, atol=1e-12)
            np.testing.assert_allclose(found.covariance[k], one.covariance, atol=1e-12)


# Single precision


def rounding_error(alpha: float) -> float:
    """How far a prediction and a correction in float32 lie from float64, as a fraction of the deviations."""
    belief, R = a_belief(4, 3, 0.3), np.diag([0.1, 0.1, 0.1])
    points, z = SigmaPoints(alpha), ranges(a_belief(4, 3).mean + 0.2, np)
    found = []
    for b in (belief, single(belief)):
        b = predict_unscented.step(b, None, move=turning, Q=np.eye(4) * 0.1, points=points, dt=DT, xp=np)
        found.append(update(b, z.astype(b.mean.dtype), observe=ranges, R=R, points=points)[0])
    a, b = found
    assert b.mean.dtype == b.covariance.dtype == np.float32
    deviation = np.sqrt(np.diag(a.covariance))
    in_mean = np.abs(a.mean - b.mean) / deviation
    in_covariance = np.abs(a.covariance - b.covariance) / np.outer(deviation, deviation)
    return float(max(in_mean.max(), in_covariance.max()))


def test_single_precision_holds_at_alpha_1_and_not_at_a_thousandth():
    """Within 1e-5 of a standard deviation at alpha = 1, and of a variance; what is refused is truly bad."""
    assert rounding_error(1.0) < 1e-5
    assert rounding_error(0.1) < 1e-4
    assert not rounding_error(1e-3) < 0.05


def test_the_covariance_stays_positive_in_single_precision():
    """A measurement 1e7 times as good as the prior: the difference P - K S K^T would lose all its digits."""
    H = np.random.default_rng(0).normal(size=(4, 4)).astype(np.float32)
    prior, R = Gaussian(mean=np.ones(4), covariance=np.eye(4) * 1e4), np.eye(4) * 1e-3
    settings: dict[str, Any] = {"observe": lambda x, xp: x @ H.T.astype(x.dtype), "R": R}
    exact, _ = update(prior, np.zeros(4), **settings)
    found, innovation = update(single(prior), np.zeros(4, np.float32), **settings)
    assert found.covariance.dtype == np.float32
    assert np.linalg.eigvalsh(found.covariance.astype(float))[0] > 0.0
    np.testing.assert_allclose(found.covariance, exact.covariance, atol=0.05 * np.abs(exact.covariance).max())
    S, C = innovation.covariance, (prior.covariance @ H.T).astype(np.float32)
    K = np.linalg.solve(S, C.T).T
    difference = single(prior).covariance - K @ S @ K.T
    assert np.linalg.eigvalsh(difference.astype(float))[0] < 0.0


def test_small_alphas_are_refused_with_the_reason():
    (limit,) = predict_unscented.limits({"points": SigmaPoints(alpha=1e-3), "move": None})
    assert limit.numbers == ("float32", "fixed")
    assert "alpha >= 0.1" in limit.expected
    assert "the central weight is -1e+06" in limit.got
    assert update_unscented.limits({"points": SigmaPoints(alpha=0.099)})
    assert not update_unscented.limits({"points": SigmaPoints(alpha=0.1)})


# Attitudes


def scattered(spread: float, seed: int = 0, count: int = 12) -> tuple[np.ndarray, float]:
    turns = np.random.default_rng(seed).normal(size=(count, 3)) * spread
    return turns, 0.6 / count  # the centre has the remaining 0.4


@pytest.mark.parametrize("spread", [0.01, 0.3, 0.7])
def test_markleys_mean_is_the_eigenvector_and_krafts_the_centre_of_the_turns(spread):
    for seed in range(5):
        turns, weight = scattered(spread, seed)
        found = {m: mean_turn(turns, weight, m, np)[0] for m in ("markley", "kraft")}
        all_turns = np.vstack([np.zeros(3), turns])
        q = np.asarray(from_rotation_vector(all_turns, xp=np))
        W = np.concatenate([[1.0 - weight * len(turns)], np.full(len(turns), weight)])
        dominant = np.linalg.eigh(np.einsum("i,ij,ik->jk", W, q, q))[1][:, -1]
        assert geodesic_angle(from_rotation_vector(found["markley"], xp=np), dominant) < 1e-6
        inverse = np.asarray(from_rotation_vector(-found["kraft"], xp=np))
        apart = to_rotation_vector(multiply(np.broadcast_to(inverse, q.shape), q, xp=np), xp=np)
        np.testing.assert_allclose(W @ apart, 0.0, atol=1e-9)
        np.testing.assert_allclose(found["markley"], found["kraft"], atol=0.5 * spread**3)


def test_the_mean_of_equal_attitudes_is_that_attitude():
    for method in ("markley", "kraft"):
        np.testing.assert_allclose(mean_turn(np.zeros((4, 3)), 0.1, method, np), 0.0, atol=1e-15)
        one = mean_turn(np.broadcast_to([[0.1, -0.2, 0.3]], (4, 3)), 0.25, method, np)
        np.testing.assert_allclose(one, [[0.1, -0.2, 0.3]], atol=1e-12)


def seen(x: Any, xp: Any) -> Any:
    return x


@pytest.mark.parametrize("mean", ["markley", "kraft"])
def test_on_a_small_spread_it_is_the_extended_filter_on_the_manifold(mean):
    prior, z = a_pose(1, size=1e-3), POSE.plus(a_pose(1).mean, np.full(6, 2e-3), np)
    settings: dict[str, Any] = {"R": np.eye(6) * 1e-6, "space": POSE, "measured_space": POSE}
    found, _ = update(prior, z, observe=seen, points=SigmaPoints(mean=mean), **settings)
    expected, _ = update_extended.step(prior, z, observe=lambda x, xp: (x, np.eye(6)), xp=np, **settings)
    np.testing.assert_allclose(POSE.minus(found.mean, expected.mean, np), 0.0, atol=1e-7)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-9)


def test_a_quaternion_and_its_negative_are_one_measurement():
    prior, z = a_pose(1), a_pose(3).mean
    settings: dict[str, Any] = {"observe": seen, "R": np.eye(6), "space": POSE, "measured_space": POSE}
    flipped = np.concatenate([z[:3], -z[3:]])
    np.testing.assert_allclose(
        update(prior, z, **settings)[0].mean, update(prior, flipped, **settings)[0].mean, atol=1e-12
    )


def test_the_mean_of_angles_respects_the_wrap():
    space = StateSpace(angle())
    belief = Gaussian(mean=np.array([np.pi - 0.01]), covariance=np.array([[0.04]]))
    found = predict_unscented.step(
        belief, None, move=lambda x, u, w, dt, xp: x + 0.05, space=space, dt=DT, xp=np
    )
    np.testing.assert_allclose(found.mean, -np.pi + 0.04, atol=1e-12)
    np.testing.assert_allclose(found.covariance, 0.04, atol=1e-12)


# Gaps and gates


def test_entries_that_are_missing_leave_the_others_to_correct():
    prior, z = a_belief(4, 3, 0.3), ranges(a_belief(4, 3).mean + 0.2, np)
    R = np.diag([0.1, 0.2, 0.3])
    z[1] = np.nan
    found, innovation = update(prior, z, observe=ranges, R=R)
    kept = [0, 2]
    expected, other = update(
        prior, z[kept], observe=lambda x, xp: ranges(x, np)[..., kept], R=R[kept][:, kept]
    )
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-12)
    np.testing.assert_allclose(innovation.nis, other.nis, atol=1e-12)
    assert innovation.parts == 2.0
    none, nothing = update(prior, np.full(3, np.nan), observe=ranges, R=R)
    assert nothing is None
    np.testing.assert_allclose(none.mean, prior.mean, atol=1e-14)
    np.testing.assert_allclose(none.covariance, prior.covariance, atol=1e-13)
    assert update_unscented.step(prior, None, observe=ranges, R=R, xp=np) == (prior, None)


def test_a_gate_keeps_an_outlier_out():
    prior, z = a_belief(4, 3, 0.3), ranges(a_belief(4, 3).mean, np) + 10.0
    kept, innovation = update(prior, z, observe=ranges, R=np.eye(3) * 0.01, gate=16.3)
    assert not innovation.accepted
    assert innovation.nis > 16.3
    np.testing.assert_allclose(kept.mean, prior.mean, atol=1e-14)
    np.testing.assert_allclose(kept.covariance, prior.covariance, atol=1e-13)


# Errors


def test_settings_that_make_no_sigma_points_are_refused():
    for alpha in (0.0, -1.0, np.nan, 100.0):
        with pytest.raises(DeclarationError, match=r"SigmaPoints: [\s\S]*0 < alpha <= 10[\s\S]*alpha="):
            SigmaPoints(alpha)
    with pytest.raises(UnknownNameError, match="no mean of quaternions is called 'average'"):
        SigmaPoints(mean="average")
    with pytest.raises(DeclarationError, match=r"kappa takes all the spread away[\s\S]*kappa > -4"):
        predict_unscented.step(a_belief(), None, move=turning, points=SigmaPoints(kappa=-4.0), dt=DT, xp=np)
