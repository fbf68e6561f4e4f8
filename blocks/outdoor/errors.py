"""Errors of navigation outdoors: of the antenna where it is its path that is known, and by directions.

Where the truth is a path alone, it is that of an antenna by the clock of its receiver, and an estimate is
compared
there: p + R lever - v late, with the covariance of that point. Errors are split into east, north and up, and
into those along and across the way over the ground.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.rotations import skew, to_matrix
from flowgraph.blocks.inertial.navigation import places
from flowgraph.blocks.inertial.outdoors import Antenna
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.metrics.truth import interpolate, within_truth
from flowgraph.blocks.signals import Belief

__all__ = ["antenna_errors", "at_antenna", "directed_errors"]

_SLOW = 0.2
"""m/s: a body that is slower goes nowhere, and errors are neither along its way nor across it."""


def at_antenna(belief: Series, antenna: Antenna, estimated: tuple[str, ...]) -> Series:
    """Beliefs as `Belief` about where the antenna of a receiver was at the time of its clock.

    Args:
        belief: of `Belief`, or with anything `estimated` of `NavigationBelief`.
        antenna: what is known of it.
        estimated: names of `PARAMETERS`.
    """
    n, where = len(belief), places(estimated)
    q, v, P = belief["attitude"], belief["velocity"], belief["covariance"]
    R = to_matrix(q, xp=np)
    arm, late = np.tile(antenna.lever, (n, 1)), np.full((n, 1), antenna.late)
    if "lever" in where:
        arm = belief["parameters"][:, where["lever"]]
    if "time_offset" in where:
        late = belief["parameters"][:, where["time_offset"]]
    T = np.tile(np.eye(P.shape[-1])[:15], (n, 1, 1))
    T[:, :3, 3:6] = -late[..., None] * np.eye(3)
    T[:, :3, 6:9] = -R @ skew(arm, xp=np)
    if "lever" in where:
        T[:, :3, 15 + where["lever"].start : 15 + where["lever"].stop] = R
    if "time_offset" in where:
        T[:, :3, 15 + where["time_offset"].start] = -v
    values = Belief(
        position=belief["position"] + (R @ arm[..., None])[..., 0] - v * late,
        velocity=v,
        attitude=q,
        gyro_bias=belief["gyro_bias"],
        accelerometer_bias=belief["accelerometer_bias"],
        covariance=T @ P @ T.mT,
    )
    return Series(belief.time, values, name=belief.name)


def antenna_errors(
    estimate: Series, truth: Series, *, antenna: Antenna, estimated: tuple[str, ...], settle: float = 1.0
) -> dict[str, float]:
    """`pose_errors` and `directed_errors`; of the antenna where the truth is positions alone.

    Args:
        estimate, truth, settle: as for `pose_errors`.
        antenna, estimated: as for `at_antenna`.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    if "attitude" not in truth.leaves:
        estimate = at_antenna(estimate, antenna, estimated)
    return pose_errors(estimate, truth, settle=settle) | directed_errors(estimate, truth, settle=settle)


def directed_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Position errors by direction, root mean squares in m.

    Returns:
        east_rmse_m, north_rmse_m, up_rmse_m; and, while the body moves, along_rmse_m and across_rmse_m of
        its way over the ground. Nothing for a truth without positions.
    """
    if "position" not in truth.leaves:
        return {}
    chosen = within_truth(estimate, truth, settle)
    error = chosen["position"] - interpolate(truth, "position", chosen.time)
    rms = lambda x: float(np.sqrt(np.mean(np.square(x))))
    found = {f"{n}_rmse_m": rms(error[:, k]) for k, n in enumerate(("east", "north", "up"))}
    way = chosen["velocity"][:, :2]
    speed = np.linalg.norm(way, axis=-1)
    moves = speed > _SLOW
    if moves.any():
        along = way[moves] / speed[moves, None]
        off = error[moves, :2]
        found["along_rmse_m"] = rms((off * along).sum(axis=-1))
        found["across_rmse_m"] = rms(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0])
    return found
