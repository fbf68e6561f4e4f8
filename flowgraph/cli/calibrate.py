"""`calibrate`: time offsets, levers and mounts of sensors, found by what a filter makes of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Name, Settings, pairs
from flowgraph.cli.terminal import err_console, out_console, print_json, reports_errors, writing
from flowgraph.cli.tune import plain_parameters, said_of, shown, span
from flowgraph.data.files import need_place, put


@app.command()
@reports_errors
def calibrate(
    graph: Name,
    data: Annotated[list[str], typer.Option("--data", metavar="SPEC", help="To fit to; repeatable.")],
    find: Annotated[
        list[str],
        typer.Option(
            "--find",
            metavar="KEY=LOW:HIGH",
            help="STREAM.time_offset (s), STREAM.lever (m) or STREAM.mount (degrees), each component between"
            " the bounds; or a noise. Repeatable.",
        ),
    ],
    seed: Annotated[int, typer.Option(min=0, help="Of simulated flights.")] = 0,
    by: Annotated[
        str | None,
        typer.Option(
            help="likelihood of the innovations, or error; if left out, the error for the clock of a"
            " recording with a truth of its own, else the likelihood"
        ),
    ] = None,
    metric: Annotated[str | None, typer.Option(help="The error; the score's first if left out.")] = None,
    engine: Annotated[str, typer.Option(help="That plays the filter.")] = "c",
    most: Annotated[int, typer.Option(min=1, help="Points to try in a search, about.")] = 200,
    settings: Settings = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="For run --settings FILE.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing while it searches.")] = False,
    as_json: AsJson = False,
) -> None:
    """Find when a sensor was read, where it sits and how it is turned."""
    # A fifth of a second, with worker pools, that `list` need not pay.
    from flowgraph.study.calibrate import calibrate as search
    from flowgraph.study.tune import Fit, Recording

    if out is not None:
        need_place(out)

    def watch(count: int, best: Any, value: float) -> None:
        err_console.print(f"{count} tried: {value:.6g} at {said_of(best)}", markup=False)

    found = search(
        graph,
        [Fit(*span(f, "--find")) for f in find],
        [Recording(d, seed) for d in data],
        measure=by,
        metric=metric,
        settings=dict(pairs(settings)),
        engine=engine,
        most=most,
        watch=None if quiet or as_json else watch,
    )
    report = {
        "graph": found.graph,
        "parameters": plain_parameters(found.parameters, found.deviations),
        "evaluations": found.evaluations,
        "guesses": {n: {"value": g.offset, "correlation": g.correlation} for n, g in found.guesses.items()},
        "notes": list(found.notes),
    }
    if out is not None:
        with writing(out) as file:
            put(file, json.dumps(report, indent=1, allow_nan=False) + "\n")
    for words in found.notes:
        err_console.print(f"note: {words}", markup=False)
    if as_json:
        return print_json(report)
    for name, value in found.parameters.items():
        deviation = found.deviations.get(name)
        sure = "" if deviation is None else f" +- {shown(deviation)}"
        out_console.print(f"{name}={shown(value)}{sure}", markup=False, highlight=False)
