"""A point on a circle, seen through its position: the problem that the tests of smoothers share."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Graph, Series, Stream, graph
from flowgraph.blocks.filtering import MeasurementModel, Method, filtered
from flowgraph.blocks.models.tracking import TURNING, coordinated_turn
from flowgraph.blocks.signals import PlanePosition

MOTION = coordinated_turn(0.5, 0.1)
NOISE = 0.2
GPS = MeasurementModel(TURNING, lambda x, xp: x.position, noise=np.repeat(NOISE**2, 2))
START = TURNING.gaussian(position=((0.0, 0.0), 1.0), velocity=((3.0, 0.0), 1.0), rate=(0.2, 0.3))


@graph
def turning(position: Stream[PlanePosition], *, method: Method, more: Any = None):
    """The filter, wired for a smoother."""
    settings = {"start": START} | (more or {})
    return filtered(MOTION, {GPS: position}, method=method, smoothing=True, **settings)


def built(method: Method, **more: Any) -> Graph:
    return turning.build(method=method, more=more)


def driven(n: int, seed: int = 0) -> tuple[Series, np.ndarray]:
    """n positions, ten a second, and where the point was (n, 2)."""
    t, turn = np.arange(n) * 0.1, 0.3
    truth = 3.0 / turn * np.stack([np.sin(turn * t), 1.0 - np.cos(turn * t)], axis=-1)
    seen = truth + np.random.default_rng(seed).normal(size=truth.shape) * NOISE
    return Series.from_seconds(t, PlanePosition(position=seen), name="position"), truth


def missed(smoothed: Series, truth: np.ndarray) -> float:
    """The root mean squared error of the position, m."""
    return float(np.sqrt(np.mean(np.sum((smoothed["mean"][:, :2] - truth) ** 2, axis=-1))))
