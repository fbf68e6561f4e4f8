"""The smoother as a graph: a second pipeline, over the tape of a filter's run, played backwards.

    filter       tick after tick: the belief, its prior, and the covariance of both with the tick before
    smoother     the same ticks in reverse: each is smoothed by the one that came after it

`cross_covariance` stands beside a filter's prediction and gives what a smoother needs of it. `backwards`
turns a collected run into the tape of `smoother`, which any engine plays, and `forwards` turns what it gives.

    steps = backwards(result["prior"], result["posterior"], result["cross"])
    played = simulate(smoother.build(space=CAR, sizes=sizes_of(CAR)), {"step": steps}, engine="c")
    smoothed = forwards(played["smoothed"])

Source: as in `smoothing`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Array, Series, Stream, block, collect, delay, graph
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.kalman.smoothing import gone_back, smoother_gain
from flowgraph.blocks.signals import CrossCovariance, FilterStep, SmoothedBelief

__all__ = [
    "Crossing",
    "backwards",
    "collect_steps",
    "cross_covariance",
    "forwards",
    "go_back",
    "sizes_of",
    "smoother",
]

Crossing = Callable[[Any, Any, Any, Any], Array]
"""`(belief, control, dt, xp)`: the covariance (t, t) of a belief and what is predicted of it."""


@block
def cross_covariance(
    belief: Any, control: Any | None, *, crossing: Crossing, longest: float | None = None, dt: float, xp: Any
) -> CrossCovariance:
    """The covariance of a belief and of what is predicted of it over `dt` seconds.

    Args:
        belief: that of the tick before, with a `covariance`.
        control: that of the prediction.
        crossing: `(belief, control, dt, xp)` gives it.
        longest: s; over a longer step the belief stays, and has all in common with itself (`stay`).
    """
    found = crossing(belief, control, dt, xp)
    if longest is not None:
        found = xp.where(dt > longest, belief.covariance, found)
    return CrossCovariance(covariance=found)


def collect_steps(
    belief: Any, prior: Any, control: Any, *, crossing: Crossing, held: Held | None = None, at: Any = None
) -> None:
    """Collect the `prior`, `cross` and `control` of each tick for a smoother, in a graph that is being wired.

    Args:
        belief: that was predicted.
        prior: that came of it, before measurements.
        control: that drove the step.
        crossing: as in `cross_covariance`.
        held: as in `bridged`.
        at: when to fire, where all else is held.
    """
    more = {} if at is None else {"at": at}
    longest = None if held is None else held.longest
    collect(prior, "prior")
    collect(
        cross_covariance(belief, control, crossing=crossing, longest=longest, name="cross", **more), "cross"
    )
    collect(control, "control")


@block
def go_back(
    step: FilterStep, later: FilterStep, smoothed: SmoothedBelief, *, space: StateSpace | None, xp: Any
) -> SmoothedBelief:
    """A tick of a filter, smoothed by the one that came after it.

        C = D (P-)^-1      xs = x plus C (xs_later minus x-)      Ps = P + C (Ps_later - P-) C^T

    Args:
        step: the tick.
        later: the one after it, of which there is none at first: its cross-covariance is zero, and the tick
            stays as it is.
        smoothed: what the later one was smoothed to.
        space: of the state; None: a vector.
    """
    C = smoother_gain(later.cross, later.prior_covariance, xp)
    mean, P, lag_one = gone_back(
        C, step.mean, step.covariance, later.prior_mean, later.prior_covariance,
        smoothed.mean, smoothed.covariance, space, xp,
    )  # fmt: skip
    return SmoothedBelief(mean=mean, covariance=P, lag_one=lag_one)


@graph
def smoother(step: Stream[FilterStep], *, space: StateSpace):
    """The Rauch-Tung-Striebel smoother of a filter over a `space`, over its tape in reverse.

    Collected: `smoothed` at every tick.
    """
    rest, one = space.rest, np.eye(space.tangent)
    none = FilterStep(mean=rest, covariance=one, prior_mean=rest, prior_covariance=one, cross=0.0 * one)
    later = delay(none, name="later")
    ahead = delay(SmoothedBelief(mean=rest, covariance=one, lag_one=0.0 * one), name="ahead")
    smoothed = go_back(step, later, ahead, space=space)
    later.feed(step)
    ahead.feed(smoothed)
    return {"smoothed": smoothed}


def sizes_of(space: StateSpace) -> dict[str, int]:
    """The sizes of a `smoother` over a space, as its `build` takes them."""
    return {"n": space.size, "t": space.tangent}


def backwards(prior: Series, posterior: Series, cross: Series) -> Series:
    """The tape of `smoother`: the ticks of a run of a filter in reverse, over the same span of time.

    Args:
        prior, posterior, cross: the collected `Gaussian` and `CrossCovariance` of every tick.
    """
    flip = lambda array: array[::-1]
    steps = FilterStep(
        mean=flip(posterior["mean"]),
        covariance=flip(posterior["covariance"]),
        prior_mean=flip(prior["mean"]),
        prior_covariance=flip(prior["covariance"]),
        cross=flip(cross["covariance"]),
    )
    return Series(_reversed(posterior.time), steps, name="step")


def forwards(smoothed: Series) -> Series:
    """What `smoother` collected, in the order of time."""
    leaves = {name: leaf[::-1] for name, leaf in smoothed.leaves.items()}
    return Series(_reversed(smoothed.time), SmoothedBelief(**leaves), name=smoothed.name)


def _reversed(time: np.ndarray) -> np.ndarray:
    return np.asarray(time[0] + time[-1] - time[::-1]) if len(time) else time
