"""A flight in the plane, `sim:plane`: how fast a point moves is read often, where it is seldom.

The point goes along a random smooth figure, a sum of sinusoids that starts at the origin. A velocity reading
is the mean over the time since the reading before, so position is its exact integral, and the whole error is
white noise of the density that is told. A flight is a run of the graph `plane`; see `figure`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from flowgraph import Flight, Graph, Stream, Tick, graph, latest, simulate, ticks
from flowgraph.blocks.sensors import read_plane_position, read_plane_velocity
from flowgraph.blocks.signals import PlaneShape
from flowgraph.blocks.world import plane_motion, plane_shape
from flowgraph.data.experiment import Experiment
from flowgraph.data.inputs import clocks_of
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["DEFAULTS", "load_plane", "plane"]

DEFAULTS: Mapping[str, float] = {
    "duration": 20.0,
    "velocity.rate": 20.0,
    "velocity.noise": 0.3,
    "position.rate": 4.0,
    "position.noise": 0.3,
}
"""s, Hz, m/s/sqrt(Hz), Hz, m."""

_MOST_SAMPLES = 10_000_000


@graph
def plane(
    start: Stream[Tick],
    velocity: Stream[Tick],
    position: Stream[Tick],
    *,
    velocity_noise: float,
    position_noise: float,
    first: float,
) -> dict[str, Stream[Any]]:
    """A point in the plane; `start` ticks once, at 0, where the figure is drawn. There is a truth at every
    reading of either."""
    shape = latest(plane_shape(at=start), init=_NO_SHAPE, name="shape")
    here = plane_motion(shape, at=velocity | position)
    return {
        "velocity": read_plane_velocity(here, at=velocity, noise=velocity_noise, first=first),
        "position": read_plane_position(here, at=position, noise=position_noise),
        "truth": here,
    }


_NO_SHAPE = PlaneShape(sizes=np.zeros((2, 3)), phases=np.zeros((2, 3)), paces=np.zeros(3))


def load_plane(*, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Make a flight in the plane.

    Args:
        seed: of the figure and the noise, each of which has a random stream of its own name.
        settings: any of `DEFAULTS`.

    Returns:
        A `Flight` with the streams `velocity` (`PlaneVelocity`) and `position` (`PlanePosition`). truth:
        `PlanePosition` at both streams' times. info: `velocity_noise` (m/s/sqrt(Hz)), `position_noise` (m).

    Raises:
        UnknownNameError: for a setting that is not there; DeclarationError: for one out of its range.
    """
    n = dict(DEFAULTS)
    for name, text in (settings or {}).items():
        if name not in n:
            raise UnknownNameError("setting", name, DEFAULTS, path="sim:plane")
        n[name] = _positive(name, text)
    if n["duration"] * max(n["velocity.rate"], n["position.rate"]) > _MOST_SAMPLES:
        raise DeclarationError(
            "this simulated flight is too large",
            path="sim:plane",
            expected=f"at most {_MOST_SAMPLES:,} samples of a sensor",
            got=", ".join(f"{k}={n[k]:g}" for k in ("duration", "velocity.rate", "position.rate")),
            fix="choose a shorter duration or a lower rate",
        )
    world = _world(tuple(n.items()))
    flown = simulate(_built(tuple(n.items())), world.ticks, engine="numpy", seed=seed)
    return Flight(
        name=f"sim-plane-{seed}",
        streams={name: flown[name] for name in ("velocity", "position")},
        truth=flown["truth"],
        info={"velocity_noise": n["velocity.noise"], "position_noise": n["position.noise"]},
        notes=(note("info", f"simulated with seed {seed}: a smooth figure in the plane"),),
        experiment=world,
    )


@lru_cache(maxsize=8)
def _world(settings: tuple[tuple[str, float], ...]) -> Experiment:
    n = dict(settings)
    end = round(n["duration"] * 1e9) + 1
    periods = {s: max(round(1e9 / n[f"{s}.rate"]), 1) for s in ("velocity", "position")}
    told = {
        "velocity_noise": n["velocity.noise"],
        "position_noise": n["position.noise"],
        # the first reading covers no time, and is noise
        "first": (end - 1) // periods["velocity"] * periods["velocity"] * 1e-9 + 1.0,
    }
    clocks = {"start": end, **periods}
    return Experiment(plane, {s: ticks(each, until=end, name=s) for s, each in clocks.items()}, told)


@lru_cache(maxsize=8)
def _built(settings: tuple[tuple[str, float], ...]) -> Graph:
    world = _world(settings)
    return plane.build(**clocks_of(world.ticks), **world.settings)


def _positive(name: str, text: str | float) -> float:
    try:
        number = float(text)
    except (TypeError, ValueError):
        number = np.nan
    if not 0.0 < number < 1e9:
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path="sim:plane",
            expected="a positive number below 1e9",
            got=repr(text),
            fix=f"for example {name}={DEFAULTS[name]:g}",
        )
    return number
