"""Can a quadrotor fly this? Bounds on thrust and body rate over whole primitives, by halving intervals.

Over an interval the extremes of acceleration and squared jerk are exact on each axis (roots of a polynomial
of second and of first degree). Together they enclose the thrust f = |a - gravity|:

    sum_i min f_i^2 <= f^2 <= sum_i max f_i^2        |dn/dt|^2 <= |jerk|^2 / f^2       n: direction of thrust

An interval whose enclosure is within the limits is feasible; one with an end outside is infeasible; any other
is halved, down to `resolution`, where what is still undecided counts as infeasible.

The paper bounds |dn/dt| alone, the rate of a body that does not turn about its thrust. Our attitude is the
shortest arc from world z to n, and that one does: its whole rate is at most |dn/dt| sqrt(2 / (1 + n_z)),
which is what is bounded here. So no feasible flight comes near the upside-down attitude, where no arc is
shortest.

Source: Mueller, Hehn, D'Andrea 2015 (see `minimum_jerk`), sec. IV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.world.minimum_jerk import Primitives

__all__ = ["LIMITS", "Limits", "feasible"]


@dataclass(frozen=True)
class Limits:
    """What the vehicle can do.

    Args:
        least_thrust, most_thrust: m/s^2, mass-normalised.
        rate: rad/s, the norm of the whole body rate.
        resolution: s, the shortest interval that is still halved.
    """

    least_thrust: float = 5.0
    most_thrust: float = 20.0
    rate: float = 20.0
    resolution: float = 0.002


LIMITS = Limits()
"""Those with which the thesis's program draws its flights."""


def feasible(primitives: Primitives, limits: Limits = LIMITS) -> bool:
    """Whether thrust and body rate stay within the limits, all the time."""
    which = np.arange(len(primitives.seconds))
    begin, end = np.zeros(len(which)), primitives.seconds
    lowest, highest = limits.least_thrust**2, limits.most_thrust**2
    gravity = np.array(GRAVITY)
    while len(which):
        for edge in (begin, end):
            squared = ((primitives.within(which, edge)[2] - gravity) ** 2).sum(-1)
            if squared.min() < lowest or squared.max() > highest:
                return False
        least, most, jerk = _extremes(primitives, which, begin, end)
        least, most = least - gravity, most - gravity
        far = np.maximum(least**2, most**2).sum(-1)
        near = np.where(least * most < 0.0, 0.0, np.minimum(least**2, most**2)).sum(-1)
        if near.max() > highest or far.min() < lowest:
            return False
        safe = np.maximum(near, 1e-12)
        upright = least[:, 2] / np.sqrt(np.where(least[:, 2] < 0.0, safe, far))  # at most the least n_z
        turn = jerk / safe * 2.0 / np.maximum(1.0 + upright, 1e-12)
        open_ = (near < lowest) | (far > highest) | (turn > limits.rate**2)
        if (open_ & (end - begin < limits.resolution)).any():
            return False
        which, begin, end = which[open_], begin[open_], end[open_]
        middle = 0.5 * (begin + end)
        which, begin, end = np.r_[which, which], np.r_[begin, middle], np.r_[middle, end]
    return True


def _extremes(
    primitives: Primitives, which: np.ndarray, begin: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and most acceleration (m, 3) on each interval, and the most squared jerk (m), summed over
    axes."""
    c = primitives.coefficients[which]
    g, b, a = 6.0 * c[:, 3], 24.0 * c[:, 4], 60.0 * c[:, 5]  # jerk = g + b t + a t^2, a halved already
    begin, end = begin[:, None], end[:, None]
    jerk = lambda t: g + t * (b + t * a)
    acceleration = lambda t: 2.0 * c[:, 2] + t * (g + t * (b / 2.0 + t * a / 3.0))
    inside = lambda t: np.clip(np.where(np.isfinite(t), t, begin), begin, end)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(np.maximum(b * b - 4.0 * a * g, 0.0))
        half = -0.5 * (b + np.where(b < 0.0, -root, root))  # the stable pair of roots: half / a and g / half
        peaks = [begin, end, inside(half / a), inside(g / half)]
        jerks = [begin, end, inside(-b / (2.0 * a))]
    values = np.stack([acceleration(t) for t in peaks])
    return values.min(0), values.max(0), np.stack([jerk(t) ** 2 for t in jerks]).max(0).sum(-1)
