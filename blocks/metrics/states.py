"""Errors of a state of one's own: part by part, and measured by the filter's own covariance.

An estimate whose `mean` lies in a `StateSpace` is compared with a truth whose fields are called as the parts
of the space. The error of a part is the move that takes the estimate to the truth, in the part's own tangent
space: a difference, one of angles, a turn of the body. All parts that the truth has are the NEES.

A filter that sees no absolute position is right up to where its world lies. Such an estimate is aligned
first: the truth is moved into the estimate's world by the rigid motion that brings the positions together
best, about the vertical alone ("yaw") or about any axis ("se3"), so that covariances stay as they are.

Sources: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE
Trans. PAMI 13(4), 1991, without the scale; Z. Zhang and D. Scaramuzza, "A tutorial on quantitative trajectory
evaluation for visual(-inertial) odometry", IROS 2018, sec. III-C (yaw alone).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.manifold import Part, Quaternion, StateSpace, angle
from flowgraph.blocks.geometry.rotations import multiply
from flowgraph.blocks.metrics.errors import error_summary, nees_summary
from flowgraph.blocks.metrics.truth import known, within_truth
from flowgraph.drawing.angles import NAMES, euler_angles, euler_variances
from flowgraph.drawing.canvas import deviation
from flowgraph.drawing.states import Quantity
from flowgraph.errors import DataError, DeclarationError
from flowgraph.types import leaves_of

__all__ = ["ALIGNMENTS", "StateErrors", "true_parts"]

ALIGNMENTS = ("none", "yaw", "se3")

_ANGLE = type(angle())
_SUFFIX = {"m": "_m", "m/s": "_mps", "m/s^2": "_mps2", "rad": "_rad", "rad/s": "_radps", "s": "_s"}


def true_parts(space: StateSpace, truth: Series, time: np.ndarray) -> dict[str, np.ndarray]:
    """Each named part (n, size) that a truth has a field of, at `time` (n,) int64 ns, between its rows as the
    part moves: a share of the way from one to the next."""
    right = np.clip(np.searchsorted(truth.time, time), 1, max(len(truth) - 1, 1))
    left, right = right - 1, np.minimum(right, len(truth) - 1)
    span = np.maximum(truth.time[right] - truth.time[left], 1)
    share = np.clip((time - truth.time[left]) / span, 0.0, 1.0)[:, None]
    found = {}
    for name, part in zip(space.names, space.parts, strict=True):
        if name not in truth.leaves:
            continue
        rows = np.asarray(truth.leaves[name], dtype=float).reshape(len(truth), -1)
        if rows.shape[1] != part.size:
            raise DataError(
                f"the truth's {name} is not that of the state",
                path=f"{truth.name}.{name}",
                expected=f"{part.size} numbers, as the part has",
                got=f"{rows.shape[1]}",
                fix="call the field otherwise, or write it as the state has it",
            )
        move = part.minus(rows[right], rows[left], np)
        found[name] = np.asarray(part.plus(rows[left], share * move, np))
    return found


@dataclass(frozen=True)
class StateErrors:
    """Compares beliefs about a state (`mean`, and `covariance` where there is one) with the truth.

    Args:
        space: of the state, with named parts.
        align: "none", "yaw" or "se3".
        position: the part by which it is aligned, of 2 or 3 numbers.
        vectors: parts that turn with the world, of as many; those that the space has.
        headings: angles that a turn about the vertical adds to; those that the space has. Attitudes are
            found by their kind.
    """

    space: StateSpace
    align: str = "none"
    position: str = "position"
    vectors: tuple[str, ...] = ("velocity", "acceleration")
    headings: tuple[str, ...] = ("heading", "yaw")

    def __post_init__(self) -> None:
        if self.align not in ALIGNMENTS:
            raise DeclarationError(
                "there is no such alignment",
                path="StateErrors.align",
                expected=" or ".join(ALIGNMENTS),
                got=repr(self.align),
                fix="write align=yaw where the filter knows no heading, se3 where no vertical either",
            )
        if not self.space.names:
            raise DeclarationError(
                "a state whose parts have no names cannot be compared",
                path="StateErrors.space",
                expected="names that the truth's fields have",
                got=str(self.space),
                fix="write StateSpace(position=euclidean(2), ...)",
            )

    def __call__(self, estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
        """The errors at the estimate's ticks where the truth covers them, `settle` seconds after the first.

        Returns:
            For each part that the truth has its root mean square, the length of the error: `heading_rmse_deg`
            of angles and attitudes, else with the unit that the truth's field declares, `position_rmse_m`;
            with a covariance the share of single errors within three deviations, `position_3sigma`, and the
            `nees_summary` of these parts together; and compared_ticks. Nothing where no part is known.

        Raises:
            DataError: when no tick of the estimate lies within the truth; or where the positions by which it
                is to be aligned are not there.
        """
        if not set(self.space.names) & set(truth.leaves):
            return {}
        chosen = within_truth(estimate, truth, settle)
        apart = self.apart(chosen, truth)
        units = {name.rpartition(".")[2]: t.unit for name, t in leaves_of(truth.type)}
        found: dict[str, float] = {}
        for name, error in apart.items():
            part = self.space.parts[self.space.names.index(name)]
            turn = isinstance(part, _ANGLE | Quaternion)
            size = error_summary(np.rad2deg(error) if turn else error)
            unit = units.get(name) or ""
            found[f"{name}_rmse" + ("_deg" if turn else _SUFFIX.get(unit, ""))] = size["rmse"]
        if "covariance" in chosen.leaves:
            P, places = chosen["covariance"], [self.space.covers(name) for name in apart]
            for (name, error), on in zip(apart.items(), places, strict=True):
                deviation = np.sqrt(np.einsum("nii->ni", P[:, on, on]))
                found[f"{name}_3sigma"] = float(np.mean(np.abs(error) <= 3.0 * deviation))
            rows = np.concatenate([np.arange(P.shape[-1])[on] for on in places])
            whole = np.concatenate(list(apart.values()), axis=-1)
            found.update(nees_summary(whole, P[:, rows[:, None], rows[None, :]]))
        return found | {"compared_ticks": float(len(chosen))}

    @staticmethod
    def telling(key: str) -> bool:
        """Whether a figure of a smoothed run is worth a line beside that of the filter."""
        return key not in ("compared_ticks", "nees_low", "nees_high")

    def apart(self, estimate: Series, truth: Series) -> dict[str, np.ndarray]:
        """Of each part that the truth has, the moves (n, tangent) that take the estimates to the truth."""
        right = self.true_parts(estimate, truth)
        found = {}
        for name, part, at in zip(self.space.names, self.space.parts, self._places(), strict=True):
            if name in right:
                found[name] = np.asarray(part.minus(right[name], estimate["mean"][:, at], np))
        return found

    def true_parts(self, estimate: Series, truth: Series) -> dict[str, np.ndarray]:
        """The truth's parts at the estimate's ticks, in the estimate's world."""
        parts = true_parts(self.space, truth, estimate.time)
        return parts if self.align == "none" else self._aligned(parts, estimate["mean"])

    def quantities(self, estimate: Series, truth: Series | None, seconds: np.ndarray) -> list[Quantity]:
        """Each number of the estimates with its deviation and, where it is known, the truth; to be drawn.

        Angles are in degrees, attitudes as roll, pitch and yaw. Of a rigid motion, whose deviations are in a
        frame of its own, the numbers are drawn without a band.

        Args:
            estimate, truth: as for a comparison; the truth may be missing.
            seconds: (n,) the estimate's times.
        """
        seen = {} if truth is None or not len(truth) else self.true_parts(estimate, truth)
        at_all = np.zeros(len(estimate), bool) if truth is None else known(truth, estimate.time)
        units = {} if truth is None else {n.rpartition(".")[2]: t.unit for n, t in leaves_of(truth.type)}
        P = estimate["covariance"] if "covariance" in estimate.leaves else None
        found: list[Quantity] = []
        for name, (part, at, on) in zip(self.space.names, self.space.places(), strict=True):
            x = estimate["mean"][:, at]
            right = np.where(at_all[:, None], seen[name], np.nan) if name in seen else None
            spread = None if P is None else P[:, on, on]
            found += _drawn(name, part, units.get(name) or "", x, right, spread, seconds)
        return found

    def _places(self) -> list[slice]:
        return [at for _, at, _ in self.space.places()]

    def _aligned(self, parts: Mapping[str, np.ndarray], mean: np.ndarray) -> dict[str, np.ndarray]:
        if self.position not in parts or parts[self.position].shape[1] not in (2, 3):
            raise DataError(
                "the estimate cannot be aligned with the truth",
                path=f"align={self.align}",
                expected=f"a part {self.position!r} of 2 or 3 numbers that the truth has too",
                got=", ".join(parts) or "no part that the truth has",
                fix="leave align out, or name the part: StateErrors(space, align, position=...)",
            )
        there = parts[self.position]
        here = mean[:, self._places()[self.space.names.index(self.position)]]
        from_, to = there - there.mean(axis=0), here - here.mean(axis=0)
        R = _turn(from_, to, flat=self.align == "yaw" or there.shape[1] == 2)
        yaw = np.arctan2(R[1, 0], R[0, 0])
        found = dict(parts)
        found[self.position] = from_ @ R.T + here.mean(axis=0)
        for name, part in zip(self.space.names, self.space.parts, strict=True):
            if name not in parts:
                continue
            if name in self.vectors and parts[name].shape[1] == len(R):
                found[name] = parts[name] @ R.T
            elif isinstance(part, Quaternion):
                found[name] = np.asarray(multiply(_quaternion(R), parts[name], xp=np))
            elif name in self.headings and isinstance(part, _ANGLE) and (self.align == "yaw" or len(R) == 2):
                found[name] = np.asarray(part.plus(parts[name], np.array([yaw]), np))
        return found


def _drawn(
    name: str, part: Part, unit: str, x: np.ndarray, truth: np.ndarray | None, spread: np.ndarray | None,
    seconds: np.ndarray,
) -> list[Quantity]:  # fmt: skip
    """The numbers of one part (n, size), with the covariance (n, tangent, tangent) of its moves."""
    labels = [f"{name} {k}" for k in range(x.shape[1])] if x.shape[1] > 1 else [name]
    variance = None if spread is None or part.curved else np.einsum("nii->ni", spread)
    turns = isinstance(part, _ANGLE)
    if isinstance(part, Quaternion):
        labels, unit = [f"{name}, {angle_}" for angle_ in NAMES], "deg"
        variance = None if spread is None else np.minimum(euler_variances(x, spread), 60.0**2)
        x, truth = euler_angles(x), None if truth is None else euler_angles(truth)
        x, turns = (x + 180.0) % 360.0 - 180.0, True
        truth = None if truth is None else (truth + 180.0) % 360.0 - 180.0
    elif turns:
        x, truth = np.rad2deg(x), None if truth is None else np.rad2deg(truth)
        variance, unit = None if variance is None else variance * np.rad2deg(1.0) ** 2, "deg"
    return [
        Quantity(
            label,
            seconds,
            x[:, k],
            unit,
            None if variance is None else deviation(variance[:, k]),
            None if truth is None else truth[:, k],
            turns,
        )
        for k, label in enumerate(labels)
    ]


def _turn(a: np.ndarray, b: np.ndarray, *, flat: bool) -> np.ndarray:
    """The rotation R that makes the sum of |b - R a|^2 least; about the last axis of three where flat."""
    if flat:
        cross = np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        angle_ = np.arctan2(cross, np.sum(a[:, :2] * b[:, :2]))
        R = np.eye(a.shape[1])
        R[:2, :2] = [[np.cos(angle_), -np.sin(angle_)], [np.sin(angle_), np.cos(angle_)]]
        return R
    U, _, Vt = np.linalg.svd(b.T @ a)
    keep = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return np.asarray(U @ keep @ Vt)


def _quaternion(R: np.ndarray) -> np.ndarray:
    """(4) of a rotation of three axes, or of a plane's about the third."""
    from scipy.spatial.transform import Rotation  # slow to import, and only alignment needs it

    whole = np.eye(3)
    whole[: len(R), : len(R)] = R
    x, y, z, w = Rotation.from_matrix(whole).as_quat()
    return np.array([w, x, y, z])
