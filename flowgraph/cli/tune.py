"""`tune`: noise parameters fitted to recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Name, Settings, pairs
from flowgraph.cli.terminal import (
    err_console,
    out_console,
    print_json,
    print_whole,
    reports_errors,
    table,
    writing,
)
from flowgraph.data.files import need_place, put
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError

if TYPE_CHECKING:
    from flowgraph.study.tune import Found, Tuned


@app.command()
@reports_errors
def tune(
    graph: Name,
    data: Annotated[list[str], typer.Option("--data", metavar="SPEC", help="To fit to; repeatable.")],
    fit: Annotated[
        list[str],
        typer.Option("--fit", metavar="NAME=LOW:HIGH[:START]", help="A parameter to find; repeatable."),
    ],
    held_out: Annotated[
        list[str] | None, typer.Option("--held-out", metavar="SPEC", help="To judge by only; repeatable.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Of simulated flights to fit to: 0, 1, ...")] = 1,
    held_out_seeds: Annotated[
        int, typer.Option(min=0, help="Seeds after those, of the flights to fit to, to judge by.")
    ] = 0,
    folds: Annotated[
        int | None,
        typer.Option(min=2, metavar="K", help="Hold out each of K parts of the recordings in turn."),
    ] = None,
    by: Annotated[str, typer.Option(help="likelihood of the innovations, or error")] = "likelihood",
    metric: Annotated[str | None, typer.Option(help="The error; the score's first if left out.")] = None,
    method: Annotated[str | None, typer.Option(help="L-BFGS-B, Nelder-Mead or Powell.")] = None,
    slopes: Annotated[
        str | None, typer.Option(help="forward or differences; forward where the engine has them.")
    ] = None,
    engine: Annotated[str, typer.Option(help="In xla and c, recordings go together.")] = "reference",
    most: Annotated[int, typer.Option(min=1, help="Points to try in a search, about.")] = 200,
    settings: Settings = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="For the outcome, as JSON.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing while it searches.")] = False,
    as_json: AsJson = False,
) -> None:
    """Find noise parameters that suit recordings best, and judge them by recordings held out."""
    # A fifth of a second, with worker pools, that `list` need not pay.
    from flowgraph.study.tune import Fit, Recording, placed
    from flowgraph.study.tune import tune as search

    fits = [
        Fit(name, low, high, start, "linear" if placed(name) else "log")
        for name, low, high, start in map(span, fit)
    ]
    train = [Recording(d, s) for d in data for s in range(seeds)]
    later = [Recording(d, s) for d in data for s in range(seeds, seeds + held_out_seeds)]
    judges = later + [Recording(d) for d in held_out or []]
    hidden = quiet or as_json

    if out is not None:
        need_place(out)

    def watch(count: int, best: Any, value: float) -> None:
        err_console.print(f"{count} tried: {value:.6g} at {said_of(best)}", markup=False)

    found = search(
        graph, fits, train, judges, folds=folds, measure=by, metric=metric, settings=dict(pairs(settings)),
        method=method, slopes=slopes, engine=engine, most=most, watch=None if hidden else watch,
    )  # fmt: skip
    report = _report(found)
    if out is not None:
        with writing(out) as file:
            put(file, json.dumps(report, indent=1, allow_nan=False) + "\n")
    if as_json:
        return print_json(report)
    print_whole(table(_lines(found)))
    out_console.print(f"before: {said_of(found.start)}", markup=False)
    for k, part in enumerate(found.folds):
        out_console.print(f"after, without fold {k}: {said_of(part.parameters)}", markup=False)
    whole = "of all: " if found.folds else "after: "
    out_console.print(whole + " ".join(f"--set {n}={shown(v)}" for n, v in found.parameters.items()))
    sure = {n: d for n, d in found.deviations.items() if d is not None}
    if sure:
        out_console.print("standard deviations: " + said_of(sure), markup=False)
    for said in _notes(found):
        err_console.print(f"note: {said}", markup=False)
    bounds = {f.name: {"low": f.low, "high": f.high} for f in fits}
    for label, one in _searches(found):
        for name, side in one.at_bound.items():
            if name in found.without_effect:
                continue
            err_console.print(
                f"note: {name} ended at its {side} bound, {bounds[name][side]:g}{label}: the least lies"
                f" beyond it, or {name} hardly matters; widen --fit {name}=... to see",
                markup=False,
            )
        if not one.converged:
            err_console.print(
                f"note: the search{label} stopped early, after {one.evaluations} points; --most is {most}:"
                f" {one.message}",
                markup=False,
            )


def _notes(found: Tuned) -> list[str]:
    """On parameters that do nothing."""
    what = found.metric if found.measure == "error" else "likelihood"
    return [
        note(
            "warning", f"{name} has no effect on the {what} of these recordings: its value is where it began"
        )
        for name in found.without_effect
    ]


def _searches(found: Tuned) -> list[tuple[str, Found]]:
    """Each search with what to call it."""
    parts = [(f" without fold {k}", part) for k, part in enumerate(found.folds)]
    return [*parts, (" over all" if parts else "", found)]


def said_of(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{n}={shown(v)}" for n, v in values.items())


def shown(value: Any) -> str:
    """A number or an array as `--set` takes it, to five digits."""
    if isinstance(value, float | int):
        return f"{value:.5g}"
    return ";".join(",".join(f"{x:.5g}" for x in row) for row in np.atleast_2d(value))


def plain_parameters(values: Mapping[str, Any], deviations: Mapping[str, Any]) -> dict[str, Any]:
    """What `run --settings` reads: each value with its standard deviation, None where it is not known."""
    return {n: {"value": _plain(v), "deviation": _plain(deviations.get(n))} for n, v in values.items()}


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _lines(found: Tuned) -> list[dict[str, Any]]:
    """A line a recording, and the means: before, after and with the graph's own settings."""

    def line(data: str, seed: int | str, part: str, values: Sequence[Sequence[float]]) -> dict[str, Any]:
        cells: dict[str, Any] = {"data": data, "seed": seed, "": part}
        for name, triple in zip(names, values, strict=True):
            numbers = zip((f"{name} before", "after", "own"), triple, strict=True)
            cells |= {n + " " * len(cells): f"{v:.5g}" for n, v in numbers}  # columns of one name, told apart
        return cells

    by_error = found.measure == "error"
    first = found.metric or next((n for j in found.judged for n in j.metrics), None)
    names = [found.measure] * (not by_error) + [first] * (first is not None)
    none = (math.nan,) * 3
    lines = []
    for j in found.judged:
        part = "fitted" if not j.held_out else "held out" if j.fold is None else f"held out, fold {j.fold}"
        measure = [] if by_error else [(j.before, j.after, j.own)]
        shown = [j.metrics.get(first, none)] if first is not None else []
        lines.append(line(j.recording.data, j.recording.seed, part, [*measure, *shown]))
    for held_out in (False, True):
        mean = found.mean(held_out=held_out)
        if mean is not None:
            part = "held out" if held_out else "fitted"
            kind = "geometric mean" if by_error else "mean"
            values = [[math.exp(min(v, 700.0)) for v in mean]] if by_error else [mean]
            spare = [none] * (len(names) - 1)
            lines.append(line(kind, "", part, [*values, *spare]))
    return [{n: "" if v == "nan" else v for n, v in row.items()} for row in lines]


def _report(found: Tuned) -> dict[str, Any]:
    """The outcome as plain values."""
    three = ("before", "after", "own")
    rows = [
        {
            "data": j.recording.data, "seed": j.recording.seed, "held_out": j.held_out, "fold": j.fold,
            "before": j.before, "after": j.after, "own": j.own,
            "metrics": {n: dict(zip(three, values, strict=True)) for n, values in j.metrics.items()},
        }
        for j in found.judged
    ]  # fmt: skip
    means = {name: found.mean(held_out=held) for name, held in (("fitted", False), ("held_out", True))}

    def search(one: Found) -> dict[str, Any]:
        return {
            "parameters": plain_parameters(one.parameters, one.deviations),
            "evaluations": one.evaluations, "converged": one.converged, "message": one.message,
            "at_bound": one.at_bound,
        }  # fmt: skip

    return {
        "graph": found.graph, "start": {n: _plain(v) for n, v in found.start.items()},
        "measure": found.measure, "metric": found.metric,
        **search(found), "folds": [search(part) for part in found.folds], "recordings": rows,
        "without_effect": list(found.without_effect), "notes": _notes(found),
        "mean": {n: dict(zip(three, m, strict=True)) for n, m in means.items() if m is not None},
    }  # fmt: skip


def span(given: str, option: str = "--fit") -> tuple[str, float, float, float | None]:
    """Name, bounds and start of `NAME=LOW:HIGH[:START]`.

    Raises:
        DeclarationError: naming the option, for another form or bounds that hold nothing.
    """
    name, _, span = given.partition("=")
    try:
        numbers = [float(x) for x in span.split(":")]
        if not name or len(numbers) not in (2, 3):
            raise ValueError
    except ValueError:
        raise DeclarationError(
            "a parameter to find has bounds",
            path=option,
            expected="NAME=LOW:HIGH or NAME=LOW:HIGH:START",
            got=repr(given),
            fix=f"write {option} {name or 'position_noise'}=0.001:0.1",
        ) from None
    low, high, *start = numbers
    if not low < high or any(not low <= x <= high for x in start):
        least, most = sorted((low, high))
        begun = "" if any(not least <= x <= most for x in start) else "".join(f":{x:g}" for x in start)
        mended = (
            "NAME=LOW:HIGH" if math.isnan(low + high) or low == high else f"{name}={least:g}:{most:g}{begun}"
        )
        raise DeclarationError(
            "these are no bounds to search between",
            path=f"{option} {name}",
            expected="LOW below HIGH, and START between them",
            got=repr(given),
            fix=f"write {option} {mended}",
        )
    return name, low, high, start[0] if start else None
