"""tracker: a point in the plane that is seen now and then, by any method of filtering.

The model is declared once, a velocity that wanders and a position that is measured, and the method is a
setting: Kalman, extended, unscented, cubature, on a root of the covariance, particles, or two motions of
which either may be the true one. For a linear model with Gaussian noise the first five are one filter, and
particles approach it.

    p' = v      v' = w      z = p + N(0, noise^2 I)

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sec. 6.2.2. The model stands in `blocks/models/tracking.py`, the methods in `blocks/filtering`.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import numpy as np

from flowgraph import Case, DataError, Result, Series, Stream, block, graph
from flowgraph.blocks.filtering import (
    CloudSteps,
    LinearMeasurement,
    bank_steps_of,
    cubature,
    extended,
    filtered,
    imm,
    linear,
    particles,
    square_root,
    unscented,
)
from flowgraph.blocks.filtering.batch import Recording
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.kalman.smoothing import Smoothing, steps_of
from flowgraph.blocks.metrics.errors import plane_errors
from flowgraph.blocks.models.tracking import constant_velocity
from flowgraph.blocks.scoring.cases import Gated, OnFlight, Particles, Smoothed, on_flight
from flowgraph.blocks.scoring.settings import Positive, one_of
from flowgraph.blocks.signals import Gaussian, PlaneBelief, PlanePosition

METHODS = ("linear", "extended", "unscented", "cubature", "square_root", "particles", "imm")


@block
def seen_in_plane(belief: Gaussian) -> PlaneBelief:
    """The position of a belief about position and velocity."""
    return PlaneBelief(position=belief.mean[..., :2], covariance=belief.covariance[..., :2, :2])


def seen_position(noise: float) -> LinearMeasurement:
    """The measured position; noise: standard deviation on each axis, m."""
    return LinearMeasurement(constant_velocity(1.0).space, np.eye(2, 4), noise=noise**2)


def plane_steps(result: Result, motion: LinearModel) -> Smoothing:
    """What smooths a run that was wired for it, by what the method collected."""

    def named(smoothed: Series) -> Series:
        belief = Gaussian(mean=smoothed["mean"], covariance=smoothed["covariance"])
        return Series(smoothed.time, seen_in_plane.step(belief), name=smoothed.name)

    if "bank" in result.series:
        return bank_steps_of(result, motion.space)._replace(named=named)
    if "cloud" in result.series:
        return CloudSteps(result["cloud"], motion, named)
    return steps_of(result)._replace(named=named)


@graph
def tracker(
    position: Stream[PlanePosition],
    *,
    start: Gaussian,
    wander: float,
    position_noise: float,
    method: Any = None,
    gate: float | None = None,
    patience: int = 5,
    smoothing: bool = False,
):
    """A point whose velocity wanders, followed by its positions.

    Collected at every position: `belief`, `prior`, `posterior`, `innovation` and `log_likelihood`; with
    `smoothing` what a smoother needs too.
    """
    motion = constant_velocity(wander)
    seen = seen_position(position_noise)
    belief = filtered(
        motion, {seen: position}, start=start, method=method or linear(), gate=gate, patience=patience,
        smoothing=smoothing,
    )  # fmt: skip
    posterior = {} if smoothing else {"posterior": belief}  # then the filter collects it
    return {"belief": seen_in_plane(belief), **posterior}


@on_flight(tracker, "position", ranged=False)
def for_flight(
    on: OnFlight,
    *,
    method: Annotated[str, one_of(*METHODS)] = "linear",
    wander: Positive = 2.0,
    calm: Positive = 0.1,
    position_noise: Positive | None = None,
    cloud: Particles,
    gated: Gated,
    scored: Smoothed,
) -> Case:
    """Start the filter at the first position of a flight in the plane, such as `sim:plane`.

    Args:
        flight: with the stream `position`.
        method: linear, extended, unscented, cubature, square_root, particles, or imm, which also has a motion
            of density `calm`.
        wander: density of the acceleration, m/s^2/sqrt(Hz).
        calm: that of the other motion of imm.
        position_noise: standard deviation in m; the flight's own if left out.

    Raises:
        DataError: where the flight lacks the stream, or is not in a plane.
        DeclarationError: for a setting that is out of range.
    """
    motion = constant_velocity(wander)
    chosen = {
        "linear": linear,
        "extended": extended,
        "unscented": unscented,
        "cubature": cubature,
        "square_root": square_root,
        "particles": lambda: particles(cloud.particles, seed=cloud.seed, **cloud.resampling()),
        "imm": lambda: imm(motion, constant_velocity(calm), method=linear()),
    }[method]()
    noise = on.noise("position_noise", position_noise)
    first = on.inputs["position"]["position"][0]
    if first.shape != (2,):
        raise DataError(
            "the tracker follows a point in a plane", path=f"{on.flight.name}: position",
            expected="positions of two numbers", got=f"of {len(first)}",
            fix="choose a flight such as sim:plane",
        )  # fmt: skip
    start = motion.space.gaussian(position=(first, noise), velocity=((0.0, 0.0), 3.0))
    recording: Recording | str = Recording(motion, {seen_position(noise): on.inputs["position"]}, start)
    if method == "imm":
        recording = "which motion was the true one at each step is no number that a least-squares problem has"
    return on.case(
        scored.score(on, plane_errors, steps=partial(plane_steps, motion=motion), recording=recording),
        start=start,
        wander=wander,
        position_noise=noise,
        method=chosen,
        smoothing=scored.smoothed,
        **gated.gating(),
    )
