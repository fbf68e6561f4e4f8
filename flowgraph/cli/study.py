"""`batch` and `report`: studies over flights, seeds and parameters, and what they found."""

from __future__ import annotations

import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson, Shard, shared
from flowgraph.cli.terminal import (
    Terminated,
    err_console,
    make_ready,
    print_json,
    print_whole,
    reports_errors,
    table,
)
from flowgraph.errors import DeclarationError, UnknownNameError

Folder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="For results; the study's own if left out.")
]
EXECUTORS = ("auto", "inprocess", "pool", "dask")


@app.command()
@reports_errors
def batch(
    file: Annotated[Path, typer.Argument(metavar="STUDY", help="A study in TOML, or a study.json.")],
    out: Folder = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes; with 1 all runs in this one.")] = 1,
    executor: Annotated[str, typer.Option(help=", ".join(EXECUTORS))] = "auto",
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Of a Dask cluster, such as tcp://host:8786.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Run everything anew.")] = False,
    retry: Annotated[bool, typer.Option("--retry-failed", help="Run anew what ended in an error.")] = False,
    shard: Shard = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep whole trajectories.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing while it runs.")] = False,
    json_lines: Annotated[
        bool, typer.Option("--json-lines", help="Print an object a line: start, each run, end.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Run a study, or what is missing of it, to a table with a row a run.

    Exit status: 0, or 1 where a run failed (its row says why), 2 for a wrong study, 130 after Ctrl-C, 143
    after SIGTERM; what is done by then is in the table.
    """
    from dataclasses import replace

    # Here and below: worker pools and tables take a fifth of a second, which `flowgraph list` need not pay.
    from flowgraph.study import Study, run_study

    study = Study.load(file)
    if keep:
        study = replace(study, keep=True)
    if shard is not None:
        study = replace(study, shard=shared(shard))
    folder = out or (Path(study.out) if study.out else None)
    if folder is None:
        raise DeclarationError(
            "a study needs a folder for its results",
            path="--out",
            expected="a folder",
            got="none",
            fix="write --out DIR, or out = ... in the study",
        )
    make_ready(folder)
    watcher = _watcher(study, quiet=quiet or as_json, json_lines=json_lines)
    try:
        with _executor(executor, scheduler, workers) or nullcontext() as chosen:
            outcome = run_study(
                study, folder, workers=workers, executor=chosen, force=force, retry=retry, watcher=watcher
            )
    finally:
        getattr(watcher, "stop", lambda: None)()
    if as_json:
        from flowgraph.study.progress import summary  # slow to import

        print_json(summary(outcome))
    elif not json_lines:
        _show(outcome, study, quiet)
    if outcome.interrupted:
        err_console.print(f"stopped; to continue: {_again(sys.argv)}", markup=False)
        raise typer.Exit(143 if outcome.by is Terminated else 130)
    if outcome.failed:
        first = outcome.failed[0]
        where = f"{first['graph']} on {first['data']}, seed {first['seed']}"
        err_console.print(
            f"{len(outcome.failed)} of {len(outcome.rows)} runs failed; {where}: {first['error']}",
            markup=False,
        )
        raise typer.Exit(1)


@app.command()
@reports_errors
def report(
    folder: Annotated[Path | None, typer.Argument(metavar="[DIR]", help="Of a study's results.")] = None,
    compare: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="A B", help="Pair the runs of two studies by seed and flight."),
    ] = None,
    metric: Annotated[str | None, typer.Option(help="To draw and rank by; the first if left out.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="For a comparison; B if left out.")] = None,
    across: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A setting of the flight in which pairs may differ; repeatable."),
    ] = None,
    runs: Annotated[
        int | None,
        typer.Option(min=0, help="To run again and put in the page whole; 3 if left out and they are quick."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write what a study found as an HTML page and pictures, or compare two studies."""
    from flowgraph.study.report import write_comparison, write_report  # slow to import

    if (folder is None) == (compare is None):
        raise DeclarationError(
            "a report is of one study, or of two compared",
            path="report",
            expected="DIR, or --compare A B",
            got="both" if folder is not None else "neither",
            fix="flowgraph report DIR",
        )
    notes: tuple[str, ...] = ()
    if compare is not None:
        page, rows, notes = write_comparison(*compare, out or compare[1], metric=metric, across=across or ())
    else:
        found = write_report(folder or "", metric=metric, runs=runs)
        page, rows, notes = found.page, found.summary, found.notes
    if as_json:
        return print_json({"page": str(page), "rows": rows, "notes": list(notes)})
    print_whole(table([{n: _short(v) for n, v in row.items()} for row in rows]))
    for one in notes:
        err_console.print(f"note: {one}", markup=False)
    err_console.print(f"wrote {page}", markup=False)


def _short(value: Any) -> Any:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else value


def _executor(name: str, scheduler: str | None, workers: int) -> Any:
    """The executor asked for; None leaves the choice to the number of workers."""
    from flowgraph.study import InProcess, OnDask, ProcessPool  # slow to import

    if name not in EXECUTORS:
        raise UnknownNameError("executor", name, EXECUTORS)
    if name == "dask" or scheduler is not None:
        return OnDask(scheduler, workers=workers)
    return {"inprocess": InProcess, "pool": lambda: ProcessPool(workers)}.get(name, lambda: None)()


def _watcher(study: Any, *, quiet: bool, json_lines: bool) -> Any:
    from flowgraph.study.progress import JsonLines, Lines, LiveTable, Tally  # slow to import

    if json_lines:
        return JsonLines(study, sys.stdout)
    if quiet:
        return Tally(study)
    return LiveTable(study, err_console) if err_console.is_terminal else Lines(study, err_console)


def _show(outcome: Any, study: Any, quiet: bool) -> None:
    from flowgraph.study.statistics import summarised  # slow to import

    if not quiet and outcome.rows:
        print_whole(table(summarised(outcome.rows, study.names(), study.metrics, most=4)))
    err_console.print(
        f"{outcome.done} runs in {outcome.seconds:.1f} s, {outcome.kept} were there already;"
        f" the table is {outcome.folder / 'results.parquet'}",
        markup=False,
    )


def _again(arguments: list[str]) -> str:
    return shlex.join(["flowgraph", *(a for a in arguments[1:] if a != "--force")])
