"""The `flowgraph` command: list, show, run and lower graphs from a terminal.

Results go to standard output, as a table or with `--json` as one object; everything else goes to standard
error. Exit status 2 means that the command was used wrongly, 1 that it failed.
"""

from __future__ import annotations

import functools
import inspect
import json
import math
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flowgraph.errors import DataError, DeclarationError, FlowgraphError, UnknownNameError, writes
from flowgraph.lowering import lower as lower_graph
from flowgraph.progress import ProgressBar
from flowgraph.registry import (
    Case,
    find_graph,
    flight_names,
    flight_settings,
    graph_names,
    load_flight,
    parsed_settings,
)
from flowgraph.result import Result
from flowgraph.series import Flight
from flowgraph.simulate import ENGINES, simulate

app = typer.Typer(
    help="Declare a filter once as a graph; draw it, simulate it, and lower it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_out = Console(soft_wrap=True)
_err = Console(stderr=True, soft_wrap=True, highlight=False)

Name = Annotated[str, typer.Argument(metavar="GRAPH", help="A graph from `flowgraph list`.")]
Data = Annotated[
    str,
    typer.Option("--data", metavar="SPEC", help="sim, sim:thesis, sim:hover, sim:roundtrip, euroc:PATH"),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="A setting of the graph or the flight; repeatable."),
]
Seed = Annotated[
    int, typer.Option(min=0, max=2**64 - 1, help="Of a simulated flight, and of the graph's draws.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def main() -> None:
    """The entry point of the `flowgraph` command."""
    try:
        app()
    except OSError as error:  # from what prints the help
        _give_up(f"{type(error).__name__}: {error}")
        sys.exit(1)


def _give_up(message: str) -> None:
    """Say why, and let nothing more be written to standard output, which may be what has failed."""
    with suppress(OSError):
        _err.print(f"error: {message}", markup=False)
    with suppress(OSError, ValueError):  # ValueError: it is no file, as in tests
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _reports_errors(command: Callable[..., None]) -> Callable[..., None]:
    """Errors of this package become a message on standard error and an exit status."""

    @functools.wraps(command)
    def run(*args: Any, **options: Any) -> None:
        try:
            command(*args, **options)
            sys.stdout.flush()
        except FlowgraphError as error:
            _err.print(f"error: {error}", markup=False)
            raise typer.Exit(2 if isinstance(error, UnknownNameError | DeclarationError) else 1) from None
        except BrokenPipeError:
            raise typer.Exit(1) from None
        except OSError as error:
            _give_up(f"{type(error).__name__}: {error}")
            raise typer.Exit(1) from None
        except MemoryError as error:
            _give_up(f"there is not enough memory for this: {error}")
            raise typer.Exit(1) from None

    return run


@app.command("list")
@_reports_errors
def list_(as_json: AsJson = False) -> None:
    """List the graphs, with a line each."""
    rows = [{"graph": n, "what": _first_line(find_graph(n).__doc__ or "")} for n in graph_names()]
    if as_json:
        return _print_json({"rows": rows, "data": flight_names()})
    _out.print(_table(rows))
    _out.print(f"data: {', '.join(flight_names())}")


@app.command()
@_reports_errors
def show(
    graph: Name,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="An .svg, .png, .pdf or .dot file.")
    ] = None,
    data: Data = "sim",
    settings: Settings = None,
    seed: Seed = 0,
) -> None:
    """Draw a graph: in the terminal, or to a file."""
    case, _ = _case(graph, data, settings, seed)
    if output is None:
        print(case.graph.text())
        return
    with _writing(output), _without_font_warnings():
        case.graph.draw(str(output))


@app.command()
@_reports_errors
def run(
    graph: Name,
    data: Data,
    engine: Annotated[str, typer.Option(help=", ".join(ENGINES))] = "python",
    dtype: Annotated[str, typer.Option(help="float64 or float32")] = "float64",
    seed: Seed = 0,
    settings: Settings = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="For diagram, plots and metrics.")] = None,
    as_json: AsJson = False,
) -> None:
    """Run a graph on a flight and compare it with the truth."""
    if out is not None:
        _make_ready(out)
    case, flight = _case(graph, data, settings, seed)
    for note in flight.notes:
        _err.print(f"note: {note}", markup=False)
    result, row = _measure(case, graph, engine, dtype, seed, quiet=as_json)
    report = {**row, "data": data, "flight": flight.name, "seed": seed, "settings": list(settings or [])}
    if out is not None:
        _write_report(out, case, flight, result, report)
    if as_json:
        return _print_json(report)
    _out.print(_runs_table([row]))


@app.command()
@_reports_errors
def lower(
    graph: Name,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="For the pipeline.")],
    data: Data = "sim",
    settings: Settings = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Lower a graph to a fixed-size pipeline description."""
    case, _ = _case(graph, data, settings, seed)
    pipeline = lower_graph(case.graph)
    pipeline.save(output)
    totals = {"graph": graph, **pipeline.totals(), "latency": pipeline.latency()}
    if as_json:
        return _print_json({**totals, "output": str(output)})
    for key, value in totals.items():
        _out.print(f"{key:<16}{value}", highlight=False)
    _err.print(f"wrote {output / 'pipeline.json'} and {output / 'pipeline.txt'}", markup=False)


@app.command()
@_reports_errors
def demo(
    graphs: Annotated[list[str] | None, typer.Argument(metavar="[GRAPH]...")] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="For diagrams and plots.")] = Path("out"),
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Run filters on the simulated flight in both engines, and draw them: ins_eskf and rbpf_indoor."""
    _make_ready(out)
    rows = []
    for name in graphs or ("ins_eskf", "rbpf_indoor"):
        case, flight = _case(name, "sim", None, seed)
        for engine in ("python", "xla"):
            try:
                result, row = _measure(case, name, engine, "float64", seed, quiet=as_json)
            except FlowgraphError as error:
                if engine == "python":
                    raise
                _err.print(f"note: {error}", markup=False)
                continue
            rows.append(row)
            if engine == "python":
                _write_report(out / name, case, flight, result, row)
    if as_json:
        return _print_json({"rows": rows})
    _out.print(_runs_table(rows))


def _case(name: str, spec: str, settings: list[str] | None, seed: int) -> tuple[Case, Flight]:
    graph = find_graph(name)
    given: dict[str, str] = {}
    for key, value in map(_pair, settings or []):
        if given.setdefault(key, value) != value:
            raise DeclarationError(
                "a setting is given twice",
                path=f"--set {key}",
                expected="one value",
                got=f"{given[key]} and {value}",
                fix="leave one of them out",
            )
    if graph.prepare is None:
        return graph.case(Flight(spec, {})), Flight(spec, {})  # raises, saying what is missing
    mine, rest = parsed_settings(graph.prepare, given, also=flight_settings(spec), path=name)
    flight = load_flight(spec, seed=seed, settings=rest)
    if "seed" in inspect.signature(graph.prepare).parameters:
        mine.setdefault("seed", seed)
    return graph.case(flight, **mine), flight


def _pair(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise DeclarationError(
            "a setting is KEY=VALUE",
            path="--set",
            expected="KEY=VALUE",
            got=repr(text),
            fix=f"write --set {key}=...",
        )
    return key.strip(), value.strip()


def _measure(
    case: Case, name: str, engine: str, dtype: str, seed: int, *, quiet: bool
) -> tuple[Result, dict[str, Any]]:
    start = perf_counter()
    hidden = quiet or not _err.is_terminal
    with (
        nullcontext()
        if hidden
        else ProgressBar(f"{name} ({engine})", total=case.inputs, console=_err) as meter
    ):
        result = simulate(case.graph, case.inputs, engine=engine, dtype=dtype, seed=seed, progress=meter)
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


def _make_ready(folder: Path) -> None:
    """Make a folder for results, and see that files can be made in it, before time is spent."""
    with writes(folder):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()


@contextmanager
def _without_font_warnings() -> Iterator[None]:
    """Keep what Fontconfig says of the system's own files, in C, out of standard error; nothing else."""
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            sys.stderr.flush()
            os.dup2(kept, 2)
            os.close(kept)
            said.seek(0)
            for line in said:
                if not line.startswith(b"Fontconfig "):
                    os.write(2, line)


def _write_report(out: Path, case: Case, flight: Flight, result: Result, report: Mapping[str, Any]) -> None:
    from flowgraph.plot import plot_navigation, plot_result

    with writes(out):
        out.mkdir(parents=True, exist_ok=True)
    with _writing(out / "diagram.svg") as file, _without_font_warnings():
        case.graph.draw(str(file))
    with _writing(out / "metrics.json") as file:
        file.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    if case.estimate not in result.series:
        return
    if "position" in result[case.estimate].leaves:
        with _writing(out / "navigation.png") as file:
            plot_navigation(result[case.estimate], flight.truth, file)
    else:  # such as an attitude alone
        with _writing(out / "outputs.png") as file:
            plot_result(result, file)


@contextmanager
def _writing(file: Path) -> Iterator[Path]:
    """Say what is written, and whether something was there before."""
    before = file.exists()
    with writes(file):
        yield file
    _err.print(f"{'replaced' if before else 'wrote'} {file}", markup=False)


def _first_line(doc: str) -> str:
    return doc.strip().partition("\n")[0].rstrip(".")


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=1, allow_nan=False))


_WORDS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "position_rmse_m": ("position RMSE [mm]", lambda v: f"{1e3 * v:.2f}"),
    "attitude_rmse_deg": ("attitude [deg]", lambda v: f"{v:.3f}"),
    "tilt_rmse_deg": ("tilt [deg]", lambda v: f"{v:.3f}"),
    "heading_rmse_deg": ("heading [deg]", lambda v: f"{v:.3f}"),
    "position_3sigma": ("position in 3 sigma", lambda v: f"{100 * v:.1f} %"),
    "tilt_3sigma": ("tilt in 3 sigma", lambda v: f"{100 * v:.1f} %"),
    "wall_s": ("time [s]", lambda v: f"{v:.2f}"),
    "setup_s": ("set-up [s]", lambda v: f"{v:.2f}"),
}
_HIDDEN = ("graph", "engine", "compared_ticks", "heading_3sigma")


def _table(rows: list[dict[str, Any]]) -> Table:
    """A column a key, for lists."""
    table = Table(box=None, pad_edge=False)
    for key in dict.fromkeys(k for row in rows for k in row):
        table.add_column(key)
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    return table


def _runs_table(rows: list[dict[str, Any]]) -> Table:
    """A column a run and a line a measure, so that it fits a terminal."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for row in rows:
        table.add_column(f"{row['graph']}\n{row['engine']}", justify="right")
    for key in dict.fromkeys(k for row in rows for k in row if k not in _HIDDEN):
        label = _WORDS[key][0] if key in _WORDS else key
        table.add_row(escape(label), *(_cell(key, row[key]) if key in row else "" for row in rows))
    return table


def _cell(key: str, value: Any) -> str:
    if key in _WORDS and value is not None:
        return _WORDS[key][1](value)
    return f"{value:g}" if isinstance(value, float) else str(value)
