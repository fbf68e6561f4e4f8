"""What can be set of the filters with Euler angles, and what they take of the flight: a lever."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Flight, LoweringError, Series, load_flight, lower, simulate
from flowgraph.blocks.geometry.euler import matrix_from_angles, quaternion_from_angles
from flowgraph.blocks.geometry.rotations import rotate
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.models.euler_ins import (
    POSE_ANGLES,
    STATE,
    see_pose_angles,
    seen_place,
    update_pose_angles,
)
from flowgraph.blocks.models.particle_ins import correct_states
from flowgraph.blocks.models.unscented_ins import far_points
from flowgraph.blocks.scoring.covariances import Covariance
from flowgraph.blocks.signals import Gaussian, PoseMeasurement, StateCloud
from flowgraph.cli.options import case_of
from flowgraph.graphs import ins_ekf_pose, ins_particle, ins_ukf_pose, ins_ukf_velocity
from flowgraph.graphs.tag_pose import poses_of
from tests.graphs.estimation import engines_agree

LEVER = (0.1, -0.08, 0.065)  # 144 mm
POSED = [ins_ekf_pose, ins_ukf_pose, ins_particle]


@cache
def captured(lever: tuple[float, float, float], seconds: str = "3") -> Flight:
    """A flight whose motion capture tells of a marker, and says where that sits."""
    made = load_flight("sim", seed=1, settings={"duration": seconds, "imu.rate": "100", "vicon.rate": "50"})
    vicon, truth = made.streams["vicon"], made.truth
    assert truth is not None
    away = rotate(truth["attitude"][:: len(truth) // (len(vicon) - 1)][: len(vicon)], np.array(lever), xp=np)
    marker = vicon.values.replace(position=vicon["position"] + away)
    streams = {**made.streams, "vicon": Series(vicon.time, marker, name="vicon")}
    return replace(made, streams=streams, info={**made.info, "vicon_lever": lever})


@cache
def tagged() -> Flight:
    made = load_flight("course", seed=1, settings={"duration": "1.5"})
    return replace(made, streams={**made.streams, "pose": poses_of("test", made)})


def score(graph: Any, made: Flight, **settings: Any) -> dict[str, float]:
    case = graph.case(made, **settings)
    return dict(case.score(simulate(case.graph, case.inputs)))


@pytest.mark.slow
@pytest.mark.parametrize("order", ["zxy", "zyx"])
@pytest.mark.parametrize("graph", [ins_ekf_pose, ins_ukf_pose], ids=lambda g: g.name)
@pytest.mark.parametrize("lever", [LEVER, (0.0, 0.0, 0.4)], ids=str)
def test_the_lever_of_a_motion_capture_is_taken_out(graph, order, lever):
    """Ignored, its 144 mm are the error."""
    none = score(graph, captured((0.0, 0.0, 0.0)), order=order)
    found = score(graph, captured(lever), order=order)
    assert found["position_rmse_m"] < 1.1 * none["position_rmse_m"] < 0.02
    assert found["attitude_rmse_deg"] < 1.1 * none["attitude_rmse_deg"]
    assert 0.7 < found["nis_mean"] < 1.3
    untold = replace(captured(lever), info={**captured(lever).info, "vicon_lever": (0.0, 0.0, 0.0)})
    assert score(graph, untold, order=order)["position_rmse_m"] > 0.12


def test_particles_are_weighed_where_the_marker_is():
    """With the marker of one of them, that one is the likeliest; without the lever another would be."""
    rng = np.random.default_rng(0)
    states = np.concatenate([rng.normal(size=(50, 3)), rng.uniform(-0.5, 0.5, (50, 3)), np.zeros((50, 9))], 1)
    states[:, 3:6] = states[:1, 3:6]
    cloud = StateCloud(log_weight=np.full(50, -np.log(50.0)), state=states)
    q = np.asarray(quaternion_from_angles(states[0, 3:6], order="zxy", xp=np))
    weigh = lambda z, **more: correct_states.step(
        np.float64(0.0), cloud, as_pose(z, q), order="zxy", R=np.eye(6) * 1e-4, bandwidth=0.0, xp=np, **more
    )[1][0]
    for k in (0, 7, 23):
        marker = np.asarray(seen_place(states[k], LEVER, order="zxy", xp=np))
        found = weigh(marker, lever=LEVER)
        assert np.argmax(found.log_weight) == k
        np.testing.assert_allclose(found.log_weight, weigh(states[k, :3]).log_weight, atol=1e-9)


def test_particles_are_told_of_the_lever():
    case = ins_particle.case(captured(LEVER), particles=50)
    result = simulate(case.graph, {n: s[:2] for n, s in case.inputs.items()})  # type: ignore[union-attr]
    truth = captured(LEVER).truth
    assert truth is not None
    assert np.linalg.norm(result["belief"]["position"][0] - truth["position"][0]) < 0.05


def as_pose(position: np.ndarray, attitude: np.ndarray) -> PoseMeasurement:
    return PoseMeasurement(position, attitude, np.zeros((6, 6)), np.asarray(0.0), np.asarray(1))


def test_a_lever_said_of_a_table_is_heeded(tmp_path):
    made = captured(LEVER)
    imu, vicon = made.streams["imu"], made.streams["vicon"]
    header = "t,gx,gy,gz,ax,ay,az"
    rows = np.concatenate([imu.seconds[:, None], imu["gyro"], imu["specific_force"]], axis=1)
    np.savetxt(tmp_path / "imu.csv", rows, delimiter=",", header=header, comments="")
    rows = np.concatenate([vicon.seconds[:, None], vicon["position"], vicon["attitude"]], axis=1)
    np.savetxt(tmp_path / "vicon.csv", rows, delimiter=",", header="t,x,y,z,w,i,j,k", comments="")
    words = ["imu.gyro=gx,gy,gz", "imu.specific_force=ax,ay,az", "vicon.position=x,y,z"]
    words += ["vicon.attitude=w,i,j,k", "vicon.lever=" + ",".join(map(str, LEVER))]
    spec = f"csv:{tmp_path}/imu.csv+csv:{tmp_path}/vicon.csv"
    case, _ = case_of("ins_ekf_pose", spec, words, 0)
    belief = simulate(case.graph, case.inputs)["belief"]
    assert made.truth is not None
    apart = belief["position"] - made.truth["position"][: len(belief)]
    assert np.sqrt(np.mean(np.sum(apart[100:] ** 2, axis=1))) < 0.02


def test_a_pose_of_pnp_has_no_lever():
    """It is of the body already, whatever the motion capture beside it tells of."""
    made = tagged()
    told = replace(made, info={**made.info, "vicon_lever": LEVER})
    assert score(ins_ukf_pose, told) == score(ins_ukf_pose, made)
    other = score(ins_ukf_pose, replace(made, info={**made.info, "pose_lever": LEVER}))
    assert other["position_rmse_m"] > 0.1


@pytest.mark.parametrize("order", ["zxy", "zyx"])
@pytest.mark.parametrize("seed", range(3))
def test_the_jacobian_of_a_lever(order, seed):
    rng = np.random.default_rng(seed)
    e, lever = rng.uniform(-1.0, 1.0, 3), tuple(rng.uniform(-1.0, 1.0, 3))
    x = np.concatenate([rng.normal(size=3), e, rng.normal(size=9)])
    _, H = linearised(see_pose_angles(lever, order=order), x, STATE, np, seen=POSE_ANGLES)
    for k, step in enumerate(np.eye(15) * 1e-6):
        moved = [seen_place(x + s, lever, order=order, xp=np) for s in (step, -step)]
        np.testing.assert_allclose(H[:3, k], (moved[0] - moved[1]) / 2e-6, atol=1e-8)
    np.testing.assert_allclose(H[3:], np.eye(6, 15)[3:], atol=1e-15)
    expected = x[:3] + np.asarray(matrix_from_angles(e, order=order, xp=np)) @ np.array(lever)
    np.testing.assert_allclose(seen_place(x, lever, order=order, xp=np), expected)


@pytest.mark.slow
def test_the_engines_agree_on_a_lever():
    pytest.importorskip("jax")
    for graph in (ins_ekf_pose, ins_ukf_pose):
        case = graph.case(captured(LEVER, "0.1"), settle=0.0)
        engines_agree(case.graph, case.inputs)


# The covariance of a measured pose


def test_the_whole_covariance_of_a_pose_can_be_set(tmp_path):
    made = tagged()
    plain = score(ins_ukf_pose, made, position_noise=0.01, attitude_noise=0.02)
    diagonal = np.square(np.repeat([0.01, 0.02], 3))
    assert score(ins_ukf_pose, made, R=np.diag(diagonal)) == plain
    np.savetxt(tmp_path / "R.txt", np.diag(diagonal))
    for words in (",".join(map(str, diagonal)), str(tmp_path / "R.txt")):
        case, _ = case_of("ins_ukf_pose", "course", ["duration=1.5", f"R={words}"], 1)
        assert case.score(simulate(case.graph, case.inputs)) == plain
    assert score(ins_ekf_pose, made, R=np.full(6, 1.0))["position_rmse_m"] > plain["position_rmse_m"]


def test_what_is_correlated_in_the_covariance_is_heeded():
    """Two numbers that err together: where the one is known, the other's error is known."""
    R = np.eye(6) * 1e-2
    R[0, 1] = R[1, 0] = 0.999e-2
    prior = Gaussian(mean=np.zeros(15), covariance=np.diag([1e-12, *[1.0] * 14]))
    q = np.asarray(quaternion_from_angles(np.zeros(3), order="zxy", xp=np))
    found, _ = update_pose_angles.step(prior, as_pose(np.array([0.3, 0.5, 0.0]), q), order="zxy", R=R, xp=np)
    np.testing.assert_allclose(found.mean[1], 0.2, atol=1e-3)
    assert found.covariance[1, 1] < 3e-5


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.eye(5), r"setting 'R' is no covariance[\s\S]*\(6, 6\)"),
        (-1.0, r"setting 'R' is no covariance[\s\S]*no negative variance"),
        (np.ones((6, 6)), r"setting 'R' is no covariance[\s\S]*all eigenvalues positive"),
        (np.triu(np.ones((6, 6))), r"setting 'R' is no covariance[\s\S]*symmetric"),
        (0.0, r"all eigenvalues positive"),
        ({"x": 1}, r"setting 'R' is no covariance[\s\S]*1, 6 or 36 numbers"),
    ],
    ids=["five", "negative", "singular", "triangle", "zero", "words"],
)
def test_what_is_no_covariance_is_refused(given, message):
    with pytest.raises(DeclarationError, match=message):
        ins_ekf_pose.case(tagged(), R=given)


def test_covariances_in_words_that_are_none(tmp_path):
    for words in ("much", "1,2,x", "1_0"):
        with pytest.raises(DeclarationError, match="cannot be read"):
            case_of("ins_ekf_pose", "course", ["duration=0.1", f"R={words}"], 1)
    (tmp_path / "R.txt").write_text("1 2 3\n4 5\n")
    for file in ("R.txt", "none.txt"):
        with pytest.raises(DataError, match="this file holds no covariance"):
            case_of("ins_ekf_pose", "course", ["duration=0.1", f"R={tmp_path / file}"], 1)
    with pytest.raises(DeclarationError, match="the noise of a pose is said twice"):
        ins_ekf_pose.case(tagged(), R=1e-4, position_noise=0.1)
    flat = Covariance(",".join(map(str, np.diag(np.arange(1.0, 7.0)).ravel())))
    np.testing.assert_array_equal(flat.matrix(6), np.diag(np.arange(1.0, 7.0)))


# Biases and sigma points


@pytest.mark.parametrize("graph", [ins_ekf_pose, ins_ukf_pose, ins_ukf_velocity], ids=lambda g: g.name)
def test_the_walks_of_the_biases_can_be_set(graph):
    """A walk a hundred times wider leaves the bias less sure; one of zero keeps what was learned."""
    sizes = []
    for walk in (0.0, None, 1e-2):
        case = graph.case(tagged(), gyro_bias_noise=walk, accelerometer_bias_noise=walk)
        P = simulate(case.graph, case.inputs)["belief"]["covariance"][-1]
        sizes.append(np.trace(P[9:12, 9:12]))
    assert sizes[0] < sizes[1] < sizes[2]
    with pytest.raises(DeclarationError, match="gyro_bias_noise"):
        graph.case(tagged(), gyro_bias_noise=-1.0)


@pytest.mark.parametrize("graph", [ins_ukf_pose, ins_ukf_velocity], ids=lambda g: g.name)
def test_the_sigma_points_can_be_set(graph):
    made = tagged()
    plain = score(graph, made)
    near = score(graph, made, alpha=0.01)
    assert near != plain
    assert near["position_rmse_m"] == pytest.approx(plain["position_rmse_m"], rel=0.05)
    assert score(graph, made, kappa=-12.0)["position_rmse_m"] == pytest.approx(
        plain["position_rmse_m"], rel=0.05
    )
    with pytest.raises(DeclarationError, match="kappa takes all the spread away"):
        graph.case(made, kappa=-27.0)
    with pytest.raises(DeclarationError, match="alpha"):
        graph.case(made, alpha=0.0)
    with pytest.raises(LoweringError, match="drown in the rounding"):
        lower(graph.case(made, alpha=0.01).graph, dtype="float32")


def test_where_the_points_lie():
    for kappa in (0.0, 3.0, -5.0):
        assert far_points(12, kappa=kappa).scale(27) == pytest.approx(np.sqrt(3.0))
    assert far_points(12, alpha=0.5, kappa=9.0).scale(27) == pytest.approx(3.0)
