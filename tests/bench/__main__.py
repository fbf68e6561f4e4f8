"""`python -m tests.bench`: what flowgraph costs, each figure beside its peer in one run.

A missed bound is printed and marked, and does not fail: times on a shared machine are no test.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from tests.bench import (
    bootstrap,
    compiling,
    derived_c,
    further_run,
    generated_c,
    imports,
    inertial,
    lanes,
    lgssm,
    many,
    pages,
    particles,
    random,
    studies,
    study_memory,
    toy,
    unscented_c,
)
from tests.bench.rows import Row

Bench = Callable[..., list[Row]]

BENCHES: dict[str, tuple[Bench, dict[str, Any]]] = {
    "toy-python": (toy.python_engine, {"ticks": 100, "repeats": 1}),
    "toy-xla": (toy.xla_engine, {"ticks": 200, "repeats": 1}),
    "eskf-python": (inertial.against_numpy, {"duration": 0.5, "repeats": 1}),
    "eskf-engines": (inertial.engines, {"duration": 0.5, "repeats": 1}),
    "kalman-c": (generated_c.kalman, {"ticks": 200, "repeats": 1}),
    "ukf-c": (unscented_c.rows, {"ticks": 100, "repeats": 1}),
    "derived-c": (derived_c.rows, {"duration": 0.5, "repeats": 1}),
    "eskf-c": (generated_c.eskf, {"duration": 0.5, "repeats": 1}),
    "rbpf-c": (generated_c.rbpf, {"particles_": 50, "duration": 1.5, "repeats": 1}),
    "compile-c": (compiling.rows, {"repeats": 1}),
    "rbpf-engines": (particles.engines, {"sizes": (50,), "duration": 1.5, "repeats": 1}),
    "rbpf-libraries": (particles.libraries, {"sizes": (1000,), "steps": 10, "repeats": 1}),
    "bootstrap-python": (bootstrap.rows, {"sizes": (200,), "steps": 10, "repeats": 1}),
    "resampling": (particles.resampling, {"sizes": (100,), "repeats": 1}),
    "lgssm-xla": (lgssm.rows, {"steps": 50, "repeats": 1}),
    "normals-xla": (random.in_xla, {"ticks": 20, "repeats": 1}),
    "normals-python": (random.in_numpy, {"ticks": 5, "repeats": 1}),
    "lanes-c": (lanes.rows, {"duration": 2.0, "repeats": 1}),
    "many-runs": (many.rows, {"runs": 16, "duration": 2.0}),
    "study-seeds": (
        studies.seeds_of_ekf,
        {"runs": 8, "sample": 2, "duration": 2.0, "chunk": 4, "repeats": 1},
    ),
    "study-more-run": (further_run.rows, {"runs": 4, "repeats": 1, "factor": 0.5}),
    "study-memory": (study_memory.rows, {"sizes": (4, 8), "duration": 1.2}),
    "pages": (pages.rows, {"duration": 2.0, "repeats": 1}),
    "import": (imports.import_time, {"repeats": 1}),
}
"""The benches by name, each with the sizes of `--quick`."""


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one object with rows, and nothing else")
    parser.add_argument("--only", action="append", choices=list(BENCHES), help="one bench; may be repeated")
    parser.add_argument(
        "--quick", action="store_true", help="tiny sizes: checks the peers' numbers, no timing"
    )
    chosen = parser.parse_args(arguments)
    rows = []
    for name in chosen.only or BENCHES:
        bench, tiny = BENCHES[name]
        rows += bench(**(tiny if chosen.quick else {}))
    if chosen.json:
        print(json.dumps({"rows": [asdict(row) for row in rows]}, indent=1))
    else:
        show(rows)


def show(rows: list[Row]) -> None:
    """Print the table."""
    table = Table(title="Medians of interleaved pairs", title_justify="left")
    for heading in ("bench", "ours", "peer", "ratio"):
        table.add_column(heading, justify="left" if heading == "bench" else "right")
    for heading in ("unit", "peer is", "bound", ""):
        table.add_column(heading)
    marks = {True: "[green]met[/]", False: "[bold red]MISSED[/]", None: ""}
    for r in rows:
        small = r.ratio is not None and r.ratio < 0.1
        numbers = (f"{r.ours:.3g}", _figure(r.peer, ".3g"), _figure(r.ratio, ".4f" if small else ".2f"))
        table.add_row(r.name, *numbers, r.unit, r.against, r.bound or "", marks[r.met])
    console = Console(width=None if sys.stdout.isatty() else 150)
    console.print(table)
    missed = [r.name for r in rows if r.met is False]
    console.print(f"{len(missed)} missed: {', '.join(missed)}" if missed else "All bounds are met.")


def _figure(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


if __name__ == "__main__":
    main()
