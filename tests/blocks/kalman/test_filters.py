"""The Kalman blocks: filterpy's numbers, missing entries, gates, roots, and states that are no vectors."""

from __future__ import annotations

from typing import Annotated, Any, TypeAlias

import numpy as np
import pytest
from scipy.linalg import expm

from flowgraph import (
    DataError,
    DeclarationError,
    Series,
    Stream,
    arrays,
    delay,
    graph,
    latest,
    real,
    simulate,
)
from flowgraph.blocks.geometry import StateSpace, angle, euclidean, from_rotation_vector, multiply, quaternion
from flowgraph.blocks.kalman import (
    LinearModel,
    lower_root,
    predict_linear,
    predict_root,
    semidefinite_root,
    update_extended,
    update_extended_root,
    update_linear,
    update_root,
)
from flowgraph.blocks.signals import Gaussian, GaussianRoot
from flowgraph.language.block import When
from tests.support import all_engines

RNG = np.random.default_rng(5)
H = RNG.normal(size=(3, 4))
R = np.diag([0.1, 0.2, 0.3]) + 0.02


def a_model(n: int = 4, m: int = 2, **more: Any) -> LinearModel:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(n, n))
    return LinearModel(rng.normal(size=(n, n)) * 0.3, rng.normal(size=(n, m)), root @ root.T * 0.1, **more)


def a_belief(n: int = 4, seed: int = 2) -> Gaussian:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return Gaussian(mean=rng.normal(size=n), covariance=root @ root.T + 0.1 * np.eye(n))


def rooted(belief: Gaussian) -> GaussianRoot:
    return GaussianRoot(mean=belief.mean, root=np.linalg.cholesky(belief.covariance))


def unrooted(belief: GaussianRoot) -> Gaussian:
    return Gaussian(mean=belief.mean, covariance=belief.root @ belief.root.mT)


def same(a: Gaussian, b: Gaussian, tolerance: float = 1e-11) -> None:
    np.testing.assert_allclose(a.mean, b.mean, atol=tolerance)
    np.testing.assert_allclose(a.covariance, b.covariance, atol=tolerance)


def update(prior: Any, z: Any, which: Any = update_linear, **settings: Any) -> tuple[Any, Any]:
    """A step of an update on arrays: the posterior and the innovation, or None where there is none."""
    posterior, found = which.step(prior, z, xp=np, **{"H": H, "R": R, **settings})
    assert isinstance(found, When)
    return posterior, found.value if found.present else None


# The model


def test_a_model_is_discretised_as_van_loan_does():
    dt, n, rng = 0.2, 4, np.random.default_rng(1)
    A, B, root = rng.normal(size=(n, n)) * 0.3, rng.normal(size=(n, 2)), rng.normal(size=(n, n))
    D = root @ root.T
    F, G, Q = LinearModel(A, B, D, order=12).discrete(dt, np, float)
    np.testing.assert_allclose(F, expm(A * dt), atol=1e-12)
    whole = expm(np.block([[A, B], [np.zeros((2, 6))]]) * dt)
    np.testing.assert_allclose(G, whole[:n, n:], atol=1e-12)
    van_loan = expm(np.block([[-A, D], [np.zeros((n, n)), A.T]]) * dt)
    np.testing.assert_allclose(Q, van_loan[n:, n:].T @ van_loan[:n, n:], atol=1e-12)


def test_a_model_over_no_time_changes_nothing():
    belief = a_belief()
    same(predict_linear.step(belief, np.ones(2), model=a_model(), dt=0.0, xp=np), belief, 0.0)
    same(unrooted(predict_root.step(rooted(belief), np.ones(2), model=a_model(), dt=0.0, xp=np)), belief)


def test_a_nilpotent_model_is_exact_and_keeps_few_terms():
    model = LinearModel([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 3.0]))
    F, G, Q = model.discrete(0.5, np, float)
    np.testing.assert_allclose(F, [[1.0, 0.5], [0.0, 1.0]])
    np.testing.assert_allclose(G, [[0.125], [0.5]])
    np.testing.assert_allclose(Q, 3.0 * np.array([[0.5**3 / 3, 0.125], [0.125, 0.5]]))


def test_matrices_that_do_not_fit_are_refused():
    with pytest.raises(DeclarationError, match=r"do not fit together[\s\S]*got: +A \(2, 2\), B \(3, 1\)"):
        LinearModel(np.eye(2), np.ones((3, 1)), np.eye(2))


# Predict and update


def test_predict_and_update_are_those_of_filterpy():
    kalman = pytest.importorskip("filterpy.kalman")
    model, belief, dt = a_model(), a_belief(), 0.1
    peer = kalman.KalmanFilter(dim_x=4, dim_z=3, dim_u=2)
    peer.x, peer.P, peer.H, peer.R = belief.mean.copy(), belief.covariance.copy(), H, R
    peer.F, peer.B, peer.Q = model.discrete(dt, np, float)
    for _ in range(50):
        u, z = RNG.normal(size=2), RNG.normal(size=3)
        peer.predict(u)
        peer.update(z)
        belief = predict_linear.step(belief, u, model=model, dt=dt, xp=np)
        belief, innovation = update(belief, z)
        np.testing.assert_allclose(belief.mean, peer.x, atol=1e-10)
        np.testing.assert_allclose(belief.covariance, peer.P, atol=1e-10)
        np.testing.assert_allclose(innovation.covariance, peer.S, atol=1e-10)
        np.testing.assert_allclose(innovation.nis, peer.mahalanobis**2, rtol=1e-8)


def test_without_a_measurement_the_prior_passes_through():
    prior = a_belief()
    assert update_linear.step(prior, None, H=H, R=R, xp=np) == (prior, None)
    root = rooted(prior)
    assert update_root.step(root, None, H=H, R=R, xp=np) == (root, None)


def test_an_update_takes_batches():
    beliefs = [a_belief(seed=s) for s in range(3)]
    z = RNG.normal(size=(3, 3))
    many = Gaussian(*(np.stack([getattr(b, f) for b in beliefs]) for f in ("mean", "covariance")))
    together = update_linear.step(many, z, H=H, R=R, xp=np)[0]
    for k, belief in enumerate(beliefs):
        one = update(belief, z[k])[0]
        same(Gaussian(together.mean[k], together.covariance[k]), one)


@pytest.mark.parametrize("which", [update_linear, update_root])
@pytest.mark.parametrize("missing", [[0], [1], [0, 2]])
def test_a_missing_entry_leaves_the_update_of_the_others(which, missing):
    prior, z = a_belief(), RNG.normal(size=3)
    z[missing] = np.nan
    there = np.flatnonzero(~np.isnan(z))
    known, innovation = update(prior if which is update_linear else rooted(prior), z, which)
    expected, other = update(prior, z[there], H=H[there], R=R[np.ix_(there, there)])
    same(known if which is update_linear else unrooted(known), expected)
    np.testing.assert_allclose(innovation.nis, other.nis)
    assert innovation.parts == len(there)
    assert np.all(innovation.residual[missing] == 0.0)


@pytest.mark.parametrize("which", [update_linear, update_root])
def test_with_all_entries_missing_there_is_no_innovation(which):
    prior = a_belief() if which is update_linear else rooted(a_belief())
    posterior, innovation = update(prior, np.full(3, np.nan), which)
    assert innovation is None
    for field in prior._fields:
        np.testing.assert_allclose(getattr(posterior, field), getattr(prior, field), atol=1e-15)


@pytest.mark.parametrize("which", [update_linear, update_root])
def test_a_measurement_beyond_the_gate_changes_nothing_and_is_reported(which):
    prior = a_belief() if which is update_linear else rooted(a_belief())
    posterior, innovation = update(prior, np.full(3, 100.0), which, gate=16.3)
    assert not innovation.accepted
    assert innovation.nis > 16.3
    for field in prior._fields:
        np.testing.assert_allclose(getattr(posterior, field), getattr(prior, field), atol=1e-15)
    near = H @ prior.mean + 0.01
    assert update(prior, near, which, gate=16.3)[1].accepted
    moved = update(prior, near, which, gate=16.3)[0].mean
    np.testing.assert_array_equal(moved, update(prior, near, which)[0].mean)


# Roots


def test_the_triangle_of_a_wide_matrix():
    A = RNG.normal(size=(5, 4, 7))
    L = lower_root(A, xp=np)
    np.testing.assert_allclose(L, np.linalg.cholesky(A @ A.mT), atol=1e-12)
    np.testing.assert_array_equal(lower_root(np.zeros((2, 3)), xp=np), np.zeros((2, 2)))


def test_the_root_of_a_singular_matrix():
    wide = RNG.normal(size=(4, 2))
    P = wide @ wide.T
    L = semidefinite_root(P, xp=np)
    np.testing.assert_allclose(L @ L.T, P, atol=1e-12)
    np.testing.assert_array_equal(semidefinite_root(np.zeros((3, 3)), xp=np), np.zeros((3, 3)))


def test_the_filter_on_roots_is_the_filter():
    model, plain = a_model(), a_belief()
    root = rooted(plain)
    for _ in range(50):
        u, z = RNG.normal(size=2), RNG.normal(size=3)
        plain = predict_linear.step(plain, u, model=model, dt=0.1, xp=np)
        root = predict_root.step(root, u, model=model, dt=0.1, xp=np)
        plain, a = update(plain, z)
        root, b = update(root, z, update_root)
        same(unrooted(root), plain, 1e-9)
        np.testing.assert_allclose(a.nis, b.nis, rtol=1e-8)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-8)


def precise(start: float, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The least eigenvalues over ten precise, nearly equal measurements: short form, Joseph form, root."""
    rng = np.random.default_rng(seed)
    short, R1 = np.eye(3) * start, np.array([[noise]])
    plain = Gaussian(mean=np.zeros(3), covariance=short)
    root, base, least = rooted(plain), rng.normal(size=(1, 3)), []
    for _ in range(10):
        row = base + 1e-4 * rng.normal(size=(1, 3))
        K = short @ row.T / (row @ short @ row.T + R1)
        short = (np.eye(3) - K @ row) @ short
        plain = update(plain, np.zeros(1), H=row, R=R1)[0]
        root = update(root, np.zeros(1), update_root, H=row, R=R1)[0]
        np.testing.assert_array_equal(plain.covariance, plain.covariance.T)
        eigenvalues = [np.linalg.eigvalsh(0.5 * (x + x.T))[0] for x in (short, plain.covariance)]
        least.append([*eigenvalues, np.diagonal(root.root).min()])
    return tuple(np.min(least, axis=0))  # type: ignore[return-value]


def test_joseph_form_stays_positive_with_good_measurements_and_the_root_with_any():
    for seed in range(5):
        _, joseph, root = precise(1e3, 1e-3, seed)
        assert joseph > 0.0
        assert root > 0.0
    hard = [precise(1e8, 1e-8, seed) for seed in range(5)]  # 16 digits between start and noise
    assert min(short for short, _, _ in hard) < 0.0
    assert min(joseph for _, joseph, _ in hard) < 0.0
    assert all(root > 0.0 for _, _, root in hard)


# States that are no vectors

POSE = StateSpace(euclidean(3), quaternion(), angle())


def states(n: int) -> np.ndarray:
    q = RNG.normal(size=(n, 4))
    return np.concatenate(
        [RNG.normal(size=(n, 3)), q / np.linalg.norm(q, axis=1)[:, None], RNG.uniform(-3, 3, (n, 1))], axis=1
    )


def test_plus_undoes_minus():
    a, b = states(20), states(20)
    assert (POSE.size, POSE.tangent) == (8, 7)
    back = POSE.plus(b, POSE.minus(a, b, np), np)
    np.testing.assert_allclose(POSE.minus(back, a, np), 0.0, atol=1e-12)


def test_an_angle_is_wrapped_and_half_a_turn_is_pi():
    turn = StateSpace(angle())
    np.testing.assert_allclose(turn.minus(np.array([3.1]), np.array([-3.1]), np), [6.2 - 2 * np.pi])
    np.testing.assert_allclose(turn.plus(np.array([3.0]), np.array([0.5]), np), [3.5 - 2 * np.pi])
    assert turn.plus(np.array([0.0]), np.array([-np.pi]), np)[0] == np.pi


def test_the_mean_is_where_differences_cancel():
    middle, weights = states(1)[0], np.full(6, 1 / 6)
    points = POSE.plus(middle, RNG.normal(size=(6, 7)) * 0.4, np)
    found = POSE.mean(points, weights, np)
    np.testing.assert_allclose(weights @ POSE.minus(points, found, np), 0.0, atol=1e-9)
    around = StateSpace(angle()).mean(np.array([[3.1], [-3.1]]), np.array([0.5, 0.5]), np)
    np.testing.assert_allclose(np.abs(around), np.pi)


def test_a_space_needs_parts():
    with pytest.raises(DeclarationError, match="is made of parts"):
        StateSpace()
    assert repr(POSE) == "StateSpace(euclidean(3), quaternion(4), angle(1))"


@pytest.mark.parametrize("which", [update_linear, update_root])
def test_a_heading_is_corrected_the_short_way(which):
    space = StateSpace(euclidean(1), angle())
    plain = Gaussian(mean=np.array([0.0, 3.1]), covariance=np.eye(2) * 0.1)
    prior = plain if which is update_linear else rooted(plain)
    options = {"H": [[0.0, 1.0]], "R": [[0.1]], "space": space, "measured_space": StateSpace(angle())}
    posterior, innovation = update(prior, np.array([-3.1]), which, **options)
    np.testing.assert_allclose(innovation.residual, [2 * np.pi - 6.2])
    np.testing.assert_allclose(np.abs(posterior.mean[1]), np.pi, atol=1e-12)


def look_up(x: Any, xp: Any) -> tuple[Any, Any]:
    """The whole state (position, quaternion) is measured."""
    return x, xp.eye(6, dtype=x.dtype)


def test_a_quaternion_is_corrected_by_a_rotation_whatever_its_sign():
    space = StateSpace(euclidean(3), quaternion())
    start = states(1)[0, :7]
    prior = Gaussian(mean=start, covariance=np.eye(6) * 0.04)
    turn = np.array([0.1, -0.2, 0.05])
    measured = np.r_[start[:3] + 0.1, multiply(start[3:], from_rotation_vector(turn, xp=np), xp=np)]
    for sign in (1.0, -1.0):
        z = measured * np.r_[1, 1, 1, [sign] * 4]
        options = {"observe": look_up, "R": np.eye(6) * 0.04, "space": space, "measured_space": space}
        posterior, found = update_extended.step(prior, z, xp=np, **options)
        np.testing.assert_allclose(np.linalg.norm(posterior.mean[3:]), 1.0)
        np.testing.assert_allclose(
            space.minus(posterior.mean, start, np), np.r_[[0.05] * 3, turn / 2], atol=1e-9
        )
        np.testing.assert_allclose(found.value.residual, np.r_[[0.1] * 3, turn], atol=1e-12)
    assert update_extended.step(prior, None, xp=np, **options) == (prior, None)


def bearing(x: Any, xp: Any) -> tuple[Any, Any]:
    """The angle and the distance at which a point of the plane is seen, and their Jacobian."""
    a, b = x[..., 0], x[..., 1]
    r = xp.sqrt(a * a + b * b)
    H = xp.stack([xp.stack([-b / r**2, a / r**2]), xp.stack([a / r, b / r])])
    return xp.stack([xp.atan2(b, a), r]), xp.concat([H, 0.0 * H], axis=-1)


@pytest.mark.parametrize("gate", [None, 0.999, 1e-6])
@pytest.mark.parametrize("gap", [False, True])
def test_the_extended_update_on_roots_is_the_extended_update(gap, gate):
    prior = Gaussian(mean=np.array([2.0, -1.0, 0.3, 0.1]), covariance=a_belief().covariance * 0.01)
    z = np.array([-0.4, np.nan if gap else 2.3])
    options = {"observe": bearing, "R": np.diag([0.01, 0.04]), "gate": gate}
    options["measured_space"] = StateSpace(angle(), euclidean(1))
    plain, heard = update_extended.step(prior, z, xp=np, **options)
    root, heard_too = update_extended_root.step(rooted(prior), z, xp=np, **options)
    same(unrooted(root), plain)
    for leaf in ("residual", "covariance", "nis", "parts", "accepted"):
        a, b = getattr(heard.value, leaf), getattr(heard_too.value, leaf)
        np.testing.assert_allclose(a, b, atol=1e-12)
    assert update_extended_root.step(rooted(prior), None, xp=np, **options)[1] is None


# In a graph, in every engine

TRACK = LinearModel([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 0.5]))

Push: TypeAlias = Annotated[Any, real(1)]
Pair: TypeAlias = Annotated[Any, real(2)]


@graph
def both_forms(u: Stream[Push], z: Stream[Pair], *, start, gate=None):
    """A track of position and velocity, twice: by its covariance, and by the root of it."""
    plain, root = delay(start, name="plain"), delay(rooted(start), name="root")
    settings = {"H": np.eye(2), "R": np.diag([0.1, 0.2]), "gate": gate}
    ticks = u | z
    control = latest(u, init=np.zeros(1))
    a = predict_linear(plain, control, model=TRACK, at=ticks)
    a, heard = update_linear(a, z, **settings)
    b = predict_root(root, control, model=TRACK, at=ticks)
    b, heard_too = update_root(b, z, **settings)
    plain.feed(a)
    root.feed(b)
    return {"plain": a, "root": b, "heard": heard, "heard_too": heard_too}


def track(not_finite: str = "keep") -> dict[str, Any]:
    time = np.arange(60) * 10_000_000
    z = np.stack([np.sin(time * 1e-9), np.cos(time * 1e-9)], axis=1)
    z[::3, 0], z[::4, 1] = np.nan, np.nan
    z[7] = 50.0
    return {
        "u": Series(time, -np.sin(time * 1e-9)[:, None]),
        "z": arrays(time[::2] + 3_000_000, z[::2], not_finite=not_finite),
    }


def test_missing_entries_pass_through_every_engine_and_reach_nothing():
    pytest.importorskip("jax")
    start = Gaussian(mean=np.array([0.1, 0.9]), covariance=np.eye(2))
    built = both_forms.build(start=start, gate=20.0)
    result = all_engines(built, track())
    for series in result.series.values():
        for leaf in series.leaves.values():
            assert np.isfinite(leaf).all()
    np.testing.assert_allclose(result["plain"].mean, result["root"].mean, atol=1e-9)
    heard = result["heard"]
    assert len(heard) == len(track()["z"]) - 5  # where both are missing there is none
    assert set(heard.parts) == {1.0, 2.0}
    np.testing.assert_array_equal(heard.accepted, result["heard_too"].accepted)


def test_nan_is_refused_where_it_is_not_declared_as_data():
    start = Gaussian(mean=np.zeros(2), covariance=np.eye(2))
    built = both_forms.build(start=start)
    with pytest.raises(DataError, match="a value is not finite"):
        simulate(built, {**track(), "z": Series(track()["z"].time, track()["z"]["value"])})
    gone = track("absent")
    assert len(gone["z"]) < len(track()["z"])
    infinite = track()["z"]["value"].copy()
    infinite[4, 0] = np.inf
    with pytest.raises(DataError, match=r"z, row 4 \(1 in all\): a value is not finite"):
        simulate(built, {**track(), "z": arrays(track()["z"].time, infinite, not_finite="keep")})
    assert track()["z"][3:].gaps
