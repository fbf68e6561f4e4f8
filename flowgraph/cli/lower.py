"""`lower`: graphs as fixed-size pipelines, and what they cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, DataOrNone, Name, Seed, Settings, Truth, graph_of, one_flight
from flowgraph.cli.terminal import err_console, out_console, print_json, reports_errors, writing
from flowgraph.engines.registry import writers
from flowgraph.errors import UnknownNameError
from flowgraph.language.block import NUMBERS
from flowgraph.pipeline.lowering import lower as lower_graph
from flowgraph.pipeline.optimise import DEFAULT, PASSES
from flowgraph.pipeline.optimise import without as passes_without


@app.command()
@reports_errors
def lower(
    graph: Name,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="For the pipeline.")],
    data: DataOrNone = None,
    truth: Truth = None,
    settings: Settings = None,
    seed: Seed = 0,
    target: Annotated[
        str, typer.Option(metavar="TARGET", help="description, or c for C99 too.")
    ] = "description",
    dtype: Annotated[str, typer.Option(help="What a real will be: float64, float32 or fixed.")] = "float64",
    events: Annotated[
        Path | None, typer.Option(metavar="FILE", help="For c: write the data as the csv that it replays.")
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="Write what it costs, as text and HTML.")] = False,
    without: Annotated[
        list[str] | None,
        typer.Option(metavar="PASS", help=f"Leave a pass out, repeatable: {', '.join(PASSES)}."),
    ] = None,
    multipliers: Annotated[int, typer.Option(min=1, help="Of a lane, for the report.")] = 16,
    lanes: Annotated[int, typer.Option(min=1, help="Particles at once, for the report.")] = 1,
    clock: Annotated[float, typer.Option(min=1.0, help="In Hz, for the report.")] = 100e6,
    as_json: AsJson = False,
) -> None:
    """Lower a graph to a fixed-size pipeline description, or to C as well."""
    writing_engines = writers()
    engine = writing_engines.get(target)
    kinds = NUMBERS if engine is None else engine.dtypes
    for what, given, valid in (
        ("target", target, ("description", *writing_engines)), ("dtype", dtype, kinds),
    ):  # fmt: skip
        if given not in valid:
            raise UnknownNameError(what, given, valid, path=f"--{what}")
    passes = passes_without(*(without or ()), passes=DEFAULT if engine is None else engine.passes)
    built, inputs = graph_of(graph, one_flight(data), settings, seed, truth)
    pipeline = lower_graph(built, dtype=dtype)
    pipeline.save(output)
    if engine is not None:
        for file in engine.write(pipeline, output, dtype, passes).values():
            err_console.print(f"wrote {file}", markup=False)
        if events is not None:
            ticks = engine.write_events(pipeline, inputs, events)
            err_console.print(f"wrote {events}: {ticks} ticks", markup=False)
    totals: dict[str, Any] = {"graph": graph, **pipeline.totals(), "latency": pipeline.latency()}
    if report:
        from flowgraph.pipeline.costs import cost_report  # only a report needs it

        costs = cost_report(pipeline, passes=passes, multipliers=multipliers, lanes=lanes, clock=clock)
        for name, text in (("report.txt", costs.text()), ("report.html", costs.html())):
            with writing(output / name) as written:
                written.write_text(text)
        totals["cost"] = {section.title: list(section.rows) for section in costs.sections}
    if as_json:
        return print_json({**totals, "output": str(output)})
    cost = totals.pop("cost", None)
    for key, value in totals.items():
        out_console.print(f"{key:<16}{value}", highlight=False)
    for row in (cost or {}).get("Ticks", ()):
        out_console.print(", ".join(f"{k} {v}" for k, v in row.items()), highlight=False, markup=False)
    err_console.print(f"wrote {output / 'pipeline.json'} and {output / 'pipeline.txt'}", markup=False)
