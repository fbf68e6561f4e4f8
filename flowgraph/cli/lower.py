"""`lower`: graphs as fixed-size pipelines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Data, Name, Seed, Settings, case_of
from flowgraph.cli.terminal import err_console, out_console, print_json, reports_errors
from flowgraph.errors import UnknownNameError
from flowgraph.lowering import lower as lower_graph

TARGETS = ("description", "c")
"""What can be written."""


@app.command()
@reports_errors
def lower(
    graph: Name,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="For the pipeline.")],
    data: Data = "sim",
    settings: Settings = None,
    seed: Seed = 0,
    target: Annotated[str, typer.Option(metavar="TARGET", help="description, or c: C99.")] = "description",
    dtype: Annotated[str, typer.Option(metavar="DTYPE", help="For c: float64 or float32.")] = "float64",
    events: Annotated[
        Path | None, typer.Option(metavar="FILE", help="For c: write the data as the csv that it replays.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Lower a graph to a fixed-size pipeline description, or to C as well."""
    for what, given, valid in (("target", target, TARGETS), ("dtype", dtype, ("float64", "float32"))):
        if given not in valid:
            raise UnknownNameError(what, given, valid, path=f"--{what}")
    case, _ = case_of(graph, data, settings, seed)
    pipeline = lower_graph(case.graph)
    pipeline.save(output)
    if target == "c":
        from flowgraph.c import write_c, write_events

        for file in write_c(pipeline, output, dtype).values():
            err_console.print(f"wrote {file}", markup=False)
        if events is not None:
            ticks = write_events(pipeline, case.inputs, events)
            err_console.print(f"wrote {events}: {ticks} ticks", markup=False)
    totals = {"graph": graph, **pipeline.totals(), "latency": pipeline.latency()}
    if as_json:
        return print_json({**totals, "output": str(output)})
    for key, value in totals.items():
        out_console.print(f"{key:<16}{value}", highlight=False)
    err_console.print(f"wrote {output / 'pipeline.json'} and {output / 'pipeline.txt'}", markup=False)
