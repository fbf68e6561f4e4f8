"""`lower`: graphs as fixed-size pipelines, and what they cost."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import (
    AsJson,
    DataOrNone,
    Formats,
    Name,
    Seed,
    Settings,
    SettingsFile,
    Truth,
    graph_of,
    one_flight,
    with_file,
)
from flowgraph.cli.terminal import err_console, out_console, print_json, reports_errors, writing
from flowgraph.data.files import put
from flowgraph.engines.registry import writers
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.block import NUMBERS
from flowgraph.pipeline.format_files import load_formats, with_formats
from flowgraph.pipeline.lowering import lower as lower_graph
from flowgraph.pipeline.optimise import DEFAULT, PASSES
from flowgraph.pipeline.optimise import without as passes_without
from flowgraph.pipeline.pipeline import Pipeline


@app.command()
@reports_errors
def lower(
    graph: Name,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="For the pipeline.")],
    data: DataOrNone = None,
    truth: Truth = None,
    settings: Settings = None,
    settings_file: SettingsFile = None,
    seed: Seed = 0,
    target: Annotated[
        str, typer.Option(metavar="TARGET", help="description, and c for C99, verilog, or hls for C++ too.")
    ] = "description",
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of the filter in what is written; that of the graph.")
    ] = None,
    dtype: Annotated[str, typer.Option(help="What a real will be: float64, float32 or fixed.")] = "float64",
    events: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the data as what was written replays.")
    ] = None,
    formats: Formats = None,
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
    """Lower a graph to a fixed-size pipeline description, and to C, Verilog or C++ for HLS as well."""
    writing_engines = writers()
    engine = writing_engines.get(target)
    kinds = NUMBERS if engine is None else engine.dtypes
    for what, given, valid in (
        ("target", target, ("description", *writing_engines)), ("dtype", dtype, kinds),
    ):  # fmt: skip
        if given not in valid:
            raise UnknownNameError(what, given, valid, path=f"--{what}")
    passes = passes_without(*(without or ()), passes=DEFAULT if engine is None else engine.passes)
    built, inputs = graph_of(graph, one_flight(data), with_file(settings, settings_file), seed, truth)
    pipeline = lower_graph(built, dtype="float64" if formats is None else "fixed")
    if formats is not None:
        pipeline = with_formats(pipeline, load_formats(formats))
    elif dtype == "fixed":
        raise DeclarationError(
            "there are no number formats for this graph",
            path="--dtype fixed",
            expected="formats that were found on flights",
            got="none",
            fix=f"flowgraph quantise {graph} --data SPEC -o DIR, then lower --formats DIR",
        )
    pipeline.need_numbers(dtype)
    if name is not None:
        pipeline = renamed(pipeline, name)
    pipeline.save(output)
    if engine is not None:
        for file in engine.write(pipeline, output, dtype, passes).values():
            err_console.print(f"wrote {file}", markup=False)
        if events is not None:
            ticks = engine.write_events(pipeline, inputs, events)
            err_console.print(f"wrote {events}: {ticks} ticks", markup=False)
        if (output / "Makefile").exists():
            played = events or "EVENTS (which --data SPEC --events EVENTS writes)"
            err_console.print(
                f"next: make -C {output}; the Makefile says what then plays {played}", markup=False
            )
    totals: dict[str, Any] = {"graph": graph, **pipeline.totals(), "latency": pipeline.latency()}
    if report:
        from flowgraph.pipeline.costs import cost_report  # only a report needs it

        costs = cost_report(pipeline, passes=passes, multipliers=multipliers, lanes=lanes, clock=clock)
        for name, text in (("report.txt", costs.text()), ("report.html", costs.html())):
            with writing(output / name) as written:
                put(written, text)
        totals["cost"] = {section.title: list(section.rows) for section in costs.sections}
    if as_json:
        return print_json({**totals, "output": str(output)})
    cost = totals.pop("cost", None)
    for key, value in totals.items():
        out_console.print(f"{key:<16}{value}", highlight=False)
    for row in (cost or {}).get("Ticks", ()):
        out_console.print(", ".join(f"{k} {v}" for k, v in row.items()), highlight=False, markup=False)
    err_console.print(f"wrote {output / 'pipeline.json'} and {output / 'pipeline.txt'}", markup=False)


def renamed(pipeline: Pipeline, name: str) -> Pipeline:
    """The pipeline under another name: two variants of one graph in one program need one each.

    Raises:
        DeclarationError: where that is no name in C.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,58}[A-Za-z0-9]|[A-Za-z]", name):
        raise DeclarationError(
            "a filter cannot be called this",
            path="--name",
            expected="letters, digits and underscores, 60 at most, with a letter first",
            got=repr(name),
            fix="write a name as of a function in C, such as --name ekf_rear",
        )
    return replace(pipeline, name=name)
