"""`lower`: graphs as fixed-size pipelines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Data, Name, Seed, Settings, case_of
from flowgraph.cli.terminal import err_console, out_console, print_json, reports_errors
from flowgraph.lowering import lower as lower_graph


@app.command()
@reports_errors
def lower(
    graph: Name,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="For the pipeline.")],
    data: Data = "sim",
    settings: Settings = None,
    seed: Seed = 0,
    dtype: Annotated[str, typer.Option(help="What a real will be: float64, float32 or fixed")] = "float64",
    as_json: AsJson = False,
) -> None:
    """Lower a graph to a fixed-size pipeline description."""
    case, _ = case_of(graph, data, settings, seed)
    pipeline = lower_graph(case.graph, dtype=dtype)
    pipeline.save(output)
    totals = {"graph": graph, **pipeline.totals(), "latency": pipeline.latency()}
    if as_json:
        return print_json({**totals, "output": str(output)})
    for key, value in totals.items():
        out_console.print(f"{key:<16}{value}", highlight=False)
    err_console.print(f"wrote {output / 'pipeline.json'} and {output / 'pipeline.txt'}", markup=False)
