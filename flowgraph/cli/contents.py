"""`inspect`: what is in a recording, and which filters can use it."""

from __future__ import annotations

from itertools import chain
from typing import Annotated

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Seed, Settings, Truth, pairs
from flowgraph.cli.terminal import err_console, out_console, print_json, reports_errors, table
from flowgraph.data.contents import contents, graphs_for
from flowgraph.data.registry import flight_settings, load_flight
from flowgraph.data.suspect import suspect_readings
from flowgraph.errors import UnknownNameError


@app.command()
@reports_errors
def inspect(
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="A flight, as --data names it elsewhere.")],
    truth: Truth = None,
    settings: Settings = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Tell what a recording holds: streams, fields, units, rates and gaps, and the graphs that can use it."""
    given = pairs(settings)
    known = flight_settings(spec, truth)
    for key in given:
        if key not in known and "STREAM." + key.rpartition(".")[2] not in known:
            raise UnknownNameError("setting", key, known, path=spec.partition(":")[0])
    flight = load_flight(spec, seed=seed, settings=given, truth=truth)
    rows = contents(flight)
    graphs = graphs_for(flight)
    notes = [*flight.notes, *chain.from_iterable(map(suspect_readings, flight.streams.values()))]
    if as_json:
        return print_json({"flight": flight.name, "streams": rows, "graphs": graphs, "notes": notes})
    for note in notes:
        err_console.print(f"note: {note}", markup=False)
    shown = [
        {
            **{name: row[name] for name in ("name", "kind", "count", "rate_hz", "gaps", "longest_gap_s")},
            "fields": ", ".join(f["name"] + (f" ({f['unit']})" if f["unit"] else "") for f in row["fields"]),
        }
        for row in rows
    ]
    out_console.print(table(shown))
    out_console.print(f"graphs: {', '.join(graphs) or 'none'}", markup=False)
