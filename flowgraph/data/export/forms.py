"""The forms in which a run can be taken along, by the names that the command knows them by."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from flowgraph.data.export.mcap_file import write_mcap
from flowgraph.data.export.packages import needed
from flowgraph.data.export.rerun_file import write_rerun
from flowgraph.data.export.tables import write_parquet
from flowgraph.data.export.text import write_table
from flowgraph.data.flight import Flight
from flowgraph.data.series import Series
from flowgraph.errors import UnknownNameError

Streams = Mapping[str, Series]
About = Mapping[str, object]


@dataclass(frozen=True)
class Form:
    """A way out.

    Args:
        place: the file or folder that it writes.
        write: streams to that place, with what to say about them; returns notes.
        package, extra: what it needs, and what installs it; empty where it needs nothing.
    """

    place: str
    write: Callable[[Streams, Path, About], tuple[str, ...]]
    package: str = ""
    extra: str = ""


def _csv(streams: Streams, file: Path, about: About) -> tuple[str, ...]:
    write_table(Flight("run", streams), file)
    return ()


def _parquet(streams: Streams, folder: Path, about: About) -> tuple[str, ...]:
    write_parquet(streams, folder, about=about)
    return ()


def _mcap(streams: Streams, file: Path, about: About) -> tuple[str, ...]:
    return write_mcap(streams, file, about=about)


def _rerun(streams: Streams, file: Path, about: About) -> tuple[str, ...]:
    return write_rerun(streams, file, about=about)


FORMS = {
    "csv": Form("streams.csv", _csv),
    "parquet": Form("parquet", _parquet, "pyarrow.parquet", "parquet"),
    "mcap": Form("run.mcap", _mcap, "mcap.writer", "mcap"),
    "rerun": Form("run.rrd", _rerun, "rerun", "rerun"),
}
"""By name: one csv table, a folder with a Parquet file a stream, an MCAP file, a recording of Rerun."""


def forms_of(names: str) -> dict[str, Form]:
    """The forms of a list with commas, ready to write.

    Raises:
        UnknownNameError: for a name that is none; MissingDependencyError: where its package is absent.
    """
    found = {}
    for name in [word.strip() for word in names.split(",") if word.strip()]:
        if name not in FORMS:
            raise UnknownNameError("form of export", name, FORMS, path="--export")
        form = FORMS[name]
        if form.package:
            needed(form.package, f"--export {name}", form.extra)
        found[name] = form
    return found


__all__ = ["FORMS", "Form", "forms_of"]
