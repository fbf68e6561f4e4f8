"""Cameras, tags, PnP, maps, and the motion of a camera on a body."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowgraph import DataError, DeclarationError, Series, UnknownNameError
from flowgraph.blocks.datasets.course import Motion, see, simulated_content
from flowgraph.blocks.datasets.parameters import Parameters
from flowgraph.blocks.datasets.studentdata import packet_tags
from flowgraph.blocks.geometry import to_matrix
from flowgraph.blocks.models.unscented_ins import update_camera_velocity
from flowgraph.blocks.signals import CameraMotion, Gaussian, Imu, MotionTruth
from flowgraph.blocks.vision import TagMap, course_map
from flowgraph.blocks.vision.camera import COURSE_CAMERA, COURSE_MOUNT, Camera, Mount
from flowgraph.blocks.vision.mapping import _first_guess, _Problem, build_map
from flowgraph.blocks.vision.motion import adjoint, camera_velocity, find_delay, velocity_error
from flowgraph.blocks.vision.pnp import measure, quaternion_of, rotation_of, solve

PINHOLE = Camera(np.array([[364.0, 0.0, 289.0], [0.0, 364.0, 290.0], [0.0, 0.0, 1.0]]))
COURSE = Parameters.of_the_course()


# Camera and map


def test_distortion_is_that_of_opencv_and_is_undone():
    import cv2

    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.6, 0.6, (200, 2)), np.ones((200, 1))], axis=1)
    theirs = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), COURSE_CAMERA.K, np.array(COURSE_CAMERA.distortion)
    )[0][:, 0]
    ours = COURSE_CAMERA.project(points)
    np.testing.assert_allclose(ours, theirs, atol=1e-9)
    np.testing.assert_allclose(COURSE_CAMERA.undistort(ours), points[:, :2], atol=1e-10)
    assert COURSE_CAMERA.rectified().distortion == (0.0,) * 5


def test_a_malformed_camera_or_mount_is_refused():
    with pytest.raises(DeclarationError, match=r"no camera matrix[\s\S]*transposed"):
        Camera(COURSE_CAMERA.K.T)
    with pytest.raises(DeclarationError, match=r"no distortion[\s\S]*5 finite numbers"):
        Camera(COURSE_CAMERA.K, (0.0, 1.0))  # type: ignore[arg-type]
    with pytest.raises(DeclarationError, match=r"no mount of a camera"):
        Mount(np.eye(3) * 2.0, np.zeros(3))


def test_the_mat_of_the_course():
    found = course_map()
    assert len(found) == 108
    corners, known = found.find([0, 1, 12, 36, 72, 107, 108])
    assert known.tolist() == [True] * 6 + [False]
    np.testing.assert_allclose(corners[0, 3], [0.0, 0.0, 0.0])  # top-left of the top-left tag
    square = np.array([[1.0, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]]) * 0.152
    np.testing.assert_allclose(corners[0], square)
    np.testing.assert_allclose(corners[1, 3], [0.304, 0.0, 0.0])  # next below
    np.testing.assert_allclose(corners[2, 3], [0.0, 0.304, 0.0])  # next to the right
    np.testing.assert_allclose(corners[3, 3], [0.0, 3 * 0.304 + 0.026, 0.0])  # beyond one wide gap
    np.testing.assert_allclose(corners[4, 3], [0.0, 6 * 0.304 + 0.052, 0.0])  # beyond both


def test_a_map_is_written_and_read(tmp_path):
    file = tmp_path / "map.json"
    course_map().save(file)
    found = TagMap.load(file)
    np.testing.assert_array_equal(found.ids, course_map().ids)
    np.testing.assert_array_equal(found.corners, course_map().corners)
    file.write_text('{"tags": [{"id": 1}]}')
    with pytest.raises(DataError, match=r"map\.json: this is no tag map[\s\S]*KeyError"):
        TagMap.load(file)
    with pytest.raises(DeclarationError, match=r"this is no tag map[\s\S]*1 different"):
        TagMap(np.array([1, 1]), np.zeros((2, 4, 3)))


def test_the_mount_of_the_course_is_where_its_velocities_say():
    np.testing.assert_allclose(COURSE_MOUNT.camera_in_body, [0.0283, -0.0283, -0.03], atol=1e-4)
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    p = np.array([1.0, 2.0, 3.0])
    found = COURSE_MOUNT.body_pose(*COURSE_MOUNT.view(p, R))
    np.testing.assert_allclose(found[0], p, atol=1e-14)
    np.testing.assert_allclose(found[1], R, atol=1e-14)


# PnP


def a_view(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    t = np.array([float(seed)])
    p, R = Motion(seed).position(t)[0], Motion(seed).attitude(t)[0]
    return p, R, *see(COURSE, COURSE_CAMERA, p, R)


def found_at(ids: np.ndarray, corners: np.ndarray, **more: Any) -> Any:
    return measure(ids, corners, tag_map=COURSE.tag_map, camera=COURSE_CAMERA, mount=COURSE_MOUNT, **more)


def test_without_noise_the_pose_is_exact():
    for seed in range(10):
        p, R, ids, corners = a_view(seed)
        pose = found_at(ids, corners)
        np.testing.assert_allclose(pose.position, p, atol=1e-9)
        np.testing.assert_allclose(rotation_of(pose.attitude), R, atol=1e-9)
        assert pose.error < 1e-8
        assert pose.tags == len(ids)


def test_with_noise_the_covariance_is_what_the_errors_show():
    """300 draws of 0.5 px noise: no bias beyond its own uncertainty, and errors as large as was said."""
    p, R, ids, corners = a_view(3)
    rng = np.random.default_rng(0)
    errors, said = [], []
    for _ in range(300):
        pose = found_at(ids, corners + rng.normal(size=corners.shape) * 0.5)
        turn = Rotation.from_matrix(R.T @ rotation_of(pose.attitude)).as_rotvec()
        errors.append(np.concatenate([pose.position - p, turn]))
        said.append(pose.covariance)
    E, P = np.array(errors), np.mean(said, axis=0)
    deviation = np.sqrt(np.diag(P))
    assert (np.abs(E.mean(axis=0)) < 4.0 * deviation / np.sqrt(300)).all()
    np.testing.assert_allclose(E.std(axis=0) / deviation, 1.0, atol=0.15)
    nees = np.einsum("ni,nij,nj->n", E, np.linalg.inv(said), E)
    assert 5.2 < nees.mean() < 6.8


def test_the_flip_of_a_small_plane_is_resolved_by_what_came_before():
    """One tag, seen nearly from the front and noisy: the corners alone take the wrong pose now and then."""
    R = Rotation.from_euler("ZXY", [0.2, 0.12, -0.1]).as_matrix()
    p = np.array([0.9, 0.9, 1.8])
    every, corners = see(COURSE, COURSE_CAMERA, p, R)
    near = p + 0.02, R @ Rotation.from_rotvec([0.02, -0.02, 0.01]).as_matrix()
    rng = np.random.default_rng(1)
    wrong = {"alone": 0, "near": 0}
    for k in range(60):
        one = slice(k % len(every), k % len(every) + 1)
        z = corners[one] + rng.normal(size=(1, 4, 2)) * 0.5
        for name, prior in (("alone", None), ("near", near)):
            pose = found_at(every[one], z, near=prior)
            turn = Rotation.from_matrix(R.T @ rotation_of(pose.attitude)).magnitude()
            wrong[name] += int(turn > 0.25)
    assert wrong["alone"] > 2 * wrong["near"]
    assert wrong["near"] <= 3


def test_what_gives_no_pose():
    _, _, ids, corners = a_view(0)
    assert found_at(ids + 1000, corners) is None
    assert solve(np.zeros((0, 4, 2)), np.zeros((0, 4, 3)), PINHOLE) is None
    line = np.zeros((1, 4, 3))
    line[0, :, 0] = np.arange(4.0)
    assert solve(np.full((1, 4, 2), 100.0), line, PINHOLE) is None


# Maps


def surveyed(noise: float) -> tuple[TagMap, list[tuple[np.ndarray, np.ndarray]]]:
    """A mat that is not quite flat, and 30 images of it."""
    rng = np.random.default_rng(0)
    ids = np.arange(20)
    place = np.stack([(ids % 5) * 0.4, (ids // 5) * 0.4, 0.01 * rng.normal(size=20)], axis=1)
    turns = Rotation.from_rotvec(np.stack([*(0.02 * rng.normal(size=(2, 20))), 0.3 * rng.normal(size=20)], 1))
    half = 0.1
    square = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    corners = np.einsum("nij,kj->nki", turns.as_matrix(), square) + place[:, None]
    true = TagMap(ids, corners)
    frames = []
    for _ in range(30):
        R = (
            Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec(0.25 * rng.normal(size=3))
        ).as_matrix()
        centre = np.array([*rng.uniform([0.2, 0.2], [1.4, 1.0]), rng.uniform(0.8, 1.4)])
        pixels = PINHOLE.project((true.corners - centre) @ R.T)
        inside = ((pixels > 0.0) & (pixels < 576.0)).all(axis=(1, 2))
        frames.append((ids[inside], pixels[inside] + noise * rng.normal(size=pixels[inside].shape)))
    return true, frames


def apart(found: TagMap, true: TagMap) -> float:
    """The largest distance of corners after the best rigid motion, m."""
    A, B = found.corners.reshape(-1, 3), true.only(found.ids).corners.reshape(-1, 3)
    turn, _ = Rotation.align_vectors(B - B.mean(axis=0), A - A.mean(axis=0))
    return float(np.abs(turn.apply(A - A.mean(axis=0)) + B.mean(axis=0) - B).max())


def test_a_map_of_exact_corners_is_exact_and_one_of_noisy_corners_is_near():
    true, frames = surveyed(0.0)
    survey = build_map(frames, PINHOLE, side=0.2)
    assert len(survey.tag_map) == 20
    assert apart(survey.tag_map, true) < 1e-5
    assert survey.error < 1e-3
    true, frames = surveyed(0.3)
    noisy = build_map(frames, PINHOLE, side=0.2)
    assert apart(noisy.tag_map, true) < 0.005
    assert 0.2 < noisy.error < 0.5
    assert build_map(frames, PINHOLE, side=0.2, flat=True).error > 2.0 * noisy.error


@pytest.mark.parametrize("flat", [False, True])
def test_the_jacobian_of_the_adjustment(flat):
    _, frames = surveyed(0.3)
    half = 0.1
    square = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    root = int(frames[0][0][0])
    problem = _Problem(
        frames[:3], *_first_guess(frames[:3], PINHOLE, root, square), PINHOLE, root, square, flat
    )
    x = problem.start + 0.01 * np.random.default_rng(0).normal(size=len(problem.start))
    J = problem.jacobian(x)
    h = 1e-6
    numeric = np.stack(
        [(problem.residuals(x + h * d) - problem.residuals(x - h * d)) / (2 * h) for d in np.eye(len(x))],
        axis=1,
    )
    np.testing.assert_allclose(J.toarray(), numeric, atol=1e-4 * np.abs(numeric).max())
    assert J.nnz < 0.5 * J.shape[0] * J.shape[1]


def test_images_that_make_no_map_are_refused():
    with pytest.raises(DataError, match=r"make no map[\s\S]*0 images"):
        build_map([], PINHOLE, side=0.2)
    _, frames = surveyed(0.0)
    with pytest.raises(DataError, match=r"make no map[\s\S]*origin 77"):
        build_map(frames, PINHOLE, side=0.2, origin=77)


# Motion


def test_the_velocities_of_a_camera_are_those_of_rigid_body_kinematics():
    """Equations 9 and 10: five-point differences of the camera's place and attitude, to 1e-9."""
    rng = np.random.default_rng(0)
    mount = Mount(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3))
    r = mount.camera_in_body
    for _ in range(10):
        v, w, turn = rng.normal(size=3), rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3))
        attitude = lambda t, turn=turn, w=w: (turn * Rotation.from_rotvec(w * t)).as_matrix()
        place = lambda t, v=v, attitude=attitude: v * t + attitude(t) @ r
        h = 1e-3
        slope = lambda f, h=h: (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)
        R = attitude(0.0)
        in_camera = mount.rotation @ R.T
        velocity = in_camera @ slope(place)
        turning = R.T @ slope(attitude)
        rate = mount.rotation @ np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
        both = adjoint(mount) @ np.concatenate([R.T @ v, w])
        np.testing.assert_allclose(both, np.concatenate([velocity, rate]), atol=1e-9)
        eq_9 = camera_velocity(v, R, mount.rotation.T @ rate, mount=mount, xp=np)
        bias = rng.normal(size=3)
        eq_10 = camera_velocity(v, R, (w + bias) - bias, mount=mount, xp=np)
        np.testing.assert_allclose(eq_9, velocity, atol=1e-9)
        np.testing.assert_allclose(eq_10, velocity, atol=1e-9)


@pytest.mark.parametrize("rate", ["gyro", "camera"])
def test_a_camera_velocity_corrects_the_velocity(rate):
    """With exact measurements and a wrong prior the velocity is found; without one the prior passes."""
    rng = np.random.default_rng(0)
    truth = np.concatenate([np.zeros(3), [0.1, -0.2, 0.3], [1.0, -0.5, 0.2], [0.02, 0.0, -0.01], np.zeros(3)])
    w = np.array([0.5, -1.0, 0.8])
    from flowgraph.blocks.geometry import matrix_from_angles

    R = np.asarray(matrix_from_angles(truth[3:6], order="zyx", xp=np))
    v = camera_velocity(truth[6:9], R, w, mount=COURSE_MOUNT, xp=np)
    motion = CameraMotion(velocity=np.asarray(v), rate=COURSE_MOUNT.rotation @ w)
    imu = Imu(gyro=w + truth[9:12], specific_force=np.array([0.0, 0.0, 9.81]))
    wrong = truth.copy()
    wrong[6:9] += 0.3 * rng.normal(size=3)
    P = np.diag(np.repeat([1e-4, 1e-8, 0.1, 1e-8, 1e-4], 3))
    settings: dict[str, Any] = {
        "order": "zyx",
        "mount": COURSE_MOUNT,
        "velocity_noise": 1e-3,
        "rate_noise": 1e-3,
        "rate": rate,
        "xp": np,
    }
    prior = Gaussian(mean=wrong, covariance=P)
    posterior, innovation = update_camera_velocity.step(prior, motion, imu, **settings)
    np.testing.assert_allclose(posterior.mean[6:9], truth[6:9], atol=1e-4)
    np.testing.assert_array_equal(posterior.covariance, posterior.covariance.T)
    assert np.linalg.eigvalsh(posterior.covariance)[0] > 0.0
    assert innovation.parts == 3
    assert update_camera_velocity.step(prior, None, imu, **settings) == (prior, None)
    with pytest.raises(UnknownNameError, match=r"camera, gyro"):
        update_camera_velocity.step(prior, motion, imu, **{**settings, "rate": "wheel"})


def test_a_delay_is_found():
    flight = Motion(1)
    t = np.arange(0.0, 6.0, 0.01)
    q = np.array([quaternion_of(R) for R in flight.attitude(t)])
    truth = Series.from_seconds(
        t, MotionTruth(flight.position(t), flight.velocity(t), q, flight.gyro(t)), name="truth"
    )
    s = np.arange(0.5, 5.5, 0.021)
    R, w = flight.attitude(s), flight.gyro(s)
    v = camera_velocity(flight.velocity(s), R, w, mount=COURSE_MOUNT, xp=np)
    late = Series.from_seconds(s + 0.043, CameraMotion(v, w @ COURSE_MOUNT.rotation.T), name="motion")
    assert find_delay(late, truth, COURSE_MOUNT) == pytest.approx(0.043)
    assert velocity_error(late, truth, COURSE_MOUNT, 0.043) < 1e-3
    assert np.allclose(to_matrix(q, xp=np), flight.attitude(t))
    with pytest.raises(DataError, match=r"do not overlap"):
        velocity_error(late, truth, COURSE_MOUNT, 100.0)


# Tags that were taken for others


def an_image(k: int = 0, tags: int = 99, noise: float = 0.5, seed: int = 1) -> tuple[Any, Any, Any]:
    """The ids and corners of a packet of a simulated flight, and where the body is."""
    made = simulated_content(seed, duration=0.01 * (k + 1), pixel_noise=noise)
    ids, corners = packet_tags(made["data"][k], "packet")
    return ids[:tags].copy(), corners[:tags].copy(), made["vicon"][:3, k]


def measured(ids: Any, corners: Any, **more: Any) -> Any:
    return measure(ids, corners, tag_map=course_map(), camera=COURSE_CAMERA, mount=COURSE_MOUNT, **more)


def spoil(ids: Any, corners: Any, how: str, which: int) -> None:
    if how == "an id":
        ids[which] = (ids[which] + 41) % 108
    elif how == "the order of corners":
        corners[which] = corners[which][[2, 3, 0, 1]]
    elif how == "a corner":
        corners[which, 1] += [25.0, -18.0]
    else:
        ids[which] = ids[which - 1]


SPOILT = ["an id", "the order of corners", "a corner", "an id that is there twice"]


@pytest.mark.parametrize("how", SPOILT)
@pytest.mark.parametrize(("tags", "wrong"), [(99, 1), (99, 3), (6, 2), (4, 1)])
def test_wrong_tags_are_left_out(how, tags, wrong):
    for seed in range(1, 4):
        ids, corners, place = an_image(3, tags, seed=seed)
        whole = measured(ids, corners)
        for which in range(1, 1 + wrong):
            spoil(ids, corners, how, which)
        found = measured(ids, corners)
        assert int(found.tags) == len(ids) - wrong
        error = found.position - place
        assert np.linalg.norm(error) < 0.06
        assert error @ np.linalg.solve(found.covariance[:3, :3], error) < 16.3  # 99.9 %
        assert np.trace(found.covariance) >= np.trace(whole.covariance)


def test_one_of_seventeen_costs_nothing():
    """It cost half a metre."""
    ids, corners, place = an_image(0, 17)
    assert len(ids) >= 8
    spoil(ids, corners, "an id", 5)
    assert np.linalg.norm(measured(ids, corners, reject=False).position - place) > 0.1
    assert np.linalg.norm(measured(ids, corners).position - place) < 0.02


def test_where_no_majority_decides_the_covariance_says_so():
    inside = []
    for k in range(0, 40, 4):
        ids, corners, place = an_image(k, 2)
        spoil(ids, corners, "an id", 0)
        found = measured(ids, corners)
        assert int(found.tags) == 2
        error = found.position - place
        inside.append(error @ np.linalg.solve(found.covariance[:3, :3], error) < 16.3)
        assert np.sqrt(np.trace(found.covariance[:3, :3])) > 0.1
    assert np.mean(inside) > 0.7


@pytest.mark.parametrize("noise", [0.1, 0.5, 1.5])
def test_honest_tags_are_all_used(noise):
    """Also where corners are worse than they were said to be; the pose is to the bit what it was."""
    for k in range(4):
        ids, corners, _ = an_image(k, noise=noise)
        found, plain = measured(ids, corners), measured(ids, corners, reject=False)
        for name in ("position", "attitude", "covariance", "tags"):
            np.testing.assert_array_equal(getattr(found, name), getattr(plain, name))
