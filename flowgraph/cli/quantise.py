"""`quantise`: number formats for fixed point, found on simulated flights and judged on others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Name, Settings, SettingsFile, Truth, case_of, with_file
from flowgraph.cli.terminal import err_console, make_ready, out_console, print_json, reports_errors, table
from flowgraph.errors import DeclarationError
from flowgraph.pipeline.format_files import save_formats


@app.command()
@reports_errors
def quantise(
    graph: Name,
    data: Annotated[list[str], typer.Option("--data", metavar="SPEC", help="Flights; repeatable.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="For the formats.")],
    seeds: Annotated[int, typer.Option(min=1, help="Flights of each SPEC that formats are found on.")] = 4,
    held_out_seeds: Annotated[int, typer.Option(min=1, help="Other flights, that judge them.")] = 3,
    held_out_data: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SPEC", help="Flights that judge, where they are others than --data; repeatable."
        ),
    ] = None,
    held_out_settings: Annotated[
        list[str] | None,
        typer.Option("--held-out-set", metavar="KEY=VALUE", help="Settings for these, in place of --set."),
    ] = None,
    first_seed: Annotated[int, typer.Option(min=0, help="Of the first flight.")] = 0,
    width: Annotated[int, typer.Option(help="Bits of a word at most.")] = 32,
    held_width: Annotated[
        int, typer.Option(help="Bits of inputs, registers and what is added up in them, where they are more.")
    ] = 0,
    widen: Annotated[
        int,
        typer.Option(
            help="Bits of as few other values as keep the bounds, where --width is too few for all."
        ),
    ] = 0,
    least: Annotated[int, typer.Option(help="Bits below which none is tried.")] = 8,
    bound: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIGURE=MOST",
            help="position_difference_rms_m, attitude_difference_rms_deg, decisions_differing or"
            " estimate_difference_relative; repeatable.",
        ),
    ] = None,
    margin: Annotated[float, typer.Option(min=1.0, help="The sizes that occur, times this, fit.")] = 2.0,
    truth: Truth = None,
    settings: Settings = None,
    settings_file: SettingsFile = None,
    as_json: AsJson = False,
) -> None:
    """Find number formats for a graph in fixed point: the narrowest words that keep the bounds."""
    from flowgraph.study.quantise import Flown  # with the C engine, which few commands need
    from flowgraph.study.quantise import quantise as search

    make_ready(output)
    bounds = _bounds(bound)
    given = with_file(settings, settings_file)
    if held_out_settings and not held_out_data:
        raise DeclarationError(
            "these settings are for flights that are not given",
            path="--held-out-set",
            expected="--held-out-data beside it",
            got=", ".join(held_out_settings),
            fix="add --held-out-data SPEC, or write --set for all flights",
        )

    def flown(specs: list[str], chosen: list[str] | None, first: int, count: int) -> list[Any]:
        made = []
        for spec in specs:
            for seed in range(first, first + count):
                case, _ = case_of(graph, spec, chosen, seed, truth)
                made.append(Flown(case.graph, case.inputs, case.estimate, seed))
        return made

    def say(words: str) -> None:
        if not as_json:
            err_console.print(words, markup=False)

    others = (held_out_data, held_out_settings) if held_out_data else (data, given)
    held_out = flown(*others, first_seed + seeds, held_out_seeds)
    found = search(
        flown(data, given, first_seed, seeds), held_out, width=width, bounds=bounds, margin=margin,
        least=least, say=say, held_width=held_width, widen=widen,
    )  # fmt: skip
    report = {
        "graph": graph, "data": data, "settings": given, "seeds": seeds, "held_out_seeds": held_out_seeds,
        "held_out_data": others[0], "held_out_settings": others[1],
        "first_seed": first_seed, "margin": margin, "bounds": bounds, **found.figures,
        "tried": [dict(row) for row in found.tried], "notes": list(found.notes),
    }  # fmt: skip
    file = save_formats(output, graph, found.formats, report, found.values())
    if as_json:
        return print_json({**report, "output": str(output)})
    out_console.print(table([dict(row) for row in found.tried]))
    err_console.print(f"wrote {file}", markup=False)


def _bounds(texts: list[str] | None) -> dict[str, float]:
    """The bounds by figure; without any, a thousandth of the estimate."""
    found: dict[str, float] = {}
    for text in texts or ["estimate_difference_relative=0.001"]:
        name, _, most = text.partition("=")
        try:
            found[name.strip()] = float(most)
        except ValueError:
            raise DeclarationError(
                "a bound is a figure and the most that it may be",
                path="--bound",
                expected="FIGURE=MOST",
                got=repr(text),
                fix="write --bound position_difference_rms_m=0.001",
            ) from None
    return found
