"""`list`, `show`, `run` and `demo`: filters on flights."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from flowgraph.cli.app import app
from flowgraph.cli.export import EXPORT_HELP, exported, wanted_forms
from flowgraph.cli.options import (
    SEED_HELP,
    AsJson,
    DataOrNone,
    Formats,
    Name,
    NameOrNone,
    Seed,
    Settings,
    SettingsFile,
    Shard,
    Truth,
    case_of,
    graph_of,
    one_flight,
    shared,
    with_file,
)
from flowgraph.cli.pages import recorder_of, runs_before, shown_again, write_page
from flowgraph.cli.resume import kept_in, resumed
from flowgraph.cli.stream import stream_folder, streamed
from flowgraph.cli.terminal import (
    err_console,
    first_line,
    in_characters_of,
    make_ready,
    offered,
    out_console,
    print_json,
    reports_errors,
    runs_table,
    table,
    writing,
)
from flowgraph.data.export.text import write_tum
from flowgraph.data.files import need_place, put
from flowgraph.data.flight import Flight
from flowgraph.data.notes import note
from flowgraph.data.progress import ProgressBar
from flowgraph.data.registry import KINDS, Case
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.engines.options import Checkpoint
from flowgraph.engines.registry import engine_names
from flowgraph.engines.simulate import simulate
from flowgraph.engines.watched import Watcher, simulate_watched
from flowgraph.errors import DataError, FlowgraphError, plain, writes


@app.command("list")
@reports_errors
def list_(as_json: AsJson = False) -> None:
    """List the graphs, with a line each, and name what is installed and cannot be imported."""
    offers = {group: offered(group) for group in KINDS}
    rows = [{"graph": n, "what": first_line(g.__doc__ or "")} for n, g in offers["flowgraph.graphs"].items()]
    data = list(offers["flowgraph.flights"])
    if as_json:
        return print_json({"rows": rows, "data": data})
    out_console.print(table(rows))
    out_console.print(f"data: {', '.join(data)}")


@app.command()
@reports_errors
def show(
    graph: Name,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="An .html, .svg, .png, .pdf or .dot file.")
    ] = None,
    fold: Annotated[
        int | None, typer.Option(min=0, help="Draw graphs nested deeper than this as one box.")
    ] = None,
    formats: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Number formats of `quantise`, to be drawn as well.")
    ] = None,
    data: DataOrNone = None,
    truth: Truth = None,
    settings: Settings = None,
    settings_file: SettingsFile = None,
    seed: Seed = 0,
) -> None:
    """Draw a graph: in the terminal, or to a file; an .html is a page in which it unfolds."""
    from flowgraph.drawing.page import diagram_page  # only who draws needs what draws
    from flowgraph.pipeline.costs.places import costs_by_path
    from flowgraph.pipeline.format_files import load_formats, with_formats
    from flowgraph.pipeline.format_words import formats_by_path
    from flowgraph.pipeline.lowering import lower

    built, inputs = graph_of(graph, one_flight(data), with_file(settings, settings_file), seed, truth)
    words: dict[str, str] = {}
    if formats is not None:
        words = formats_by_path(with_formats(lower(built, dtype="fixed"), load_formats(formats)))
    if output is None:
        width = out_console.width if out_console.is_terminal else None
        print(in_characters_of(sys.stdout, plain(built.text(fold=fold, width=width, inputs=inputs))))
        if words:
            out_console.print(
                table([{"path": path or built.name, "words": said} for path, said in words.items()])
            )
        return
    with writing(output):
        if output.suffix.lower() == ".html":
            costs = costs_by_path(built)
            for path, said in words.items():
                costs.setdefault(path, {})["words"] = said
            diagram_page(built, output, fold=fold, costs=costs, inputs=inputs)
        else:
            built.draw(str(output), fold=fold, words=words, inputs=inputs)


@app.command()
@reports_errors
def run(
    graph: NameOrNone = None,
    data: DataOrNone = None,
    truth: Truth = None,
    engine: Annotated[str | None, typer.Option(help=", ".join(engine_names()), show_default="python")] = None,
    dtype: Annotated[
        str | None, typer.Option(help="float64, float32 or fixed", show_default="float64")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=2**64 - 1, help=SEED_HELP, show_default="0")] = None,
    settings: Settings = None,
    settings_file: SettingsFile = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="For diagram, plots and metrics.")] = None,
    export: Annotated[str | None, typer.Option(metavar="FORMS", help=EXPORT_HELP)] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A page of the run, with diagram, plots and a slider.")
    ] = None,
    beside: Annotated[
        bool, typer.Option("--beside", help="Keep the runs that are in the page, to compare with them.")
    ] = False,
    shard: Shard = None,
    diverged: Annotated[
        str, typer.Option(help="Numbers that are no longer finite: raise or count.")
    ] = "raise",
    checkpoint: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the run in this file now and then.")
    ] = None,
    every: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Of flight time, from one to the next: 60.")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Go on from a checkpoint, or a folder of --stream; the rest is as it was."
        ),
    ] = None,
    stream: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write results to Parquet as they come; nothing else is kept."),
    ] = None,
    formats: Formats = None,
    as_json: AsJson = False,
) -> None:
    """Run a graph on a flight and compare it with the truth."""
    settings = with_file(settings, settings_file) or None
    whole = {"--out": out, "--export": export, "--html": html, "--beside": beside, "--formats": formats,
             "--checkpoint": checkpoint, "--every": every}  # fmt: skip
    folder = stream_folder(stream, resume, whole)
    share = shared(shard, streamed=folder is not None)
    command = resumed(resume, graph=graph, data=data, truth=truth, engine=engine, dtype=dtype, seed=seed,
                      settings=settings)  # fmt: skip
    graph, engine, dtype, seed = command.graph, command.engine, command.dtype, command.seed
    truth, settings = command.truth, command.settings
    kept = kept_in(checkpoint, every, resume if folder is None else None, command)
    forms = wanted_forms(export, out)
    if out is not None:
        make_ready(out)
    if html is not None:
        need_place(html)
    others = runs_before(html, beside)
    notes: dict[str, None] = {}

    def say(found: tuple[str, ...]) -> None:
        for words in found:
            if words not in notes:
                err_console.print(f"note: {words}", markup=False)
            notes[words] = None

    say(command.notes)
    spec = one_flight(command.data) or ""
    case, flight = case_of(graph, spec, settings, seed, truth, say)  # said before the run, which may fail
    about = {"data": spec, "flight": flight.name, "seed": seed, "settings": list(settings or [])}
    about |= {"truth": truth} if truth else {}
    if folder is not None:
        row = streamed(
            case, command, folder, resume=resume is not None, diverged=diverged, quiet=as_json, say=say
        )
        return (
            print_json({**row, **about, "notes": list(notes)})
            if as_json
            else out_console.print(runs_table([row]))
        )
    recorder = recorder_of(case) if html is not None else None
    watcher = recorder if engine == "python" and kept is None and shard is None else None
    result, row = _measure(
        case, graph, engine, dtype, seed, quiet=as_json, diverged=diverged, watcher=watcher, kept=kept,
        formats=formats, shard=share,
    )  # fmt: skip
    say(result.notes)
    say(case.remarks(result))
    if recorder is not None and watcher is None:
        options = {"dtype": dtype, "seed": seed, "diverged": diverged}
        recorder, words = shown_again(case, result, recorder, **options)
        say((words,))
    report = {**row, **about, "notes": list(notes)}
    if out is not None and forms:
        say(tuple(exported(forms, out, case, flight, result)))
        report["notes"] = list(notes)
    if out is not None:
        report["notes"] += _write_report(out, case, flight, result, report)
    if html is not None:
        title = ", ".join([graph, spec, *(settings or ()), f"seed {seed}", engine])
        with writing(html):
            on_page = write_page(
                html, others, title, case, flight.truth, case.recorded, result, recorder, report
            )
        say(tuple(on_page))
        report["notes"] = list(dict.fromkeys((*report["notes"], *on_page)))
    if as_json:
        return print_json(report)
    out_console.print(runs_table([row]))


@app.command()
@reports_errors
def demo(
    graphs: Annotated[list[str] | None, typer.Argument(metavar="[GRAPH]...")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="For diagrams and plots.")] = Path("out"),
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Run filters on the simulated flight in both engines, and draw them: ins_eskf and rbpf_indoor."""
    make_ready(out)
    rows = []
    for name in graphs or ("ins_eskf", "rbpf_indoor"):
        case, flight = case_of(name, "sim", None, seed)
        for engine in ("python", "xla"):
            try:
                result, row = _measure(case, name, engine, "float64", seed, quiet=as_json)
            except FlowgraphError as error:
                if engine == "python":
                    raise
                err_console.print(f"note: {error}", markup=False)
                continue
            rows.append(row)
            if engine == "python":
                _write_report(out / name, case, flight, result, row)
    if as_json:
        return print_json({"rows": rows})
    out_console.print(runs_table(rows))


def _measure(
    case: Case,
    name: str,
    engine: str,
    dtype: str,
    seed: int,
    *,
    quiet: bool,
    diverged: str = "raise",
    watcher: Watcher | None = None,
    kept: Checkpoint | None = None,
    formats: Path | None = None,
    shard: dict[str, int] | None = None,
) -> tuple[Result, dict[str, Any]]:
    start = perf_counter()
    hidden = quiet or not err_console.is_terminal
    with (
        nullcontext()
        if hidden
        else ProgressBar(f"{name} ({engine})", total=case.inputs, console=err_console) as meter
    ):
        options: dict[str, Any] = {"dtype": dtype, "seed": seed, "progress": meter, "diverged": diverged}
        if watcher is None:
            result = simulate(
                case.graph, case.inputs, engine=engine, checkpoint=kept, formats=formats, shard=shard,
                **options,
            )  # fmt: skip
        else:
            result = simulate_watched(case.graph, case.inputs, watcher, **options)
    total = perf_counter() - start
    row = {"graph": name, "engine": engine, "ticks": result.ticks, "wall_s": result.wall_s}
    row.update({"setup_s": total - result.wall_s, **case.score(result), **result.stats})
    for key, value in row.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise DataError(
                "the estimate went astray",
                path=f"{name}.{key}",
                expected="a finite number",
                got=str(value),
                fix="look at the settings and at the data: the filter divides by zero, or overflows",
            )
    return result, row


def _write_report(
    out: Path, case: Case, flight: Flight, result: Result, report: Mapping[str, Any]
) -> list[str]:
    """Write the figures, then the pictures; returns notes of the pictures that could not be made."""
    with writes(out):
        out.mkdir(parents=True, exist_ok=True)
    estimate = result.series.get(case.estimate)
    if estimate is not None and "attitude" in estimate.leaves and len(estimate):
        with writing(out / "estimate.tum") as file:
            write_tum(estimate, file)
    metrics = out / "metrics.json"
    with writing(metrics) as file:
        put(file, json.dumps(report, indent=1, allow_nan=False) + "\n")
    pictures = _pictures(case, flight, result, estimate)
    pictures |= {name: partial(write, result) for name, write in case.files.items()}
    failed = [failure for name, draw in pictures.items() if (failure := _draw(out / name, draw))]
    if failed:
        report = {**report, "notes": [*report.get("notes", ()), *failed]}
        put(metrics, json.dumps(report, indent=1, allow_nan=False) + "\n")
    return failed


def _draw(file: Path, draw: Callable[[Path], object]) -> str | None:
    """Make a picture, or return a note that says why there is none: it must not take the results with it."""
    try:
        with writing(file):
            draw(file)
    except Exception as error:
        why = str(error) if isinstance(error, FlowgraphError) else f"{type(error).__name__}: {error}"
        failure = note("skipped", f"the picture {file.name}: {plain(why)}")
        err_console.print(f"note: {failure}", markup=False)
        return failure
    return None


def _pictures(
    case: Case, flight: Flight, result: Result, estimate: Series | None
) -> dict[str, Callable[[Path], object]]:
    """What is drawn of a run, by the name of its file."""
    # With them comes SciPy, which only pictures need.
    from flowgraph.drawing.attitude import plot_orientation
    from flowgraph.drawing.plot import plot_navigation, plot_result
    from flowgraph.drawing.states import innovations_of, plot_states
    from flowgraph.drawing.trajectory import plot_space

    found: dict[str, Callable[[Path], object]] = {"diagram.svg": lambda file: case.graph.draw(str(file))}
    if estimate is None:
        return found
    tell = getattr(case.score, "pictured", None)  # of states that only their filter knows
    numbers = [] if tell is None else tell(result)
    if numbers:
        found["states.png"] = lambda file: plot_states(numbers, file, heading=case.graph.name)
        residuals = innovations_of(result)
        if residuals:
            found["innovations.png"] = lambda file: plot_states(residuals, file, heading=case.graph.name)
        return found
    if "position" in estimate.leaves and estimate["position"].shape[-1] in (2, 3):
        seen = next((s for s in case.recorded.values() if "position" in s.leaves and len(s)), None)
        found["navigation.png"] = lambda file: plot_navigation(
            estimate, flight.truth, file, observed=seen, order=case.order
        )
        if estimate["position"].shape[-1] == 2:
            found["outputs.png"] = lambda file: plot_result(result, file)
        elif seen is not None:
            found["trajectory.png"] = lambda file: plot_space(estimate, flight.truth, seen, file)
    elif "attitude" in estimate.leaves:
        found["orientation.png"] = lambda file: plot_orientation(estimate, flight.truth, file)
    else:
        found["outputs.png"] = lambda file: plot_result(result, file)
    return found
