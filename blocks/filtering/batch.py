"""The batch estimate: the most likely trajectory of a whole recording, from the model of the filter.

A smoother goes back over a run whose model was linearised where the filter was, once. A batch estimate has
all measurements at hand and linearises where the estimate is, until it stays there: it minimises

    |x_0 minus m|^2_P0 + sum |x_k+1 minus move(x_k)|^2_Q + sum rho(|z_k minus h(x_k)|_R)

by Gauss-Newton. Each round is a Kalman filter and a Rauch-Tung-Striebel smoother over the small errors about
the trajectory of the round before, which solves the round's normal equations exactly (Bell 1994), in time
linear in the length, and without the inverse of Q, which may be singular:

    error of a prediction   d + F' e      d = move(x_k) minus x_k+1, F' the derivative about both
    residual                z minus h(x) - H e, with R over the weight that the loss gives

With a robust `Loss` a measurement far off counts less, by weights that are found anew each round. A round is
two pipelines: `linearised` forward, `kalman.backward.smoother` back; the forward one is played by an engine.

Sources: B. Bell, "The iterated Kalman smoother as a Gauss-Newton method", SIAM J. Optimization 4(3), 1994;
P. Huber, "Robust Statistics", 1981; Z. Zhang, "Parameter estimation techniques: a tutorial with application
to conic fitting", Image and Vision Computing 15, 1997 (the losses and their widths).
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from flowgraph import Array, Graph, Series, aperiodic, block, delay, latest, simulate
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import correct as correct_jointly
from flowgraph.blocks.kalman.filters import masked
from flowgraph.blocks.kalman.lost import Held, bridge
from flowgraph.blocks.kalman.smoothing import rauch_tung_striebel
from flowgraph.blocks.signals import CrossCovariance, Gaussian, SmoothedBelief
from flowgraph.blocks.statespace import Measurement
from flowgraph.engines.registry import find_engine
from flowgraph.errors import DataError, DeclarationError, MissingDependencyError, UnknownNameError
from flowgraph.language.builder import Builder, building
from flowgraph.language.clock import Source, clock_of
from flowgraph.language.graph import SourceNode, Wire
from flowgraph.recorder.derivatives import jacobian
from flowgraph.types import Type, zeros

__all__ = [
    "LOSSES",
    "Aged",
    "Derived",
    "Loss",
    "Moves",
    "Recording",
    "cauchy",
    "estimate_batch",
    "huber",
    "loss_of",
]

LOSSES = ("none", "huber", "cauchy")
"""What a measurement that is far off counts."""

COMPILED = 2000
"""Ticks from which on a compiler, where there is one, is worth its time."""


@dataclass(frozen=True)
class Loss:
    """How a residual of e deviations counts, in place of e^2.

        huber    e^2 up to the width c, then 2 c e - c^2        weight 1, then c/e
        cauchy   c^2 log(1 + e^2/c^2)                           weight 1/(1 + e^2/c^2)

    Args:
        kind: huber or cauchy.
        width: c, in deviations; of a measurement of several numbers e^2 is their mean.

    Raises:
        UnknownNameError: for another kind; DeclarationError: for a width that is not positive.
    """

    kind: str
    width: float

    def __post_init__(self) -> None:
        if self.kind not in LOSSES[1:]:
            raise UnknownNameError("loss", self.kind, LOSSES[1:], path="Loss.kind")
        if not self.width > 0.0:
            raise DeclarationError(
                "a loss has a width",
                path=f"{self.kind}.width",
                expected="a positive number of deviations",
                got=repr(self.width),
                fix="write huber() or cauchy(), which have usual ones",
            )

    def weight(self, square: Array, xp: Any) -> Array:
        """What a residual of so many squared deviations weighs: 1 near 0, less where it is far off."""
        if self.kind == "cauchy":
            return 1.0 / (1.0 + square / self.width**2)
        far = square > self.width**2
        return xp.where(far, self.width / xp.sqrt(xp.where(far, square, 1.0)), 1.0)


def huber(width: float = 1.345) -> Loss:
    """Linear beyond the width: 95 % as good as squares where there is no outlier."""
    return Loss("huber", width)


def cauchy(width: float = 2.385) -> Loss:
    """Logarithmic beyond the width, so that a gross outlier hardly counts; 95 % as good as squares."""
    return Loss("cauchy", width)


def loss_of(name: str) -> Loss | None:
    """That of a name of `LOSSES`; None for none."""
    return {"huber": huber(), "cauchy": cauchy()}.get(name)


class Moves(Protocol):
    """What a batch estimate asks of a motion; each `Motion` has it."""

    @property
    def space(self) -> StateSpace:
        """Of the state."""

    def linearised(self, x: Array, control: Any, dt: Any, xp: Any) -> tuple[Array, Array, Array | None]:
        """(x', F, Q) at the state x (size), with F and Q (t, t)."""


class Derived(NamedTuple):
    """A motion by functions of its own: `linearised` as of a `Motion`, over a space."""

    space: StateSpace
    linearised: Any


class Aged(NamedTuple):
    """A control whose age makes a prediction less sure, as in `bridge`.

    Args:
        control: the readings as they came, not held.
        held: from which age on, and how fast.
        places: where position, velocity and attitude stand in the covariance.
    """

    control: Series
    held: Held
    places: Mapping[str, int]


@dataclass(frozen=True)
class Recording:
    """What a filter was given, for a batch estimate of it: `recording(around, loss)` makes it.

    Args:
        motion, measurements, start, longest, aged: as for `estimate_batch`.
        drive: `drive(time)`, the control of the step to each of these times (n,); None for a motion that has
            none.
    """

    motion: Moves
    measurements: Mapping[Measurement, Series]
    start: Gaussian
    drive: Callable[[np.ndarray], Series] | None = None
    longest: float | None = None
    aged: Aged | None = None

    def __call__(self, around: Series, loss: Loss | None = None) -> Series:
        """The batch estimate.

        Args:
            around: the trajectory to begin with, at the ticks of the filter.
            loss: as for `estimate_batch`.
        """
        return estimate_batch(
            self.motion, self.measurements, start=self.start, around=around, loss=loss,
            control=None if self.drive is None else self.drive(around.time),
            longest=self.longest, aged=self.aged,
        )  # fmt: skip


@block
def predict_about(
    belief: Gaussian, before: Array, now: Array, control: Any | None, *,
    motion: Moves, longest: float | None = None, dt: float, xp: Any,
) -> tuple[Gaussian, CrossCovariance]:  # fmt: skip
    """The error about a trajectory after `dt` seconds, and its covariance with that before.

        w = (now plus e') minus (move(before) plus F e), linearised, d + A e' + B F e, is noise of N(0, Q)

        e' = -A^-1 (d + B F e)      P' = F' P F'^T + A^-1 Q A^-T      F' = -A^-1 B F

    A and B are derivatives of minus and plus; of a vector 1 and -1. With dt = 0, as at the first firing, what
    is known of the start stands in place of the noise.

    Args:
        belief: of the error about `before`: mean and covariance (t, t); at first that of the start.
        before, now: the trajectory at the tick before, and at this one.
        control: as the motion takes it.
        motion: how the state moves.
        longest: s; over a longer step nothing moves (`stay`).
    """
    space, t, kind = motion.space, belief.mean.shape[-1], before.dtype
    after, F, Q = motion.linearised(before, control, dt, xp)
    Q = xp.zeros((t, t), dtype=kind) if Q is None else Q
    if longest is not None:
        moves = xp.asarray(dt, dtype=kind) <= longest
        after, Q = xp.where(moves, after, before), xp.where(moves, Q, 0.0)
        F = xp.where(moves, F, xp.eye(t, dtype=kind))
    first = xp.asarray(dt, dtype=kind) <= 0.0  # the start is where the noise of a first step would lead
    F, Q = xp.where(first, 0.0, F), xp.where(first, belief.covariance, Q)
    left = (F @ belief.mean[..., None])[..., 0]
    if _curved(space, kind, xp):
        still = xp.zeros((t,), dtype=kind)
        d, A = jacobian(lambda e, xp: space.minus(space.plus(now, e, xp), after, xp), still, xp)
        B = jacobian(lambda e, xp: space.minus(now, space.plus(after, e, xp), xp), still, xp)[1]
        columns = [B @ F, Q, ((B @ left[..., None])[..., 0] + d)[..., None]]
        solved = xp.linalg.solve(A, xp.concat(columns, axis=-1))
        F, mean = -solved[..., :t], -solved[..., -1]
        Q = xp.linalg.solve(A, solved[..., t : 2 * t].mT)
    else:
        mean = left - space.minus(now, after, xp)
    P = F @ belief.covariance @ F.mT + Q
    cross = CrossCovariance(covariance=belief.covariance @ F.mT)
    return Gaussian(mean=mean, covariance=0.5 * (P + P.mT)), cross


@block
def correct_about(
    prior: Gaussian, now: Array, message: Any | None, *, measurement: Measurement, loss: Loss | None, xp: Any
) -> Gaussian:
    """The error about a trajectory with what was measured; without a measurement it passes through.

    An entry of the measurement that is NaN counts as not measured.

    Args:
        prior: of the error about `now`.
        now: the trajectory at this tick.
        message: what was measured; or absent.
        measurement: what is seen of a state.
        loss: how much a residual counts that is far off; None: its square.
    """
    if message is None:
        return prior
    still = xp.zeros((prior.mean.shape[-1],), dtype=now.dtype)
    z, H, R = measurement.linearised(now, still, message, xp)
    apart = measurement.apart(measurement.vector(message, xp), z, xp)
    present = ~xp.isnan(apart)
    residual = xp.where(present, apart, 0.0)
    seen = measurement.measured_space
    if seen is not None and _curved(seen, now.dtype, xp):
        known = xp.where(xp.any(~present), z, measurement.vector(message, xp))  # a NaN has no derivative
        far = lambda e, xp: seen.minus(known, seen.plus(z, e, xp), xp)
        H = -jacobian(far, xp.zeros((seen.tangent,), dtype=now.dtype), xp)[1] @ H
    if loss is not None:
        _, noise = masked(H, R, present, xp)
        square = residual @ xp.linalg.solve(noise, residual[..., None])[..., 0]
        parts = xp.sum(xp.astype(present, residual.dtype), axis=-1)
        R = R / loss.weight(square / xp.maximum(parts, 1.0), xp)
    left = xp.where(present, residual - (H @ prior.mean[..., None])[..., 0], 0.0)
    found = correct_jointly(prior.covariance, left, H, R, present=present, xp=xp)
    return Gaussian(mean=prior.mean + found.shift, covariance=found.covariance)


def _curved(space: StateSpace, kind: Any, xp: Any) -> bool:
    """Whether plus and minus turn small errors."""
    return space.reset(xp.zeros((space.tangent,), dtype=kind), xp) is not None


def linearised(
    motion: Moves, measurements: Mapping[Measurement, Type], *, start: Gaussian, control: Type | None = None,
    loss: Loss | None = None, longest: float | None = None, aged: Aged | None = None,
) -> Graph:  # fmt: skip
    """The graph of a round: a Kalman filter of the errors about a trajectory.

    Its sources are `nominal`, the trajectory at every tick; `control`, that of the step to each; a
    measurement each, `seen_1` and on; and `fresh`, where a control can be old. It collects `prior`,
    `posterior` and `cross`.

    Args:
        motion: how the state moves.
        measurements: by model, the type of its messages.
        start: what is known before the first tick.
        control: its type; None for a motion that has none.
        loss, longest: as for `correct_about` and `predict_about`.
        aged: what the age of a control does.
    """
    space, t = motion.space, motion.space.tangent
    nominal_type = zeros_type(space.rest)
    build = Builder("linearised")

    def source(name: str, type_: Type) -> Any:
        path = build.path(name, given=True)
        return build.stream(Wire(build.add(SourceNode(path, type_, Source(path, aperiodic()))), 0))

    with building(build):
        nominal = source("nominal", nominal_type)
        drive = None if control is None else source("control", control)
        seen = [source(f"seen_{k + 1}", type_) for k, type_ in enumerate(measurements.values())]
        fresh = None if aged is None else source("fresh", aged.control.type)
        more = [s for s in (drive, fresh, *seen) if s is not None]
        ticks = functools.reduce(operator.or_, map(clock_of, more), clock_of(nominal))
        belief = delay(Gaussian(mean=np.zeros(t), covariance=start.covariance), name="error")
        before = delay(np.asarray(start.mean, dtype=float), name="before")
        now = latest(nominal, init=np.asarray(start.mean, dtype=float), at=ticks, name="now")
        held = None if drive is None else latest(drive, init=zeros(drive.type), at=ticks, name="drive")
        prior, cross = predict_about(
            belief, before, now, held, motion=motion, longest=longest, name="predict"
        )
        if aged is not None:
            prior = bridge(prior, fresh, held=aged.held, **aged.places)
        posterior = prior
        for k, (model, stream) in enumerate(zip(measurements, seen, strict=True)):
            posterior = correct_about(
                posterior, now, stream, measurement=model, loss=loss, name=f"correct_{k + 1}"
            )
        belief.feed(posterior)
        before.feed(now)
        for name, stream in (("prior", prior), ("posterior", posterior), ("cross", cross)):
            build.collect(name, stream)
        return build.freeze("A round of a batch estimate: a Kalman filter of errors about a trajectory.", {})


def estimate_batch(
    motion: Moves,
    measurements: Mapping[Measurement, Series],
    *,
    start: Gaussian,
    around: Series,
    control: Series | None = None,
    loss: Loss | None = None,
    longest: float | None = None,
    aged: Aged | None = None,
    rounds: int = 20,
    settled: float = 1e-3,
    engine: str = "auto",
) -> Series:
    """The most likely trajectory of a whole recording, with its covariances.

        result = simulate(tracker.build(...), {"fix": fixes})            # filtered(..., smoothing=True)
        estimate_batch(car, {gps: fixes}, start=start, around=smooth(result, CAR), control=result["control"])

    Args:
        motion: how the state moves: any `Motion`.
        measurements: for each way in which it is measured, the messages, at ticks of `around`.
        start: what is known before the first tick, about the state there.
        around: a trajectory to begin with, its `mean` (size) at every tick: that of a filter or smoother.
        control: that drives the step to each tick; None for a motion that has none.
        loss: how much a measurement counts that is far off, such as `huber()`; its square if left out.
        longest: s; over a longer step nothing moves.
        aged: what the age of a control does.
        rounds: how often the model is linearised, at most.
        settled: the largest change, in deviations, at which the estimate has settled.
        engine: of the forward passes; "auto" is c for a long recording where there is a compiler.

    Returns:
        `SmoothedBelief` at the ticks of `around`.

    Raises:
        DataError: where a measurement comes at no tick, or the estimate does not settle.
    """
    space, time = motion.space, around.time
    _need_ticks(time, [*measurements.values(), *([] if control is None else [control])])
    graph = linearised(
        motion, {model: s.type for model, s in measurements.items()}, start=start, loss=loss,
        control=None if control is None else control.type, longest=longest, aged=aged,
    )  # fmt: skip
    inputs = {f"seen_{k + 1}": series for k, series in enumerate(measurements.values())}
    inputs |= {} if control is None else {"control": control}
    inputs |= {} if aged is None else {"fresh": aged.control[np.isin(aged.control.time, time)]}
    engine = _engine(len(time)) if engine == "auto" else engine
    x, most = np.asarray(around["mean"], dtype=float), np.inf
    for _ in range(rounds):
        result = simulate(graph, {"nominal": Series(time, x), **inputs}, engine=engine)
        errors = rauch_tung_striebel(result["prior"], result["posterior"], result["cross"])
        x = np.asarray(space.plus(x, errors["mean"], np))
        deviations = np.sqrt(np.maximum(np.diagonal(errors["covariance"], axis1=-2, axis2=-1), 1e-300))
        most = float(np.max(np.abs(errors["mean"]) / deviations, initial=0.0))
        if most <= settled:
            P, lag_one = errors["covariance"], errors["lag_one"]
            return Series(time, SmoothedBelief(mean=x, covariance=P, lag_one=lag_one), name="batch")
    raise DataError(
        "the batch estimate does not settle",
        path="estimate_batch",
        expected=f"a change below {settled:g} deviations within {rounds} rounds",
        got=f"{most:.3g} deviations in the last",
        fix="begin around a smoothed trajectory, take loss=huber(), or allow more rounds",
    )


def zeros_type(rest: np.ndarray) -> Type:
    """The type of a state as a plain vector."""
    return Series(np.zeros(1, dtype=np.int64), np.asarray(rest, dtype=float)[None]).type


def _engine(ticks: int) -> str:
    """The C engine for a long recording, where there is a compiler; else Python's."""
    with suppress(MissingDependencyError):
        if ticks >= COMPILED:
            find_engine("c").need()
            return "c"
    return "python"


def _need_ticks(time: np.ndarray, series: list[Series]) -> None:
    for one in series:
        late = ~np.isin(one.time, time)
        if late.any():
            raise DataError(
                "this comes at no tick of the trajectory",
                path=f"estimate_batch: {one.name}",
                expected="the ticks of a filter that was given it too",
                got=f"{int(late.sum())} of {len(one)} values at other times",
                fix="run the filter over the same series, and begin around that run",
            )
