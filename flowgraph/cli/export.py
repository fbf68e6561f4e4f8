"""`run --export`: a run beside its flight, in the forms of other tools."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from flowgraph.cli.terminal import writing
from flowgraph.data.export.forms import Form, forms_of
from flowgraph.data.flight import Flight
from flowgraph.data.registry import Case
from flowgraph.data.result import Result
from flowgraph.errors import DeclarationError

EXPORT_HELP = "csv, parquet, mcap, rerun, with commas: the run and its flight, written into --out."


def wanted_forms(names: str | None, out: Path | None) -> dict[str, Form]:
    """The forms that were asked for, checked before the run.

    Raises:
        DeclarationError: without a folder; UnknownNameError, MissingDependencyError: as `forms_of`.
    """
    if names is None:
        return {}
    if out is None:
        raise DeclarationError(
            "there is no folder for what is to be exported",
            path="--export",
            expected="--out DIR",
            got="none",
            fix="write --out DIR --export " + names,
        )
    return forms_of(names)


def exported(forms: Mapping[str, Form], out: Path, case: Case, flight: Flight, result: Result) -> list[str]:
    """Write a run in each form; what the graph was fed goes along as `flight.NAME`, the truth as
    `flight.truth`. Returns notes."""
    beside = {f"flight.{name}": series for name, series in case.recorded.items()}
    if flight.truth is not None:
        beside["flight.truth"] = flight.truth
    streams = {name: s for name, s in {**result.series, **beside}.items() if len(s)}
    notes: dict[str, None] = {}
    for form in forms.values():
        with writing(out / form.place) as place:
            notes |= dict.fromkeys(form.write(streams, place, {**result.about, "flight": flight.name}))
    return list(notes)
