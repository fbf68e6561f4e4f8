"""Perspective-n-Point: the pose of a body from the tags that its camera sees.

SQPNP gives a start without any guess; points on a plane, as those of a mat, also get both of IPPE's answers.
Each is refined until the squared reprojection error of all visible corners stands still. A plane that is
small in the image has two poses that explain it about equally well: where the corners cannot tell them apart,
the one nearer to the previous pose, or to the prior, is taken. Linearised at the answer, the reprojection
gives the covariance.

A tag that was taken for another is far from where it should be, and draws the pose after it. So where a tag
is off by more than noise, pairs of tags propose poses, and the one that most of the tags agree with decides:
those that are off by many deviations from what the majority says are left out. Without a majority all remain,
and the covariance, which follows the residual, says what such a pose is worth.

This runs on the host: OpenCV is no array-API operation. A pipeline reads the poses as a source.

Sources: M. Fischler and R. Bolles, "Random sample consensus", CACM 24, 1981 (here over all pairs, or a fixed
selection of them); G. Terzakis and M. Lourakis, "A consistently fast and globally optimal solution to the
perspective-n-point problem", ECCV 2020; T. Collins and A. Bartoli, "Infinitesimal plane-based pose
estimation", IJCV 109, 2014.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from flowgraph import block, when
from flowgraph.blocks.geometry.rotations import skew, to_matrix
from flowgraph.blocks.signals import PoseMeasurement, Tags
from flowgraph.blocks.vision.camera import Camera, Mount
from flowgraph.blocks.vision.tags import TagMap

__all__ = ["Solution", "find_pose", "quaternion_of", "rotation_of", "solve"]

_HOPELESS = 4.0  # a start with so many times the best one's error is not refined
_APART = 16.0  # squared errors closer than this, in units of the noise, do not tell two poses apart
_DOUBTFUL = 4.0  # a tag so many deviations off (root mean square of its corners) makes the others be asked
_WRONG = 8.0  # a tag so many deviations off what most of the others say is left out
_LOOSE = 16.0  # a pose from two tags alone is right to so many deviations
_PROPOSALS, _ROUNDS, _WHOLE = 60, 10, 3  # after so many pairs with which all tags agree, all do
_CONTRADICTED = 16.0  # on the covariance, and as often as there are tags, where tags contradict each other:
# the corners of a wrong one err together, and the pose gave way to it by half


class Solution(NamedTuple):
    """x_camera = R x_world + t; the reprojection error (px, root mean square over the corners' distances);
    the covariance (6, 6) of (left rotation vector of R, t); and which tags (k,) it rests on."""

    R: np.ndarray
    t: np.ndarray
    error: float
    covariance: np.ndarray
    used: np.ndarray


def solve(
    corners: npt.ArrayLike,
    places: npt.ArrayLike,
    camera: Camera,
    *,
    near: tuple[np.ndarray, np.ndarray] | None = None,
    pixel_noise: float = 0.5,
    reject: bool = True,
) -> Solution | None:
    """The camera's pose from pixels (k, 4, 2) of points (k, 4, 3) in the world; None where there is none.

    Args:
        corners, places: of k tags, at least one.
        camera: with its distortion.
        near: (R, t) that the answer should be near to, where corners alone leave it open.
        pixel_noise: standard deviation of a corner's coordinate, px; what the covariance assumes at least.
        reject: whether tags that most of the others contradict are left out.
    """
    z = np.asarray(corners, dtype=float).reshape(-1, 4, 2)
    X = np.asarray(places, dtype=float).reshape(-1, 4, 3)
    found = _fit(z, X, camera, near, pixel_noise)
    worst = np.inf if found is None else float(_off(found.R, found.t, z, X, camera).max())
    if worst < _DOUBTFUL * pixel_noise or not reject:
        return found
    agreed = _agreed(z, X, camera, near, pixel_noise)
    if agreed is not None:
        better = _fit(z[agreed], X[agreed], camera, near, pixel_noise)
        if better is not None:
            return better._replace(used=agreed)
    if found is not None and worst >= _WRONG * pixel_noise:
        return found._replace(covariance=found.covariance * _CONTRADICTED * len(z))
    return found


def _fit(
    z: np.ndarray,
    X: np.ndarray,
    camera: Camera,
    near: tuple[np.ndarray, np.ndarray] | None,
    pixel_noise: float,
) -> Solution | None:
    """The pose that all tags together explain best."""
    import cv2  # it takes 50 ms, for which only who solves for a pose should wait

    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-14)
    used = np.ones(len(z), bool)
    z = np.ascontiguousarray(z.reshape(-1, 2))
    X = np.ascontiguousarray(X.reshape(-1, 3))
    if len(z) < 4:
        return None
    found = []
    for r, t in _starts(z, X, camera, near):
        r, t = cv2.solvePnPRefineLM(X, z, camera.K, np.array(camera.distortion), r, t, until)
        error = _squared_error(z, X, camera, r, t)
        if np.isfinite(error):
            found.append((error, r, t))
    if not found:
        return None
    found.sort(key=lambda one: one[0])
    variance = max(pixel_noise**2, found[0][0] / max(2 * len(z) - 6, 1))
    alike = [one for one in found if one[0] - found[0][0] < _APART * variance]
    if near is not None and len(alike) > 1:
        turn = lambda r: np.linalg.norm(cv2.Rodrigues(near[0].T @ cv2.Rodrigues(r)[0])[0])
        alike.sort(key=lambda one: turn(one[1]))
    error, r, t = alike[0]
    R = cv2.Rodrigues(r)[0]
    _, slopes = cv2.projectPoints(X, r, t, camera.K, np.array(camera.distortion))
    information = slopes[:, :6].T @ slopes[:, :6]
    if not np.linalg.cond(information) < 1e15:
        return None
    to_left = np.eye(6)
    to_left[:3, :3] = _left_jacobian(r[:, 0])
    covariance = to_left @ np.linalg.inv(information) @ to_left.T * variance
    return Solution(R, t[:, 0], float(np.sqrt(error / len(z))), covariance, used)


def _off(R: np.ndarray, t: np.ndarray, z: np.ndarray, X: np.ndarray, camera: Camera) -> np.ndarray:
    """By how much the coordinates of each tag's corners are off (k,), px, root mean square."""
    seen = X @ R.T + t
    if not (np.isfinite(seen).all() and (seen[..., 2] > 1e-6).all()):
        return np.full(len(z), np.inf)
    return np.asarray(np.sqrt(np.mean((camera.project(seen) - z) ** 2, axis=(1, 2))))


def _agreed(
    z: np.ndarray,
    X: np.ndarray,
    camera: Camera,
    near: tuple[np.ndarray, np.ndarray] | None,
    pixel_noise: float,
) -> np.ndarray | None:
    """The tags (k,) that agree on a pose, where they are most of them and all others are far from it; None
    where no tags but all agree, or no majority does."""
    pairs = list(itertools.combinations(range(len(z)), 2))
    order = np.random.default_rng(0).permutation(len(pairs))[:_PROPOSALS]  # the same ones every time
    whole = 0
    for pair in (list(pairs[k]) for k in order if len(z) > 2):
        agreed = np.isin(np.arange(len(z)), pair)
        if whole == _WHOLE:
            return None
        wide = _LOOSE  # what two tags say of others far away
        for _ in range(_ROUNDS):
            pose = _fit(z[agreed], X[agreed], camera, near, pixel_noise)
            if pose is None:
                break
            off = _off(pose.R, pose.t, z, X, camera)
            if agreed.sum() == 2 and not (off[agreed] < _WRONG * pixel_noise).all():
                break
            again = off < wide * pixel_noise * np.clip(np.median(off[agreed]) / pixel_noise, 1.0, 2.0)
            if wide == _WRONG and (again == agreed).all():
                if agreed.all():
                    whole += 1
                elif 2 * agreed.sum() > len(z):
                    return agreed
                break
            agreed, wide = again, _WRONG
            if agreed.sum() < 2:
                break
    return None


def _starts(
    z: np.ndarray, X: np.ndarray, camera: Camera, near: tuple[np.ndarray, np.ndarray] | None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation vectors (3, 1) and translations (3, 1) worth refining."""
    import cv2  # as above

    ideal = np.ascontiguousarray(camera.undistort(z))
    flags = [cv2.SOLVEPNP_SQPNP]
    centred = X - X.mean(axis=0)
    if np.linalg.svd(centred, compute_uv=False)[2] < 1e-6 * np.abs(centred).max():
        flags.append(cv2.SOLVEPNP_IPPE)
    starts = [] if near is None else [(cv2.Rodrigues(near[0])[0], np.asarray(near[1], float).reshape(3, 1))]
    for flag in flags:
        try:
            _, rs, ts, _ = cv2.solvePnPGeneric(X, ideal, np.eye(3), None, flags=flag)
        except cv2.error:  # points on a line, or all at one place
            continue
        starts += list(zip(rs, ts, strict=True))
    errors = [_squared_error(z, X, camera, r, t) for r, t in starts]
    least = min(errors, default=np.inf)
    keep = [k for k, e in enumerate(errors) if np.isfinite(e) and e <= _HOPELESS**2 * least + len(z)]
    return [starts[k] for k in keep]


def _squared_error(z: np.ndarray, X: np.ndarray, camera: Camera, r: np.ndarray, t: np.ndarray) -> float:
    """The sum of squared distances, px^2; infinite where a point would lie behind the camera."""
    import cv2  # as above

    seen = X @ cv2.Rodrigues(r)[0].T + t[:, 0]
    if not (np.isfinite(seen).all() and (seen[:, 2] > 1e-6).all()):
        return np.inf
    return float(np.sum((camera.project(seen) - z) ** 2))


def _left_jacobian(r: np.ndarray) -> np.ndarray:
    """Exp(r + d) = Exp(J d) Exp(r), to first order (Solà 2017, eq. 145)."""
    angle = float(np.linalg.norm(r))
    K = np.asarray(skew(r, xp=np))
    if angle < 1e-7:
        return np.eye(3) + 0.5 * K
    one, two = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) + one * K + two * (K @ K)


def body_measurement(solution: Solution, mount: Mount, tags: int) -> PoseMeasurement:
    """The body's pose of a camera's, with the covariance of (position, right rotation vector).

    A left rotation d of R and a step s of t turn the attitude by -R_cb^T d, and move the position by
    R^T ([o - t]x d - s), o the body's origin in the camera.
    """
    R, t = solution.R, solution.t
    position, attitude = mount.body_pose(R, t)
    T = np.zeros((6, 6))
    T[:3, :3], T[:3, 3:] = R.T @ np.asarray(skew(mount.origin - t, xp=np)), -R.T
    T[3:, :3] = -mount.rotation.T
    return PoseMeasurement(
        position=position,
        attitude=quaternion_of(attitude),
        covariance=T @ solution.covariance @ T.T,
        error=np.asarray(solution.error),
        tags=np.asarray(tags, np.int32),
    )


def quaternion_of(R: npt.ArrayLike) -> np.ndarray:
    """The unit quaternion (4,), scalar first and not negative, of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation  # half a second that the blocks alone need not pay

    return np.asarray(
        Rotation.from_matrix(np.asarray(R, dtype=float)).as_quat(canonical=True)[..., [3, 0, 1, 2]]
    )


def rotation_of(q: npt.ArrayLike) -> np.ndarray:
    """The rotation (..., 3, 3) of a unit quaternion (..., 4)."""
    return np.asarray(to_matrix(np.asarray(q, dtype=float), xp=np))


def measure(
    ids: npt.ArrayLike,
    corners: npt.ArrayLike,
    *,
    tag_map: TagMap,
    camera: Camera,
    mount: Mount,
    near: tuple[np.ndarray, np.ndarray] | None = None,
    pixel_noise: float = 0.5,
    reject: bool = True,
) -> PoseMeasurement | None:
    """The body's pose from the tags of one image; None where the map knows none of them.

    Args:
        ids, corners: (k,) and (k, 4, 2) px.
        near: the body's (position (3,), attitude (3, 3)) that decides between two poses that look alike.
        tag_map, camera, mount, pixel_noise: see `find_pose`.
        reject: see `solve`.
    """
    places, known = tag_map.find(ids)
    if not known.any():
        return None
    guess = None if near is None else mount.view(*near)
    z = np.asarray(corners, dtype=float)[known]
    solution = solve(z, places[known], camera, near=guess, pixel_noise=pixel_noise, reject=reject)
    return None if solution is None else body_measurement(solution, mount, int(solution.used.sum()))


@block(host=True)
def find_pose(
    last: PoseMeasurement,
    tags: Tags,
    *,
    tag_map: TagMap,
    camera: Camera,
    mount: Mount,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
    memory: float = 1.0,
    pixel_noise: float = 0.5,
    least: int = 1,
    dt: float,
) -> tuple[PoseMeasurement | None, PoseMeasurement]:
    """The body's pose in each image, and the last one there was. On the host.

    Args:
        last: the pose of the image before, for `memory` seconds; its `tags` is 0 where there was none. It
            decides between two poses that look alike; without it the `prior` does.
        tags: what the camera sees.
        tag_map: where the tags lie. Tags that it does not have are passed over.
        camera: intrinsic parameters; rectified, if the images are.
        mount: of the camera in the body.
        prior: (position (3,), attitude (3, 3)) of the body, as it might be at first.
        memory: s; after a longer time without an image the last pose counts no more.
        pixel_noise: standard deviation of a corner's coordinate, px. The covariance follows the residual
            where that is larger.
        least: how many tags there must be; with fewer there is no pose.

    Returns:
        The pose, absent where too few tags are seen; and what to hand in as `last` next time.
    """
    seen = np.asarray(tags.seen)
    near = prior
    if int(last.tags) > 0 and dt <= memory:
        near = (np.asarray(last.position), rotation_of(last.attitude))
    found = None
    if seen.sum() >= least:
        found = measure(
            tags.ids[seen], tags.corners[seen], tag_map=tag_map, camera=camera, mount=mount, near=near,
            pixel_noise=pixel_noise,
        )  # fmt: skip
    if found is None or int(found.tags) < least:
        return when(False, last), last.replace(tags=np.asarray(0 if dt > memory else last.tags, np.int32))
    return when(True, found), found


def no_pose() -> PoseMeasurement:
    """What stands for the last pose before the first."""
    return PoseMeasurement(
        position=np.zeros(3),
        attitude=np.array([1.0, 0.0, 0.0, 0.0]),
        covariance=np.zeros((6, 6)),
        error=np.asarray(0.0),
        tags=np.asarray(0, np.int32),
    )


def as_measurements(position: Any, attitude: Any) -> PoseMeasurement:
    """Poses (n, 3), (n, 4) of a source that says nothing of their covariance."""
    n = len(position)
    return PoseMeasurement(
        position=np.asarray(position),
        attitude=np.asarray(attitude),
        covariance=np.zeros((n, 6, 6)),
        error=np.zeros(n),
        tags=np.zeros(n, np.int32),
    )
