"""A flight in the plane, `sim:plane`: how fast a point moves is read often, where it is seldom.

The point goes along a random smooth figure, a sum of sinusoids that starts at the origin. A velocity reading
is the mean over the time since the reading before, so position is its exact integral, and the whole error is
white noise of the density that is told.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.signals import PlanePosition, PlaneVelocity
from flowgraph.blocks.world import generator
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["DEFAULTS", "load_plane"]

DEFAULTS: Mapping[str, float] = {
    "duration": 20.0,
    "velocity.rate": 20.0,
    "velocity.noise": 0.3,
    "position.rate": 4.0,
    "position.noise": 0.3,
}
"""s, Hz, m/s/sqrt(Hz), Hz, m."""

_WAVES = 3
_MOST_SAMPLES = 10_000_000


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
    end = round(n["duration"] * 1e9)
    often, seldom = (
        np.arange(0, end + 1, max(round(1e9 / n[f"{s}.rate"]), 1), dtype=np.int64)
        for s in ("velocity", "position")
    )
    dt = np.diff(often, prepend=often[0]) * 1e-9
    step = np.where(dt > 0.0, dt, often[-1] * 1e-9 + 1.0)  # the first reading covers no time, and is noise
    draw = lambda name, *shape: generator(seed, f"plane.{name}").standard_normal(shape)
    moved = np.diff(_figure(often, seed), axis=0, prepend=np.zeros((1, 2)))
    white = draw("velocity", len(often), 2) * n["velocity.noise"]
    velocity = PlaneVelocity(velocity=moved / step[:, None] + white / np.sqrt(step)[:, None])
    place = _figure(seldom, seed) + draw("position", len(seldom), 2) * n["position.noise"]
    time = np.union1d(often, seldom)
    return Flight(
        name=f"sim-plane-{seed}",
        streams={
            "velocity": Series(often, velocity, name="velocity"),
            "position": Series(seldom, PlanePosition(position=place), name="position"),
        },
        truth=Series(time, PlanePosition(position=_figure(time, seed)), name="truth"),
        info={"velocity_noise": n["velocity.noise"], "position_noise": n["position.noise"]},
        notes=(note("info", f"simulated with seed {seed}: a smooth figure in the plane"),),
    )


def _figure(time: np.ndarray, seed: int) -> np.ndarray:
    """Positions (n, 2) in m."""
    random = generator(seed, "plane.figure")
    size, phase = random.normal(size=(2, _WAVES)), random.uniform(0.0, 2.0 * np.pi, (2, _WAVES))
    pace = random.uniform(0.3, 1.5, _WAVES)  # rad/s
    angle = (time * 1e-9)[:, None, None] * pace + phase
    return np.asarray(np.sum(size * (np.sin(angle) - np.sin(phase)), axis=-1))


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
