"""The page of `run --html`: who watches the run, what was in the page before, and what goes into it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flowgraph.data.notes import note
from flowgraph.data.registry import Case
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.engines.watched import replayed
from flowgraph.errors import DeclarationError, FlowgraphError, plain

if TYPE_CHECKING:
    from flowgraph.drawing.recorder import Recorder

_NO_FIGURES = ("graph", "engine", "notes", "data", "flight", "seed", "settings", "truth")


def runs_before(html: Path | None, beside: bool) -> list[dict[str, Any]]:
    """The runs that a page has and shall keep.

    Raises:
        DeclarationError: where no page is named.
        DataError: where the file that is there is no page of runs.
    """
    if not beside:
        return []
    if html is None:
        raise DeclarationError(
            "there is no page to put this run in", path="--beside", expected="--html FILE", got="no --html",
            fix="name the page with --html, or leave out --beside",
        )  # fmt: skip
    from flowgraph.drawing.run_page import runs_of_page  # only who draws needs what draws

    return runs_of_page(html) if html.exists() else []


def recorder_of(case: Case) -> Recorder:
    """Who records what is on the wires."""
    from flowgraph.drawing.recorder import Recorder  # only who draws needs what draws

    return Recorder(case.graph, case.inputs)


def shown_again(
    case: Case, result: Result, recorder: Recorder, **options: Any
) -> tuple[Recorder | None, str]:
    """Who was shown the wires of a run of another engine, in the Python engine, and a note on it.

    Nobody where that fails: it must not take the results with it.
    """
    try:
        return recorder, note("info", replayed(case.graph, case.inputs, recorder, result, **options))
    except FlowgraphError as error:
        return None, note("skipped", f"the values on the wires: {plain(str(error))}")


def write_page(
    html: Path,
    others: Sequence[Mapping[str, Any]],
    title: str,
    case: Case,
    truth: Series | None,
    recorded: Mapping[str, Series],
    result: Result,
    recorder: Recorder | None,
    report: Mapping[str, Any],
) -> list[str]:
    """Write the page of this run, with `others` that were in it before; returns the notes that are on it."""
    from flowgraph.drawing.run_page import describe_run, run_page  # only who draws needs what draws

    made = describe_run(
        case.graph, result, title=title, estimate=case.estimate, truth=truth, inputs=recorded,
        order=case.order, recorder=recorder, notes=report["notes"],
        figures={key: value for key, value in report.items() if key not in _NO_FIGURES},
    )  # fmt: skip
    run_page([*others, made], html)
    found: list[str] = made["notes"]
    return found
