"""`bench`: experiments that print a table, such as the one of a paper beside our own figures."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Seed, Settings, pairs
from flowgraph.cli.terminal import (
    err_console,
    first_line,
    make_ready,
    offered,
    out_console,
    print_json,
    print_whole,
    reports_errors,
    table,
    writing,
)
from flowgraph.data.files import put
from flowgraph.data.registry import find_bench
from flowgraph.data.settings import parsed_settings, setting_names
from flowgraph.errors import UnknownNameError


@app.command()
@reports_errors
def bench(
    name: Annotated[str | None, typer.Argument(metavar="[BENCH]", help="Left out, they are listed.")] = None,
    flights: Annotated[int | None, typer.Option(min=1, help="How many, where they are simulated.")] = None,
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Recordings; $FLOWGRAPH_DATA or ../shared/datasets if left out."),
    ] = None,
    settings: Settings = None,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="For pictures and the table.")] = None,
    as_json: AsJson = False,
) -> None:
    """Run an experiment over many filters or flights and print its table."""
    if name is None:
        found = offered("flowgraph.benches")
        rows = [{"bench": n, "what": first_line(b.__doc__ or "")} for n, b in found.items()]
        return print_json({"rows": rows}) if as_json else out_console.print(table(rows))
    if out is not None:
        make_ready(out)
    experiment = find_bench(name)
    given = pairs(settings)
    for key, value in (("flights", flights), ("data", data), ("seed", seed or None)):
        if value is None:
            continue
        if key not in setting_names(experiment):
            raise UnknownNameError("option", f"--{key}", setting_names(experiment), path=name)
        given[key] = str(value)
    mine, _ = parsed_settings(experiment, given, also=(), path=name)
    report = experiment(**mine)
    for note in report.notes:
        err_console.print(f"note: {note}", markup=False)
    if out is not None:
        for file_name, draw in report.figures.items():
            with writing(out / file_name) as file, tempfile.TemporaryDirectory() as aside:
                draw(Path(aside) / file.name)
                put(file, (Path(aside) / file.name).read_bytes())
    if as_json:
        return print_json({"bench": name, "rows": list(report.rows)})
    print_whole(table(report.rows))
