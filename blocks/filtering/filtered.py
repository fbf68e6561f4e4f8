"""A filter of a model: the belief about a state that moves in one way and is measured in others.

    return filtered(car, {gps: fix}, control=steering, start=start, method=extended())

This is a sub-graph, drawn as one and nested in any other. At every tick of a measurement or of the control it
predicts to now, with the last control; each measurement that is present then corrects, one after the other:

    belief = delay(start)
    prior = predict(belief, latest(control))
    posterior = correct(prior, fix)
    belief.feed(posterior)

What differs from method to method is said by the method.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, Stream, block, collect, delay, latest, when
from flowgraph.blocks.filtering.ageing import Ageing, aged_motion, doubt_control
from flowgraph.blocks.filtering.methods import Advanced, Method, Seen, believed, extended
from flowgraph.blocks.kalman.lost import PATIENCE
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.errors import DeclarationError
from flowgraph.language.builder import builder
from flowgraph.language.clock import clock_of
from flowgraph.recorder.random import NumpyDraw, seed_words
from flowgraph.types import zeros

__all__ = ["FirstMeasurement", "filtered", "first"]


class FirstMeasurement(NamedTuple):
    """A start that waits for a measurement; see `first`."""

    measurement: Measurement
    believe: Callable[..., Gaussian]


def first(measurement: Measurement, believe: Callable[..., Gaussian]) -> FirstMeasurement:
    """Start a filter from the first message of a measurement: `start=first(gps, believe)`.

    Until then there is no belief; that tick's belief is what the message says.

    Args:
        measurement: one of the filter's.
        believe: `believe(message, xp) -> Gaussian`, mean (size) and covariance (t, t).
    """
    return FirstMeasurement(measurement, believe)


def filtered(
    motion: Motion,
    measurements: Mapping[Measurement, Stream[Any]],
    *,
    start: Gaussian | FirstMeasurement,
    control: Stream[Any] | None = None,
    control_at_first: Any = None,
    held: Ageing | None = None,
    method: Method | None = None,
    gate: float | None = None,
    patience: int = PATIENCE,
    smoothing: bool = False,
    name: str = "filter",
) -> Stream[Gaussian]:
    """The belief about the state of a model, by any method: a sub-graph.

    Collected: the `prior` of each tick, and where there was a measurement its `innovation`, with NIS, and its
    `log_likelihood`, with the name of the stream in front where there are several measurements; all with
    `name_` in front where a name is given.

    Args:
        motion: how the state moves.
        measurements: for each way in which it is measured, the stream of messages.
        start: the belief at the first tick; `space.gaussian(...)` makes one by name, `first(...)` takes it
            from the first message.
        control: the stream of controls, each held until the next; None for a motion that has none.
        control_at_first: before the first control came; zeros if left out.
        held: from which age on a control that is held is doubted, and how fast: `Ageing(after, spread)`; one
            that is held counts as fresh if left out.
        method: `extended()`, `unscented()`, `particles(1000)`, ...; extended if left out.
        gate: as in `update_linear`: below 1 the probability with which an honest measurement passes, from 1
            on the largest NIS. Refused measurements change nothing.
        patience: how many refusals in a row are taken for outliers; then the gate opens again (`find_back`).
        smoothing: collect what a smoother needs too: the `posterior`, and the `cross` covariance of each
            belief with the next prior; of particles the `cloud`; and the `control` of each step.
        name: of the sub-graph; two in one graph need two.

    Returns:
        `Gaussian` at every tick of a measurement or the control; with `first(...)` from that tick on.

    Raises:
        DeclarationError: where models and start do not fit together.
    """
    method = extended() if method is None else method
    seen = _named(motion, measurements)
    streams = [one.stream for one in seen] + ([] if control is None else [control])
    ticks = functools.reduce(operator.or_, (clock_of(s) for s in streams))
    rest = motion.space.resting() if isinstance(start, FirstMeasurement) else _fitting(start, motion)
    with builder("filtered").scope(name, given=name != "filter"):
        last = None
        if control is not None:
            at_first = zeros(control.type) if control_at_first is None else control_at_first
            last = latest(control, init=at_first, at=ticks, name="control")
            if held is not None:
                last = doubt_control(last, control, ageing=held, at=ticks, name="doubt")
                motion = aged_motion(motion, control.type, held)
        initial = method.begin(rest, motion, NumpyDraw("start", seed_words(method.seed), 0), np)
        kept = delay(initial, name="belief")
        found = method.advance(kept, last, motion, seen, at=ticks, gate=gate, patience=patience)
        more = dict(method.smoothable(kept, last, motion, found, at=ticks)) if smoothing else {}
        if isinstance(start, FirstMeasurement):
            found, more = _from_first(found, more, start, seen, initial, motion, method)
        if smoothing:
            more["posterior"] = found.belief
            more |= {} if last is None else {"control": last}
        kept.feed(found.kept)
    own = "" if name == "filter" else f"{name}_"
    collect(found.prior, f"{own}prior")
    for label, stream in found.innovations.items():
        front = own + (f"{label}_" if len(seen) > 1 else "")
        collect(stream, f"{front}innovation")
        collect(found.log_likelihoods[label], f"{front}log_likelihood")
    for label, stream in [*found.more.items(), *more.items()]:
        collect(stream, own + label)
    return found.belief


def _named(motion: Motion, measurements: Mapping[Measurement, Stream[Any]]) -> list[Seen]:
    """The measurements with names: those of their streams."""
    if not measurements:
        raise DeclarationError(
            "a filter without a measurement knows nothing",
            path="filtered",
            expected="{model: stream}, at least one",
            got="none",
            fix="write filtered(car, {gps: fix}, ...)",
        )
    found: list[Seen] = []
    for model, stream in measurements.items():
        if model.space != motion.space:
            raise DeclarationError(
                "a measurement is of another state than the motion",
                path=f"filtered.{getattr(stream, 'label', stream)}",
                expected=str(motion.space),
                got=str(model.space),
                fix="declare both over one StateSpace",
            )
        label = stream.label.rpartition("/")[2].replace(".", "_")
        taken = sum(one.name.rstrip("_0123456789") == label for one in found)
        found.append(Seen(f"{label}_{taken + 1}" if taken else label, model, stream))
    return found


def _fitting(start: Gaussian, motion: Motion) -> Gaussian:
    """The start, where it is of the motion's state."""
    space = motion.space
    shapes = (np.shape(start.mean), np.shape(start.covariance))
    if shapes != ((space.size,), (space.tangent, space.tangent)):
        raise DeclarationError(
            "the start is no belief about the state",
            path="filtered.start",
            expected=f"mean ({space.size},) and covariance ({space.tangent}, {space.tangent}), of {space}",
            got=f"mean {shapes[0]} and covariance {shapes[1]}",
            fix="write start=SPACE.gaussian(part=(mean, deviation), ...)",
        )
    return start


# -- a start from the first message ----------------------------------------------------------------------


@block
def begin(
    kept: Any, prior: Gaussian, message: Any | None, started: Any, *,
    method: Method, motion: Motion, believe: Callable[..., Gaussian], rest: Any, draw: Any, xp: Any,
) -> tuple[Any, Gaussian, bool]:  # fmt: skip
    """What a filter keeps, once it has started: before, `rest`; with the first message, what that says.

    Args:
        kept, prior: of this tick.
        message: of the measurement that starts the filter; or absent.
        started: whether there was one before.
        method, motion: of the filter.
        believe: `believe(message, xp) -> Gaussian`.
        rest: what is kept while nothing is known.

    Returns:
        What is kept, the prior, which is the belief itself in the first tick, and whether it has started.
    """
    if message is None:
        return _chosen(started, kept, rest, xp), prior, started
    said = believe(message, xp)
    fresh = method.begin(said, motion, draw, xp)
    return _chosen(started, kept, fresh, xp), _chosen(started, prior, said, xp), started | ~started


@block
def once(value: Any, started: Any):
    """The value, where the filter has started."""
    return when(started, value)


def _chosen(first: Array, a: Any, b: Any, xp: Any) -> Any:
    """The signal a or b, field by field."""
    return type(a)(**{n: xp.where(first, getattr(a, n), xp.asarray(getattr(b, n))) for n in a._fields})


def _from_first(
    found: Advanced, more: Mapping[str, Any], start: FirstMeasurement, seen: list[Seen], rest: Any,
    motion: Motion, method: Method,
) -> tuple[Advanced, dict[str, Any]]:  # fmt: skip
    """What a tick makes, and `more` of it, where the filter waits for its first message."""
    message = next((one.stream for one in seen if one.model is start.measurement), None)
    if message is None:
        raise DeclarationError(
            "a filter cannot start from what it does not measure",
            path="filtered.start",
            expected="first(measurement, believe), of one of: " + ", ".join(one.name for one in seen),
            got=repr(start.measurement),
            fix="give the measurement to the filter too",
        )
    started = delay(np.bool_(False), name="started")
    kept, prior, now = begin(
        found.kept, found.prior, message, started,
        method=method, motion=motion, believe=start.believe, rest=rest, draws=f"{message.label}.start",
    )  # fmt: skip
    started.feed(now)
    belief = believed(kept, method=method, motion=motion, name="started_belief")
    advanced = Advanced(
        kept,
        once(prior, now, name="started_prior"),
        once(belief, now, name="once"),
        {name: once(s, started, name=f"{name}_innovation") for name, s in found.innovations.items()},
        {name: once(s, started, name=f"{name}_likelihood") for name, s in found.log_likelihoods.items()},
        found.more,
    )
    return advanced, {name: once(s, now, name=f"started_{name}") for name, s in more.items()}
