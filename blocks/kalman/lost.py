"""A filter that has lost track: what it is told when its control is old, and how its gate opens again.

`bridge` makes a prior less sure when the control that drove it is old. `find_back` makes a belief less sure
when a gate has refused a run of measurements, so that the next one passes. Both change the covariance alone,
of any belief that has one. `stay` leaves a belief of any kind where it was over a step that is no step but a
jump of the stamps. All do nothing while all is well. Whether track is lost is told by `in_doubt`, of Gaussian
beliefs and of clouds alike.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.kalman.triangles import covariance_root
from flowgraph.data.consistency import IN_A_ROW

__all__ = [
    "FARTHEST",
    "GROWN",
    "PATIENCE",
    "UNKNOWN_TURN",
    "Held",
    "aged",
    "bridge",
    "bridged",
    "find_back",
    "in_doubt",
    "lost_variances",
    "stay",
]

PATIENCE = IN_A_ROW
"""How many refusals in a row are taken for outliers."""

GROWN = 4.0
"""How many times as large, at least, the deviations of a lost belief become."""

FARTHEST = 1e14
"""The nis of a measurement of which nothing can be made: it would leave no digit of the covariance."""

REACH = 1e6
"""m, m/s: the deviation from which on a number of the motion does not grow."""

UNKNOWN_TURN = math.pi / math.sqrt(3.0)
"""rad: the deviation of an angle of which nothing is known: that of a uniform one."""

PAUSE = 1.0
"""s: a pause of all streams, or a jump of their stamps, makes as unsure as a gap of the control so long."""


class Held(NamedTuple):
    """What a control is worth that is held for longer than its own period.

    Args:
        after: s, how old a control may be before it is said to be held.
        rate: rad/s, by how much the rate of the body differs from a reading after one second.
        force: m/s^2, the same of its acceleration.
        longest: s, the longest step over which anything is predicted; None: any is. A longer one counts as
            `PAUSE`.
    """

    after: float
    rate: float = 1.0
    force: float = 5.0
    longest: float | None = None


def bridged(before: Any, prior: Any, control: Any, *, held: Held | None, **places: Any) -> Any:
    """The streams of a prior after `stay` and `bridge`, as far as `held` asks for them; wires, and no block.

    Args:
        before: the belief that was predicted.
        prior, control, held, places: as for `bridge`.
    """
    if held is None:
        return prior
    if held.longest is not None:
        prior = stay(before, prior, longest=held.longest)
    return bridge(prior, control, held=held, **places)


@block
def stay(before: Any, prior: Any, *, longest: float, dt: float, xp: Any):  # type: ignore[no-untyped-def]
    """What was predicted, or what was there before where the step is longer than `longest` (s).

    Any signal of arrays: a belief, a cloud of particles, an attitude.

    So after a pause of all streams, or a jump of their stamps, a belief is where it was.
    """
    still = dt > longest
    kept = {name: xp.where(still, getattr(before, name), getattr(prior, name)) for name in prior._fields}
    return type(prior)(**kept)


@block
def bridge(  # type: ignore[no-untyped-def]
    state,
    prior: Any,
    control: Any | None,
    *,
    held: Held,
    position: int | None = None,
    velocity: int | None = None,
    attitude: int | None = None,
    dt: float,
    xp: Any,
):
    """Add to a prior what is not known of the motion since its control became old.

    An error of the control that grows with its age T, force T (m/s^2) and rate T (rad/s), is white noise of a
    density that grows likewise. Over a part s of this step that ends at the age T, in which the control was
    older than `held.after`,

        w = 2 (T - s/2) s       velocity: force^2 w     position: force^2 w s^2/3     attitude: rate^2 w

    so that the velocity after a gap T is as uncertain as force T, and the attitude as rate T. While controls
    come as they should, s is 0 and the prior stays as it is, to the bit.

    Args:
        prior: any belief with a `covariance`, just predicted to now.
        control: where there is a fresh one; the age of the one before counts in the step that ends with it.
        held: from which age on, and how fast, it becomes worthless.
        position, velocity, attitude: where these stand in the covariance. An attitude of three numbers is an
            error in the body or angles; of a belief with ten, it is the quaternion. What a belief has not is
            left out.

    State: the age of the control, s.
    """
    P = prior.covariance
    rest, part, w = aged(state, control, held, dt, xp)
    n = P.shape[-1]
    table = np.zeros((3, n, n))
    one = np.eye(3)
    if velocity is not None:
        v = slice(velocity, velocity + 3)
        table[0, v, v] = one * held.force**2
        if position is not None:
            p = slice(position, position + 3)
            table[1, p, v] = table[1, v, p] = table[2, p, p] = one * held.force**2
    push = [xp.asarray(part_, dtype=P.dtype) for part_ in table]
    more = push[0] * w + push[1] * (0.5 * part * w) + push[2] * (part * part * w / 3.0)
    if attitude is not None:
        turn = w * held.rate**2
        if n == 10:
            q = prior.attitude
            lift = xp.asarray(np.eye(n, 4, -attitude), dtype=P.dtype)
            around = xp.eye(4, dtype=P.dtype) - q[..., :, None] * q[..., None, :]
            more = more + lift @ around @ lift.mT * (0.25 * turn)
        else:
            where = np.zeros((n, n))
            where[attitude : attitude + 3, attitude : attitude + 3] = one
            more = more + xp.asarray(where, dtype=P.dtype) * turn
    return rest, _with(prior, P + more)


def aged(
    age: Array, control: Any | None, held: Held, dt: Any, xp: Any, *, pause: float = PAUSE
) -> tuple[Array, Array, Array]:
    """The age of a control (s) after this step, which part s of the step it was old, and w of `bridge`.

    Args:
        pause: s, as how long a step counts that is longer than `held.longest`.
    """
    age = age + dt
    part = xp.minimum(xp.maximum(age - held.after, 0.0 * age), 0.0 * age + dt)
    if held.longest is not None:
        jumped = dt > held.longest
        age, part = (xp.where(jumped, pause, x) for x in (age, part))
    return (age if control is None else 0.0 * age), part, 2.0 * (age - 0.5 * part) * part


def _with(belief: Any, covariance: Array) -> Any:
    """The belief with another covariance."""
    kept = {name: getattr(belief, name) for name in belief._fields}
    return type(belief)(**(kept | {"covariance": covariance}))


@bridge.init
def _fresh(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)


def in_doubt(
    state: Array, near: Array, nis: Array, parts: Array, *, patience: float, xp: Any
) -> tuple[Array, Array, Array]:
    """Whether a belief has lost track, of how it foretold a measurement and those before.

    The first `patience` measurements in a row that are too far off are taken for outliers. The next shows
    that track is lost, and so on until one is near; and as one correction may not mend an error so large, the
    next one after it that is far shows it again: only two in a row are trusted.

    Args:
        state: how many were too far off in a row; `patience` after one that was near in doubt.
        near: whether this one is as near as expected.
        nis, parts: of its innovation.
        patience: how many in a row are taken for outliers.

    Returns:
        The next state; whether track is lost, which a nis beyond `FARTHEST` does not tell; and by what the
        variances must then grow, nis over parts and at least `GROWN` squared, else 1.
    """
    wait = 0.0 * state + patience
    count = xp.where(near, xp.where(state > wait, wait, 0.0 * state), state + 1.0)
    usable = nis < FARTHEST
    lost = (count > wait) & usable
    ratio = xp.where(lost, nis, 0.0) / xp.maximum(parts, 0.0 * parts + 1.0)
    return count, lost, xp.where(lost, xp.maximum(ratio, 0.0 * ratio + GROWN**2), 1.0)


@block
def find_back(  # type: ignore[no-untyped-def]
    state,
    posterior: Any,
    innovation: Any | None,
    *,
    patience: int,
    moving: int | tuple[int, int],
    attitude: int | None = None,
    shown: bool = True,
    xp: Any,
):
    """Doubt a belief whose gate refuses one measurement after the other.

    After `patience` refusals in a row the motion is lost (`in_doubt`). The deviations of its numbers then
    become as many times as large as the residual was than expected, so that a like measurement passes,

        s' = s max(4, sqrt(nis / m))        for a measurement of m numbers

    and they are correlated with nothing any more: what they told of each other was of another error. Numbers
    that do not move, such as biases, keep what they know. An attitude becomes at most as unsure as one of
    which nothing is known, everything else as `REACH`.

    Args:
        posterior: any belief with a `covariance`, its `root` or `information`, after the correction.
        innovation: of that correction, where there was one.
        patience: how many refusals in a row are taken for outliers.
        moving: how many numbers of the covariance, from the first on, may have lost track; or from which on
            to before which.
        attitude: where an attitude stands in the covariance, as in `bridge`.
        shown: whether the measurement shows that attitude. Where it does not, the others are blamed first,
            and the attitude's deviations become only four times as large.

    State: that of `in_doubt`.
    """
    if innovation is None:
        return state, posterior
    on_root, inverse = "root" in posterior._fields, "information" in posterior._fields
    kept = posterior.root if on_root else posterior.information if inverse else posterior.covariance
    kind, n = kept.dtype, kept.shape[-1]
    count, lost, grow = in_doubt(
        state, innovation.accepted, innovation.nis, innovation.parts, patience=float(patience), xp=xp
    )
    one = xp.eye(n, dtype=kind)
    P = kept @ kept.mT if on_root else xp.linalg.solve(kept, one) if inverse else kept
    variance = xp.sum(P * one, axis=-1)
    wide = lost_variances(variance, grow, moving=moving, attitude=attitude, shown=shown, xp=xp)
    inside = _inside(n, moving)
    apart = xp.asarray(np.where(inside[:, None] | inside, np.eye(n), 1.0), dtype=kind)
    doubted = P * apart + one * (wide - variance)[..., :, None]
    lost = lost[..., None, None]
    if on_root:
        return count, posterior.replace(root=xp.where(lost, covariance_root(doubted, xp=xp), kept))
    if inverse:
        return count, posterior.replace(information=xp.where(lost, xp.linalg.solve(doubted, one), kept))
    return count, _with(posterior, xp.where(lost, doubted, P))


def lost_variances(
    variance: Array,
    grow: Array,
    *,
    moving: int | tuple[int, int],
    attitude: int | None = None,
    shown: bool = True,
    xp: Any,
) -> Array:
    """The variances (n) of a belief by what they are, and what `in_doubt` says they must grow by.

    Args:
        moving, attitude, shown: as in `find_back`.
    """
    n = variance.shape[-1]
    inside = _inside(n, moving)
    most, blamed = np.where(inside, REACH**2, 0.0), np.ones(n)
    if attitude is not None:
        turn = slice(attitude, attitude + (4 if n == 10 else 3))  # a quaternion is of half angles
        most[turn] = UNKNOWN_TURN**2 * (0.25 if n == 10 else 1.0) * inside[turn]
        blamed[turn] = float(shown)
    grow, least = grow[..., None], xp.minimum(grow, 0.0 * grow + GROWN**2)[..., None]
    grow = xp.asarray(blamed, dtype=variance.dtype) * (grow - least) + least
    return xp.minimum(grow * variance, xp.maximum(xp.asarray(most, dtype=variance.dtype), variance))


def _inside(n: int, moving: int | tuple[int, int]) -> np.ndarray:
    first, last = moving if isinstance(moving, tuple) else (0, moving)
    return (np.arange(n) >= first) & (np.arange(n) < last)


@find_back.init
def _none(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)
