"""What the filter of a commanded rate was given, as a batch estimate takes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph import Array, Series
from flowgraph.blocks.filtering.batch import Derived, Recording
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.models.recordings import recorded
from flowgraph.blocks.orientation.commanded import TURN, predict_turn, turned_back
from flowgraph.blocks.signals import BodyRate, Gaussian
from flowgraph.blocks.statespace import MeasurementModel

__all__ = ["turn_recording"]


def turn_recording(
    inputs: Mapping[str, Series], *, start: Gaussian, rate_noise: float, attitude_noise: float, reading: str,
    held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `attitude_mekf` is given: `body_rate` and `magnetic_attitude`; over `TURN`."""

    def linearised(x: Array, rate: BodyRate, dt: Any, xp: Any) -> tuple[Array, Array, Array]:
        exactly = Gaussian(mean=x, covariance=xp.zeros((3, 3), dtype=x.dtype))
        after = predict_turn.step(exactly, rate, noise=rate_noise, dt=dt, xp=xp)
        return after.mean, turned_back(rate, dt, xp), after.covariance

    seen = MeasurementModel(TURN, lambda x, xp: x, np.repeat(attitude_noise**2, 3), measured_space=TURN)
    rates = inputs["body_rate"]
    return recorded(
        Derived(TURN, linearised), {seen: inputs["magnetic_attitude"]}, start, rates, reading, held,
        attitude=0,
    )  # fmt: skip
