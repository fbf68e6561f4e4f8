"""Scores as blocks: figures kept up while a run goes, in place of a trajectory to look at afterwards.

A score is a few sums. `running_mean`, `running_rms`, `running_share`, `running_extremes` and `settle_time`
are of any stream of numbers; `pose_score` and `nis_score` give what `pose_errors` and `nis_summary` give of
the recorded run, under the same names and equal but for rounding. They are blocks like any other, so every
engine runs them; a run of which only the score is kept returns sixteen numbers, once, at a tick of `end`.

The truth is a stream too: from a recording, or from a world in the same graph. What it does not have at a
tick of the estimate is not compared: nothing is interpolated. A covariance that is singular after `settle`
has no NEES here, and makes it not finite.

Source of NEES and NIS: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, sec. 5.4.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, Scalar, Stream, block, latest
from flowgraph.blocks.metrics.chi_square import chi_square_band
from flowgraph.blocks.metrics.terms import (
    FIGURES,
    attitude_terms,
    nis_limits,
    nis_terms,
    place_terms,
    turn_error,
)
from flowgraph.blocks.signals import (
    Bounds,
    Extremes,
    NavigationState,
    NisFigures,
    NisSums,
    PoseFigures,
    PoseSums,
    Settling,
    Tally,
)
from flowgraph.errors import DeclarationError
from flowgraph.language.clock import nanoseconds
from flowgraph.types import leaves_of

__all__ = [
    "nis_score",
    "pose_score",
    "running_extremes",
    "running_mean",
    "running_rms",
    "running_share",
    "settle_time",
]

_NEVER = -(2**63)
_SUMMED = [figure for figure in FIGURES if figure[2] != "most"]
_MOST = [figure for figure in FIGURES if figure[2] == "most"]


def _tallied(seen: Tally, value: Array) -> Tally:
    return Tally(count=seen.count + 1.0, total=seen.total + value)


@block
def running_mean(seen: Tally, x: Scalar) -> tuple[Tally, Scalar]:
    """The mean of all values so far."""
    seen = _tallied(seen, x)
    return seen, seen.total / seen.count


@block
def running_rms(seen: Tally, x: Scalar, *, xp: Any) -> tuple[Tally, Scalar]:
    """The root mean square of all values so far."""
    seen = _tallied(seen, x * x)
    return seen, xp.sqrt(seen.total / seen.count)


@block
def running_share(seen: Tally, x: Scalar, *, low: float, high: float, xp: Any) -> tuple[Tally, Scalar]:
    """Which share of the values so far was from `low` to `high`: the coverage of a band."""
    seen = _tallied(seen, xp.astype((x >= low) & (x <= high), x.dtype))
    return seen, seen.total / seen.count


@running_mean.init
def _(x: Any) -> Tally:
    return Tally(count=0.0, total=0.0)


@running_rms.init
def _(x: Any) -> Tally:
    return Tally(count=0.0, total=0.0)


@running_share.init
def _(x: Any, *, low: float, high: float) -> Tally:
    return Tally(count=0.0, total=0.0)


@block
def running_extremes(seen: Bounds, x: Scalar, *, xp: Any) -> tuple[Bounds, Extremes]:
    """The least and the largest value so far."""
    old = seen.extremes
    found = Extremes(
        least=xp.where(seen.any, xp.minimum(old.least, x), x),
        most=xp.where(seen.any, xp.maximum(old.most, x), x),
    )
    return Bounds(extremes=found, any=np.True_), found


@running_extremes.init
def _(x: Any) -> Bounds:
    return Bounds(extremes=Extremes(least=0.0, most=0.0), any=np.False_)


@block
def settle_time(seen: Settling, x: Scalar, *, within: float, t: Any, xp: Any) -> tuple[Settling, Scalar]:
    """How long after the first value one was last farther from 0 than `within`, in s: from then on it stayed.

    0 if none ever was."""
    first = xp.where(seen.first == _NEVER, t, seen.first)
    since = xp.astype(t - first, x.dtype) * 1e-9
    last = xp.where(xp.abs(x) > within, since, seen.last)
    return Settling(first=first, last=last), last


@settle_time.init
def _(x: Any, *, within: float) -> Settling:
    return Settling(first=np.int64(_NEVER), last=0.0)


@block
def pose_sums(
    seen: PoseSums, estimate=None, truth: NavigationState | None = None, *, settle, band, t, xp
) -> tuple[PoseSums, PoseSums]:  # type: ignore[no-untyped-def]
    """Add the errors of a tick that has both, `settle` ns after the first estimate or later.

    With e_p = p - p_true, e_v = v - v_true and phi = Log(q^-1 q_true): the NEES is |L^-1 (-e_p, -e_v, phi)|^2
    with L L^T the covariance of these nine."""
    if estimate is None:
        return seen, seen
    first = xp.where(seen.first == _NEVER, t, seen.first)
    if truth is None:
        same = seen.replace(first=first)
        return same, same
    p, v, q = estimate.position, estimate.velocity, estimate.attitude
    P = estimate.covariance[..., :9, :9]
    place, speed = p - truth.position, v - truth.velocity
    error = xp.concat([-place, -speed, turn_error(q, truth.attitude, xp)])
    white = _forward(xp.linalg.cholesky(P), error, xp)
    nees = xp.linalg.vecdot(white, white)
    found = {
        **place_terms(place, P[:3, :3], xp),
        **place_terms(speed, None, xp, of="velocity"),
        **attitude_terms(q, truth.attitude, P[6:9, 6:9], xp),
    }
    sizes = xp.stack([found[term] for _, term, _ in _MOST])
    squared = {"mean": lambda x: x, "root": lambda x: x * x}
    terms = xp.stack(
        [
            *(squared[how](found[term]) for _, term, how in _SUMMED),
            *(nees, xp.astype((nees >= band[0]) & (nees <= band[1]), p.dtype)),
        ]
    )
    counts = t - first >= settle
    added = PoseSums(
        first=first,
        count=seen.count + xp.astype(counts, p.dtype),
        sums=seen.sums + xp.where(counts, terms, 0.0),
        most=xp.where(counts, xp.maximum(seen.most, sizes), seen.most),
    )
    return added, added


def _no_sums() -> PoseSums:
    return PoseSums(first=np.int64(_NEVER), count=0.0, sums=np.zeros(12), most=np.zeros(2))


@pose_sums.init
def _(estimate: Any = None, truth: Any = None, *, settle: int, band: Array) -> PoseSums:
    return _no_sums()


def _forward(L: Array, e: Array, xp: Any) -> Array:
    """L^-1 e (n) of a lower triangle, row by row."""
    found: list[Array] = []
    for k in range(e.shape[-1]):
        known = xp.linalg.vecdot(L[k, :k], xp.stack(found)) if found else 0.0
        found.append((e[k] - known) / L[k, k])
    return xp.stack(found)


@block
def pose_figures(sums: PoseSums, *, xp: Any) -> PoseFigures:
    """The figures from their sums: means, and roots of means of squares."""
    mean, root = sums.sums / sums.count, {"mean": lambda x: x, "root": xp.sqrt}
    found = {name: root[how](mean[k]) for k, (name, _, how) in enumerate(_SUMMED)}
    found |= {name: sums.most[k] for k, (name, _, _) in enumerate(_MOST)}
    return PoseFigures(**found, nees_mean=mean[-2], nees_inside=mean[-1], compared_ticks=sums.count)


def pose_score(
    estimate: Stream[Any],
    truth: Stream[NavigationState],
    *,
    end: Stream[Any],
    settle: str | int = "1s",
    name: str = "score",
) -> Stream[PoseFigures]:
    """The figures of `pose_errors` of an estimate, at each tick of `end`, of all that came before and then.

    Args:
        estimate: of a pose, with position, velocity, attitude and a covariance whose first nine numbers are
            those of `PoseBelief`.
        truth: what is compared are the ticks at which both are present.
        end: when the figures are wanted, after `settle` at the earliest.
        settle: how long after the estimate's first tick its errors are left out.
        name: of the nodes.
    """
    sums = pose_sums(
        estimate,
        truth,
        settle=nanoseconds(settle, what="settle"),
        band=np.array(chi_square_band(9)),
        name=f"{name}_sums",
    )
    kept = latest(sums, init=_no_sums(), name=f"{name}_last")
    return pose_figures(kept, at=end, name=name)  # type: ignore[no-any-return]


@block
def nis_sums(seen: NisSums, innovation, *, limits: Array, xp: Any) -> tuple[NisSums, NisSums]:  # type: ignore[no-untyped-def]
    """Add an innovation: its NIS, how many numbers it is of, whether it is within the band of so many."""
    more = nis_terms(innovation, limits, xp)
    found = NisSums(*(getattr(seen, name) + getattr(more, name) for name in NisSums._fields))
    return found, found


@nis_sums.init
def _(innovation: Any, *, limits: Array) -> NisSums:
    return NisSums(nis=0.0, parts=0.0, inside=0.0, count=0.0, rejected=0.0)


@block
def nis_figures(sums: NisSums, *, xp: Any) -> NisFigures:
    """The figures from their sums; nis_inside is 0 where there was no innovation."""
    return NisFigures(
        nis_mean=sums.nis / xp.maximum(sums.parts, 1.0),
        nis_inside=sums.inside / xp.maximum(sums.count, 1.0),
        nis_count=sums.count,
        nis_parts=sums.parts,
        nis_rejected=sums.rejected,
    )


def nis_score(
    innovation: Stream[Any], *, end: Stream[Any], probability: float = 0.95, name: str = "nis"
) -> Stream[NisFigures]:
    """The figures of `nis_summary` of innovations, at each tick of `end`, of all that came before and then.

    Args:
        innovation: with nis and residual, and perhaps parts and accepted.
        end: when the figures are wanted.
        probability: of the band of each.
        name: of the nodes.

    Raises:
        DeclarationError: where nobody has said yet of how many numbers an innovation is.
    """
    width = dict(leaves_of(innovation.type))["residual"].shape[-1]
    if not isinstance(width, int):
        raise DeclarationError(
            "these innovations are of an unknown size",
            path=name,
            expected="a residual of so many numbers",
            got=f"{innovation.label}: residual ({width})",
            fix=f"build the graph with sizes={{{width!r}: 3}}",
        )
    sums = nis_sums(innovation, limits=nis_limits(width, probability), name=f"{name}_sums")
    none = NisSums(nis=0.0, parts=0.0, inside=0.0, count=0.0, rejected=0.0)
    kept = latest(sums, init=none, name=f"{name}_last")
    return nis_figures(kept, at=end, name=name)  # type: ignore[no-any-return]
