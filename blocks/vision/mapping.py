"""A map of tags that nobody surveyed: bundle adjustment of the corners that a camera saw.

One tag is made the origin. From an image with known tags follows the camera's pose, and from that where its
unknown tags lie, until all tags have a place. Then all cameras and tags are adjusted together, so that the
squared distances (robust: Huber) between seen and projected corners become least. Each residual knows one
camera and one tag, so the Jacobian is sparse; it is analytic. What the side of a tag is said to be gives the
scale.

Source: B. Triggs, P. McLauchlan, R. Hartley and A. Fitzgibbon, "Bundle adjustment - a modern synthesis",
1999.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph import Flight, Series
from flowgraph.blocks.geometry.rotations import skew
from flowgraph.blocks.vision.camera import Camera
from flowgraph.blocks.vision.pnp import solve
from flowgraph.blocks.vision.tags import TagMap
from flowgraph.errors import DataError

__all__ = ["Frames", "Survey", "build_map", "keyframes", "map_of"]

Frames = Sequence[tuple[np.ndarray, np.ndarray]]
"""(ids (k,), corners (k, 4, 2) px) of images."""


@dataclass(frozen=True)
class Survey:
    """A map, and how well it explains the images that it was made of.

    Args:
        tag_map: the map.
        error: median distance of seen and projected corners, px.
        frames: how many images.
        corners: how many corners were seen in them.
    """

    tag_map: TagMap
    error: float
    frames: int
    corners: int


def frames_of(tags: Series) -> Frames:
    """The images of a series of `Tags`."""
    rows = zip(tags["ids"], tags["corners"], tags["seen"], strict=True)
    return [(ids[seen], corners[seen]) for ids, corners, seen in rows]


def keyframes(frames: Frames, most: int) -> Frames:
    """At most `most` images, evenly spread over those with two tags or more."""
    rich = [f for f in frames if len(f[0]) >= 2]
    if len(rich) <= most:
        return rich
    return [rich[k] for k in np.linspace(0, len(rich) - 1, most).round().astype(int)]


def build_map(
    frames: Frames,
    camera: Camera,
    *,
    side: float,
    origin: int | None = None,
    flat: bool = False,
    most: int = 150,
) -> Survey:
    """Map the tags of these images.

    Args:
        frames: images; at most `most` of them are used, evenly spread.
        camera: calibrated.
        side: of a tag, m.
        origin: the id of the tag whose centre is the world's origin, with x to its right; z is normal to the
            plane that fits all corners, out of the tags. The tag that is seen most often, if left out.
        flat: whether all tags lie in the plane of that one; else each has six degrees of freedom. The start
            assumes a rough plane in both cases.

    Returns:
        A `Survey`. Tags that no chain of images connects with the origin are left out.

    Raises:
        DataError: when no image shows two tags, or none shows the origin.
    """
    images = keyframes(frames, most)
    ids, counts = np.unique(np.concatenate([f[0] for f in images] or [np.zeros(0, int)]), return_counts=True)
    if not len(ids) or (origin is not None and origin not in ids):
        raise DataError(
            "these images make no map",
            path="build_map",
            expected="images with two tags or more, the origin among them",
            got=f"{len(frames)} images, {len(images)} with two tags or more; origin {origin}",
            fix="give more images, or another origin",
        )
    root = int(ids[np.argmax(counts)]) if origin is None else origin
    half = 0.5 * side
    square = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    cameras, places = _first_guess(images, camera, root, square)
    problem = _Problem(images, cameras, places, camera, root, square, flat)
    x, error = problem.adjust()
    tag_map = TagMap(np.array(problem.names), _levelled(problem.corners(x), problem.root))
    return Survey(tag_map, error, len(cameras), 4 * len(problem.camera_of))


def map_of(flight: Flight) -> TagMap:
    """The flight's map of tags; where nobody surveyed it, one made of all its images."""
    if "tag_map" in flight.info:
        found: TagMap = flight.info["tag_map"]
        return found
    frames = frames_of(flight.streams["tags"])
    return build_map(frames, flight.info["camera"], side=flight.info["tag_side"]).tag_map


def _levelled(corners: np.ndarray, root: int) -> np.ndarray:
    """The corners (k, 4, 3) turned about the root's centre, so that the plane that fits all of them is level.

    A single tag of a mat may lie askew; a filter wants the world's z to be up.
    """
    points = corners.reshape(-1, 3)
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    if len(corners) < 3 or abs(normal[2]) < 0.5:
        return corners
    up = normal * np.sign(normal[2])
    right = np.array([1.0, 0.0, 0.0]) - up * up[0]
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(up, right), up])
    return corners @ R.T - (corners[root] @ R.T).mean(axis=0)


def _first_guess(
    images: Frames, camera: Camera, root: int, square: np.ndarray
) -> tuple[dict[int, tuple[np.ndarray, np.ndarray]], dict[int, np.ndarray]]:
    """(R, t) of the images, and (x, y, angle) of the tags in the root's plane, outwards from the root."""
    places: dict[int, np.ndarray] = {root: np.zeros(3)}
    cameras: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    tried: set[int] = set()
    while True:
        known = {k: np.isin(ids, list(places)) for k, (ids, _) in enumerate(images) if k not in tried}
        most = max((int(k.sum()) for k in known.values()), default=0)
        if not most:
            return cameras, places
        votes: dict[int, list[np.ndarray]] = {}
        for k, is_known in known.items():
            if is_known.sum() < most:
                continue
            tried.add(k)
            ids, corners = images[k]
            world = np.array([_laid(places[int(i)], square) for i in ids[is_known]])
            found = solve(corners[is_known], world, camera, reject=False)  # the places are rough
            if found is None:
                continue
            cameras[k] = found.R, found.t
            ideal = camera.undistort(corners[~is_known])
            rays = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1) @ found.R
            centre = -found.R.T @ found.t
            quads = centre - rays * (centre[2] / rays[..., 2:])
            for i, quad in zip(ids[~is_known], quads, strict=True):
                right = quad[1] - quad[0] + quad[2] - quad[3]
                place = [*quad[:, :2].mean(axis=0), np.arctan2(right[1], right[0])]
                votes.setdefault(int(i), []).append(np.array(place))
        for i, places_seen in votes.items():
            places[i] = _middle(np.array(places_seen))


def _middle(places: np.ndarray) -> np.ndarray:
    """The median of places (n, 3), with the angle taken about the first one."""
    turn = np.remainder(places[:, 2] - places[0, 2] + np.pi, 2.0 * np.pi) - np.pi
    return np.array([*np.median(places[:, :2], axis=0), places[0, 2] + np.median(turn)])


def _laid(place: np.ndarray, square: np.ndarray) -> np.ndarray:
    """The corners (4, 3) of a tag at (x, y, angle) in the plane z = 0."""
    c, s = np.cos(place[2]), np.sin(place[2])
    return square @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + [*place[:2], 0.0]


class _Problem:
    """The least-squares problem: rotation vectors and positions of all cameras and tags but the root.

    x = (r, t) of each camera, then (r, p) of each other tag; flat: (angle, x, y). A corner c of a tag lies at
    X = R(r) c + p and is seen at the pinhole image of R(r) X + t. Pixels are undistorted once, before.
    """

    def __init__(
        self,
        images: Frames,
        cameras: dict[int, tuple[np.ndarray, np.ndarray]],
        places: dict[int, np.ndarray],
        camera: Camera,
        root: int,
        square: np.ndarray,
        flat: bool,
    ) -> None:
        self.names, self.square, self.flat = sorted(places), square, flat
        self.focal = np.array([camera.K[0, 0], camera.K[1, 1]])
        self.root = self.names.index(root)
        row = {name: k for k, name in enumerate(self.names)}
        self.frames = sorted(cameras)
        picked = [
            (c, row[int(i)], quad)
            for c, k in enumerate(self.frames)
            for i, quad in zip(*images[k], strict=True)
            if int(i) in row
        ]
        self.camera_of = np.array([c for c, _, _ in picked])
        self.tag_of = np.array([g for _, g, _ in picked])
        self.seen = camera.undistort(np.array([quad for _, _, quad in picked]))  # (m, 4, 2)
        self.width = 3 if flat else 6
        start = [_pose_vector(*cameras[k]) for k in self.frames]
        for k, name in enumerate(self.names):
            if k != self.root:
                x, y, angle = places[name]
                start.append(np.array([angle, x, y] if flat else [0.0, 0.0, angle, x, y, 0.0]))
        self.start = np.concatenate(start)
        self._columns()

    def _columns(self) -> None:
        """Where the blocks of the Jacobian stand: (8 m) rows of 6 + width entries, none for the root."""
        m, n = len(self.camera_of), len(self.frames)
        own = 6 * self.camera_of[:, None] + np.arange(6)
        slot = self.tag_of - (self.tag_of > self.root)
        others = 6 * n + self.width * slot[:, None] + np.arange(self.width)
        columns = np.concatenate([own, others], axis=1)
        self.columns = np.repeat(columns, 8, axis=0)
        self.rows = np.broadcast_to(np.arange(8 * m)[:, None], self.columns.shape)
        free = np.repeat(self.tag_of != self.root, 8)
        self.used = np.concatenate(
            [np.ones((8 * m, 6), bool), np.broadcast_to(free[:, None], (8 * m, self.width))], axis=1
        )

    def _split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cameras (n, 6) and tags (k, 6), the root among them."""
        n = 6 * len(self.frames)
        tags = x[n:].reshape(-1, self.width)
        if self.flat:
            none = np.zeros(len(tags))
            tags = np.stack([none, none, tags[:, 0], tags[:, 1], tags[:, 2], none], axis=1)
        return x[:n].reshape(-1, 6), np.insert(tags, self.root, 0.0, axis=0)

    def corners(self, x: np.ndarray) -> np.ndarray:
        """The corners (k, 4, 3) of all tags."""
        _, tags = self._split(x)
        return self.square @ _rotations(tags[:, :3]).mT + tags[:, None, 3:]

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Projected minus seen (8 m), px of an undistorted image."""
        cameras, _ = self._split(x)
        R = _rotations(cameras[:, :3])[self.camera_of]
        Y = self.corners(x)[self.tag_of] @ R.mT + cameras[self.camera_of, None, 3:]
        return np.asarray(((Y[..., :2] / Y[..., 2:] - self.seen) * self.focal).ravel())

    def jacobian(self, x: np.ndarray) -> scipy.sparse.csr_matrix:
        """d residuals / d x. A rotation vector's change d turns R into R Exp(J d), J its right Jacobian."""
        cameras, tags = self._split(x)
        R, J = _rotations(cameras[:, :3])[self.camera_of], _right_jacobians(cameras[:, :3])[self.camera_of]
        S, L = _rotations(tags[:, :3])[self.tag_of], _right_jacobians(tags[:, :3])[self.tag_of]
        X = self.corners(x)[self.tag_of]  # (m, 4, 3)
        Y = X @ R.mT + cameras[self.camera_of, None, 3:]
        z = Y[..., 2]
        slope = np.zeros((*z.shape, 2, 3))  # of the image with respect to Y
        slope[..., 0, 0] = slope[..., 1, 1] = 1.0 / z
        slope[..., 0, 2], slope[..., 1, 2] = -Y[..., 0] / z**2, -Y[..., 1] / z**2
        slope *= self.focal[:, None]
        by_turn = -(R[:, None] @ _skews(X) @ J[:, None])
        by_tag_turn = -(R[:, None] @ S[:, None] @ _skews(np.broadcast_to(self.square, X.shape)) @ L[:, None])
        by_place = np.broadcast_to(R[:, None], by_turn.shape)
        if self.flat:
            tag = np.concatenate([by_tag_turn[..., 2:], by_place[..., :2]], axis=-1)
        else:
            tag = np.concatenate([by_tag_turn, by_place], axis=-1)
        blocks = np.concatenate([slope @ by_turn, slope, slope @ tag], axis=-1).reshape(
            -1, self.columns.shape[1]
        )
        values = (blocks[self.used], (self.rows[self.used], self.columns[self.used]))
        return scipy.sparse.csr_matrix(values, shape=(len(self.rows), len(self.start)))

    def adjust(self) -> tuple[np.ndarray, float]:
        """The adjusted x, and the median distance in px."""
        found = scipy.optimize.least_squares(
            self.residuals,
            self.start,
            jac=self.jacobian,
            method="trf",
            loss="huber",
            f_scale=2.0,
            x_scale="jac",
            ftol=1e-7,
            xtol=1e-9,
            max_nfev=60,
        )
        left = self.residuals(found.x).reshape(-1, 2)
        return found.x, float(np.median(np.linalg.norm(left, axis=1)))


def _pose_vector(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.concatenate([scipy.spatial.transform.Rotation.from_matrix(R).as_rotvec(), t])


def _rotations(r: np.ndarray) -> np.ndarray:
    return np.asarray(scipy.spatial.transform.Rotation.from_rotvec(r).as_matrix())


def _skews(v: np.ndarray) -> np.ndarray:
    return np.asarray(skew(v, xp=np))


def _right_jacobians(r: np.ndarray) -> np.ndarray:
    """(..., 3, 3) with Exp(r + d) = Exp(r) Exp(J d), to first order (Solà 2017, eq. 143)."""
    squared = np.sum(r * r, axis=-1)[..., None, None]
    small = squared < 1e-8
    safe = np.where(small, 1.0, squared)
    angle = np.sqrt(safe)
    one = np.where(small, 0.5 - squared / 24.0, (1.0 - np.cos(angle)) / safe)
    two = np.where(small, 1.0 / 6.0 - squared / 120.0, (angle - np.sin(angle)) / (safe * angle))
    K = _skews(r)
    return np.eye(3) - one * K + two * (K @ K)
