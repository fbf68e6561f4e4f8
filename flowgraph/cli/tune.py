"""`tune`: noise parameters fitted to recordings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

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
from flowgraph.errors import DeclarationError


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
    by: Annotated[str, typer.Option(help="likelihood of the innovations, or error")] = "likelihood",
    metric: Annotated[str | None, typer.Option(help="The error; the score's first if left out.")] = None,
    method: Annotated[str | None, typer.Option(help="L-BFGS-B, Nelder-Mead or Powell.")] = None,
    engine: Annotated[str, typer.Option(help="In xla, recordings go together.")] = "reference",
    most: Annotated[int, typer.Option(min=1, help="Points to try, about.")] = 200,
    settings: Settings = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="For the outcome, as JSON.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing while it searches.")] = False,
    as_json: AsJson = False,
) -> None:
    """Find noise parameters that suit recordings best, and judge them by recordings held out."""
    from flowgraph.study.tune import Fit, Recording
    from flowgraph.study.tune import tune as search

    fits = [Fit(name, *numbers) for name, numbers in map(_span, fit)]
    train = [Recording(d, s) for d in data for s in range(seeds)]
    later = [Recording(d, s) for d in data for s in range(seeds, seeds + held_out_seeds)]
    judges = later + [Recording(d) for d in held_out or []]
    hidden = quiet or as_json

    def watch(count: int, best: Any, value: float) -> None:
        said = ", ".join(f"{n}={v:.4g}" for n, v in best.items())
        err_console.print(f"{count} tried: {value:.6g} at {said}", markup=False)

    found = search(
        graph, fits, train, judges, measure=by, metric=metric, settings=dict(pairs(settings)), method=method,
        engine=engine, most=most, watch=None if hidden else watch,
    )  # fmt: skip
    rows = [
        {
            "data": j.recording.data, "seed": j.recording.seed, "held_out": j.held_out,
            "before": j.before, "after": j.after,
            "metrics": {n: {"before": b, "after": a} for n, (b, a) in j.metrics.items()},
        }
        for j in found.judged
    ]  # fmt: skip
    report = {
        "graph": graph, "parameters": found.parameters, "measure": found.measure, "metric": found.metric,
        "evaluations": found.evaluations, "converged": found.converged, "message": found.message,
        "at_bound": list(found.at_bound), "recordings": rows,
    }  # fmt: skip
    if out is not None:
        with writing(out) as file:
            file.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    if as_json:
        return print_json(report)
    first = found.metric or next((n for j in found.judged for n in j.metrics), None)
    lines = []
    for j in found.judged:
        line = {
            "data": j.recording.data,
            "seed": j.recording.seed,
            "": "held out" if j.held_out else "fitted",
        }
        line |= {f"{by} before": f"{j.before:.5g}", "after": f"{j.after:.5g}"}
        if first is not None and first in j.metrics:
            before, after = j.metrics[first]
            line |= {f"{first} before": f"{before:.4g}", "then": f"{after:.4g}"}
        lines.append(line)
    print_whole(table(lines))
    out_console.print(" ".join(f"--set {n}={v:.5g}" for n, v in found.parameters.items()), markup=False)
    for name in found.at_bound:
        err_console.print(f"note: {name} ended at its bound: the least lies beyond it", markup=False)
    if not found.converged:
        err_console.print(f"note: the search stopped early: {found.message}", markup=False)


def _span(given: str) -> tuple[str, list[float]]:
    name, _, span = given.partition("=")
    try:
        numbers = [float(x) for x in span.split(":")]
        if not name or len(numbers) not in (2, 3):
            raise ValueError
    except ValueError:
        raise DeclarationError(
            "a parameter to find has bounds",
            path="--fit",
            expected="NAME=LOW:HIGH or NAME=LOW:HIGH:START",
            got=repr(given),
            fix="write --fit position_noise=0.001:0.1",
        ) from None
    return name, numbers
