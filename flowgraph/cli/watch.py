"""`watch`: a run in the browser while it goes on."""

from __future__ import annotations

from typing import Annotated

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import Data, Name, Seed, Settings, Truth, case_of, one_flight
from flowgraph.cli.terminal import err_console, out_console, reports_errors
from flowgraph.engines.live import Live
from flowgraph.engines.watched import simulate_watched
from flowgraph.errors import DeclarationError


@app.command()
@reports_errors
def watch(
    graph: Name,
    data: Data,
    truth: Truth = None,
    seed: Seed = 0,
    settings: Settings = None,
    speed: Annotated[
        float, typer.Option(min=0.0, help="How much faster than the events were; 0 for as fast as it can.")
    ] = 1.0,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of this machine; 0 for any that is free.")] = 0,
    wait: Annotated[bool, typer.Option(help="Wait for a browser, and at the end until it leaves.")] = True,
    live: Annotated[
        bool, typer.Option("--live", help="Push the events, through queues and a thread, as sensors do.")
    ] = False,
    engine: Annotated[str, typer.Option(help="With --live: python or c.")] = "python",
) -> None:
    """Run a graph on a flight and show in the browser what is on its wires, as it goes on."""
    from flowgraph.drawing.live import LiveView  # only who draws needs what draws

    if engine != "python" and not live:
        raise DeclarationError(
            "the Python engine alone shows what is on the wires as they go on", path="--engine",
            expected="python, or --live", got=engine, fix="add --live: events and outputs are shown then",
        )  # fmt: skip
    if live and not speed:
        raise DeclarationError(
            "events that are pushed have a pace", path="--speed", expected="more than 0 with --live", got="0",
            fix="leave out --live for a run as fast as it can be, or write a large --speed",
        )  # fmt: skip

    spec = one_flight(data) or ""

    def say(found: tuple[str, ...]) -> None:
        for words in found:
            err_console.print(f"note: {words}", markup=False)

    case, _ = case_of(graph, spec, settings, seed, truth, say)
    title = ", ".join([spec, *(settings or ()), f"seed {seed}"])
    inputs = None if live else case.inputs
    with LiveView(case.graph, inputs, title=title, speed=speed, port=port) as view:
        out_console.print(view.url, markup=False, highlight=False)
        if wait:
            err_console.print("open this address in a browser on this machine; Ctrl-C ends the run")
            view.wait(True)
        if live:
            with Live(
                case.graph, engine=engine, seed=seed, lateness="20ms", not_finite="keep", watcher=view
            ) as run:
                run.play(case.inputs, speed=speed)
            result = run.result()
        else:
            result = simulate_watched(case.graph, case.inputs, view, seed=seed)
        err_console.print(f"ended: {result.ticks} ticks", markup=False)
        say(case.remarks(result))
        if wait:
            view.wait(False)
