"""How many bits the covariance of `ins_eskf` needs, by the form in which it is kept between two ticks.

Everything is computed in float64, and only the covariance that a tick leaves is rounded: its elements as they
are; those of states that are scaled, so that all of them are of one size at most; standard deviations and
correlations; or a triangular factor. No arithmetic in words of so many bits can do better in that form.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flowgraph import Report
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.graphs.benches import lists
from flowgraph.graphs.benches.fixed import flown
from flowgraph.graphs.benches.registers import MARGIN, played, rounded
from flowgraph.pipeline.formats import fraction_for
from flowgraph.recorder.random import seed_words

__all__ = ["covariances"]

Parts = tuple[np.ndarray, ...]


def _deviations(P: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.maximum(np.diagonal(P), 0.0)))


def _correlations(P: np.ndarray) -> Parts:
    d = _deviations(P)
    safe = np.where(d > 0.0, d, 1.0)
    return d, P / safe[:, None] / safe


def _factor(P: np.ndarray) -> Parts:
    try:
        return (np.linalg.cholesky(P),)
    except np.linalg.LinAlgError:  # on the edge of what is positive
        w, V = np.linalg.eigh(P)
        return (np.linalg.qr((V * np.sqrt(np.maximum(w, 0.0))).T)[1].T,)


_FORMS: Mapping[str, tuple[Callable[[np.ndarray], Parts], Callable[..., np.ndarray]]] = {
    "covariance": (lambda P: (P,), lambda P: P),
    "correlations": (_correlations, lambda d, C: C * d[:, None] * d),
    "factor": (_factor, lambda L: L @ L.T),
}
"""A form: what of a covariance is kept, and the covariance of that."""


def covariances(*, bits: str = "10,12,14,16,18,20,22,24", duration: float = 20.0, seed: int = 0) -> Report:
    """`ins_eskf` on a simulated flight, with the covariance rounded to words after each tick.

    Args:
        bits: whole numbers, between commas.
        duration: of the flight, s.
        seed: of the flight.

    Returns:
        A row a number of bits: `bits`, and `position_difference_rms_m` to the filter without rounding for
        each form: `covariance_m`, `scaled_m`, `correlations_m` and `factor_m`; None where it diverges.

    Raises:
        DeclarationError: for a setting out of range.
    """
    flight = flown("ins_eskf", seed, duration)
    subject = LoweredGraph(flight.graph)
    start = subject.start(RunOptions(seed=seed))
    given = (subject.pipeline, subject.tape(flight.inputs, start.last), start.cells, seed_words(seed))
    cells = [c for r in subject.pipeline.registers for c in r.cells]
    place = next(k for k, c in enumerate(cells) if len(c.shape) == 2 and c.shape[0] == c.shape[1])
    out = next(k for k, port in enumerate(subject.pipeline.outputs) if port.name == flight.estimate)
    leaf = next(k for k, x in enumerate(subject.pipeline.outputs[out].leaves) if x.name == "position")

    def positions(keep: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        made = []
        with np.errstate(all="ignore"):
            for program, env in played(*given, lambda k, x: keep(x) if k == place else x):
                flag, leaves = program.outputs[out]
                if flag is not None and env.get(flag, True):
                    made.append(env[leaves[leaf]])
        return np.array(made)

    largest: dict[str, list[np.ndarray]] = {}

    def looked(P: np.ndarray) -> np.ndarray:
        for form, (split, _) in _FORMS.items():
            parts = split(P)
            before = largest.get(form, [np.zeros_like(x) for x in parts])
            largest[form] = [np.maximum(a, np.abs(x)) for a, x in zip(before, parts, strict=True)]
        return P

    true = positions(looked)
    scale = _deviations(largest["covariance"][0])

    def apart(form: str, width: int) -> float | None:
        split, join = _FORMS[form]
        fractions = [fraction_for(MARGIN * size, width) for size in largest[form]]

        def keep(P: np.ndarray) -> np.ndarray:
            return join(*[rounded(x, f) for x, f in zip(split(P), fractions, strict=True)])

        return _apart(true, positions(keep))

    def scaled(width: int) -> float | None:
        over = scale[:, None] * scale
        fraction = fraction_for(MARGIN * largest["covariance"][0] / over, width)
        return _apart(true, positions(lambda P: rounded(P / over, fraction) * over))

    rows: list[dict[str, Any]] = []
    for width in lists.numbers(bits, "covariances.bits"):
        row = {"bits": width, "covariance_m": apart("covariance", width), "scaled_m": scaled(width)}
        rows.append(row | {f"{form}_m": apart(form, width) for form in ("correlations", "factor")})
    note = f"a flight of {duration:g} s; only the covariance is rounded, and sizes times {MARGIN:g} fit"
    return Report(rows, {}, (note,))


def _apart(a: np.ndarray, b: np.ndarray) -> float | None:
    found = float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=-1))))
    return found if np.isfinite(found) else None
