"""Runs to be looked at: one run again, watched, with its wires, errors and way, as a page shows it.

A study keeps rows of figures, which say that a run went wrong and not how. So a report runs some of them
again, in the Python engine, with who records what is on the wires, and says where that run's figure is not
the one in the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from flowgraph.data.flight import Flight
from flowgraph.data.notes import note
from flowgraph.data.registry import Case
from flowgraph.drawing.recorder import Recorder
from flowgraph.drawing.run_page import describe_run
from flowgraph.engines.watched import simulate_watched
from flowgraph.errors import FlowgraphError, plain
from flowgraph.study.tasks import prepared

__all__ = ["QUICK", "chosen", "shown", "shown_again"]

QUICK = {"python": 3.0}
"""Seconds that a run may have taken in an engine to be run again for a report unasked; in others, which are
quicker, a twentieth of a second."""


def shown(
    case: Case, flight: Flight, title: str, *, notes: Sequence[str] = (), share: float = 1.0, **options: Any
) -> dict[str, Any]:
    """A run in plain lists and texts, for `run_page` and `report_page`.

    Args:
        title: by which it is picked.
        notes: that stand before its own.
        share: of what a page of one run holds, for one of several.
        options: of `simulate_watched`.

    Raises:
        FlowgraphError: as the run does.
    """
    recorder = Recorder(case.graph, case.inputs, share)
    result = simulate_watched(case.graph, case.inputs, recorder, **options)
    return describe_run(
        case.graph, result, title=title, estimate=case.estimate, truth=flight.truth, inputs=case.recorded,
        order=case.order, recorder=recorder, notes=[*notes, *case.remarks(result)],
        figures=case.score(result), share=share,
    )  # fmt: skip


def chosen(rows: Sequence[Mapping[str, Any]], metric: str, many: int | None, engine: str) -> list[Any]:
    """The rows whose runs a report shows: the worst by a figure, and as the last the one in the middle.

    Args:
        many: how many; None for three, of those that took no longer than `QUICK`.
    """
    usable = [r for r in rows if r.get("error") is None and _is_finite(r.get(metric))]
    ranked = sorted(usable, key=lambda r: -r[metric])
    if many is None:
        limit = QUICK.get(engine, 0.05)
        ranked = [r for r in ranked if _is_finite(r.get("wall_s")) and r["wall_s"] <= limit]
        many = 3
    if len(ranked) <= many or many < 2:
        return ranked[:many]
    return [*ranked[: many - 1], ranked[len(ranked) // 2]]


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def shown_again(
    row: Mapping[str, Any],
    names: Sequence[str],
    metric: str,
    *,
    share: float,
    dtype: str,
    say: Callable[[str], None],
) -> dict[str, Any] | None:
    """The run of a row once more, for a page; nothing, and a note to `say`, where that fails.

    Args:
        names: of the parameters in the row.
        metric: the figure by which it was chosen.
        share, dtype: as of `shown`.
    """
    given = {n: row[n] for n in names if row.get(n) is not None}
    settings = [f"{n}={v:.6g}" if isinstance(v, float) else f"{n}={v}" for n, v in given.items()]
    title = ", ".join([str(row["graph"]), str(row["data"]), *settings, f"seed {row['seed']}"])
    try:
        case, flight = prepared(row["graph"], row["data"], int(row["seed"]), given)
        notes = [note("info", "run again for this page, in the Python engine")]
        options = {"dtype": dtype, "seed": int(row["seed"]), "diverged": "count"}
        made = shown(case, flight, title, notes=notes, share=share, **options)
        again = dict(made["figures"]).get(metric)
        if again is not None and again != f"{row[metric]:.6g}":
            made["notes"].append(note("warning", f"{metric} is {row[metric]:.6g} in the study's table"))
        return made
    except FlowgraphError as error:
        say(note("skipped", f"the run {title} is not on the page: {plain(str(error))}"))
        return None
