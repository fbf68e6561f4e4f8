"""A filter that has lost track: what it is told when its control is old, and how its gate opens again.

`bridge` makes a prior less sure when the control that drove it is old. `find_back` makes a belief less sure
when a gate has refused a run of measurements, until one passes: then the belief is all but that measurement.
Both change the covariance alone, of any belief that has one. `stay` leaves a belief of any kind where it was
over a step that is no step but a jump of the stamps. All do nothing while all is well.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.metrics.consistency import IN_A_ROW

__all__ = ["PATIENCE", "Held", "aged", "bridge", "bridged", "find_back", "stay"]

PATIENCE = IN_A_ROW
"""How many refusals in a row are taken for outliers."""

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
    velocity: int,
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
            error in the body or angles; of a belief with ten, it is the quaternion. A position or attitude
            may be left out.

    State: the age of the control, s.
    """
    P = prior.covariance
    rest, part, w = aged(state, control, held, dt, xp)
    n = P.shape[-1]
    table = np.zeros((3, n, n))
    one = np.eye(3)
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


@block
def find_back(state, posterior: Any, innovation: Any | None, *, patience: int, moving: int, xp: Any):  # type: ignore[no-untyped-def]
    """Doubt a belief whose gate refuses one measurement after the other.

    The first `patience` refusals in a row change nothing: they may be outliers. From then on each makes the
    deviations of the first `moving` numbers, those of the motion, four times as large and keeps their
    correlations, while biases keep what they know. The covariance so grows until a measurement passes, and
    the motion is then that which was measured. A measurement that passes ends the run.

    Args:
        posterior: any belief with a `covariance`, its `root` or `information`, after the correction.
        innovation: of that correction, where there was one.
        patience: how many refusals in a row are taken for outliers.
        moving: how many numbers of the covariance, from the first on, may have lost track.

    State: how many measurements were refused in a row.
    """
    if innovation is None:
        return state, posterior
    on_root, inverse = "root" in posterior._fields, "information" in posterior._fields
    P = posterior.root if on_root else posterior.information if inverse else posterior.covariance
    refused = 1.0 - xp.astype(innovation.accepted, P.dtype)
    count = (state + refused) * refused
    lost = xp.astype(count > float(patience), P.dtype)
    moved = np.zeros(P.shape[-1])
    moved[:moving] = 1.0
    scale = 1.0 + 3.0 * xp.asarray(moved, dtype=P.dtype) * lost
    if on_root:
        return count, posterior.replace(root=P * scale[..., :, None])
    if inverse:
        return count, posterior.replace(information=P / scale[..., :, None] / scale[..., None, :])
    return count, _with(posterior, P * scale[..., :, None] * scale[..., None, :])


@find_back.init
def _none(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)
