"""particle: the thesis's "mini" particle filter, of a point in the plane.

A cloud of weighted points moves by a noisy velocity; a measured position weighs it; where the weights have
become too uneven, it is resampled. Nothing is linearised, and nothing need be Gaussian: that it is here lets
the filter be compared with the exact answer.

    move        x_i' = x_i + v dt + s sqrt(dt) e_i
    weigh       w_i' ~ w_i p(z | x_i)
    resample    where 1 / sum(w_i^2) is below a fraction of the number of points

Source: R. Fiszel's thesis on reactive pose estimation, Stanford 2017, section on the particle filter; N.
Gordon, D. Salmond and A. Smith, IEE Proceedings F 140(2), 1993. The blocks stand in
`blocks/models/plane.py`.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph, latest, merge
from flowgraph.blocks.kalman.lost import Held, stay
from flowgraph.blocks.metrics.errors import plane_errors
from flowgraph.blocks.models.plane import (
    average_plane,
    cloud_steps,
    move_plane,
    plane_sample_size,
    plane_states,
    resample_plane,
    start_plane,
    weigh_plane,
)
from flowgraph.blocks.models.spread import spread_plane
from flowgraph.blocks.particles.lost import depletion
from flowgraph.blocks.scoring.cases import HeldControl, OnFlight, Particles, Smoothed, on_flight
from flowgraph.blocks.scoring.settings import Positive
from flowgraph.blocks.signals import PlaneCloud, PlanePosition, PlaneVelocity


@graph
def particle(
    velocity: Stream[PlaneVelocity],
    position: Stream[PlanePosition],
    *,
    start: PlaneCloud,
    velocity_noise: float,
    position_noise: float,
    resample_below: float = 0.5,
    scheme: str = "systematic",
    draws: str = "particle",
    held: Held | None = None,
    smoothing: bool = False,
):
    """Bootstrap particle filter of a point in the plane.

    Every tick moves the cloud to now; a tick with a position also weighs it and may resample it. Collected:
    `belief` at every tick, averaged before resampling; `effective_sample_size`, `depleted` and `ancestors`
    at every position; with `smoothing` the `cloud` of each tick and the `control` of the step to it.
    """
    cloud = delay(start, name="cloud")
    control = latest(velocity, init=PlaneVelocity(velocity=np.zeros(2)), name="control")
    moved = move_plane(
        cloud, control, noise=velocity_noise, draws=f"{draws}.move", at=velocity | position, name="move"
    )
    if held is not None:
        moved = moved if held.longest is None else stay(cloud, moved, longest=held.longest)
        moved = spread_plane(moved, velocity, held=held, draws=f"{draws}.held")
    weighed = weigh_plane(moved, position, noise=position_noise, at=position, name="weigh")
    size = plane_sample_size(weighed, name="size")
    fresh, ancestors = resample_plane(
        weighed, size, below=resample_below, scheme=scheme, draws=f"{draws}.resample", name="resample"
    )
    cloud.feed(merge(fresh, moved, tie="left", name="next"))
    collect(depletion(size, numbers=2), "depleted")
    now = merge(weighed, moved, tie="left", name="now")
    belief = average_plane(now, name="average")
    if smoothing:
        collect(plane_states(now, name="states"), "cloud")
        collect(latest(velocity, init=PlaneVelocity(velocity=np.zeros(2)), at=velocity | position), "control")
    return {"belief": belief, "effective_sample_size": size, "ancestors": ancestors}


@on_flight(particle, "velocity", "position", ranged=False)
def for_flight(
    on: OnFlight,
    *,
    cloud: Particles,
    velocity_noise: Positive | None = None,
    position_noise: Positive | None = None,
    spread: Positive = 1.0,
    control: HeldControl,
    scored: Smoothed,
) -> Case:
    """Start the filter on a flight in the plane, such as `sim:plane`, about the origin.

    Args:
        flight: with the streams `velocity` and `position`.
        velocity_noise, position_noise: density in m/s/sqrt(Hz) and standard deviation in m; the flight's own
            if left out.
        spread: standard deviation of the start, m.

    Raises:
        DataError: where the flight lacks a stream; DeclarationError: for a setting that is out of range.
    """
    noise = on.noise("velocity_noise", velocity_noise)
    score = scored.score(
        on, plane_errors, steps=partial(cloud_steps, noise=noise),
        recording="its start is a cloud; tracker is a filter of the same point that has one",
    )  # fmt: skip
    return on.case(
        score,
        start=start_plane(cloud.particles, seed=cloud.seed, spread=spread),
        velocity_noise=noise,
        position_noise=on.noise("position_noise", position_noise),
        held=control.held(on, on.inputs["velocity"]),
        smoothing=scored.smoothed,
        **cloud.resampling(),
    )
