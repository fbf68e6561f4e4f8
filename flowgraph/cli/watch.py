"""`watch`: a run in the browser while it goes on."""

from __future__ import annotations

from typing import Annotated

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import Data, Name, Seed, Settings, Truth, case_of, one_flight
from flowgraph.cli.terminal import err_console, out_console, reports_errors
from flowgraph.engines.watched import simulate_watched


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
) -> None:
    """Run a graph on a flight and show in the browser what is on its wires, as it goes on."""
    from flowgraph.drawing.live import LiveServer, Sender, live_page  # only who draws needs what draws

    spec = one_flight(data) or ""

    def say(found: tuple[str, ...]) -> None:
        for words in found:
            err_console.print(f"note: {words}", markup=False)

    case, _ = case_of(graph, spec, settings, seed, truth, say)
    title = ", ".join([spec, *(settings or ()), f"seed {seed}"])
    with LiveServer(live_page(case.graph, case.inputs, title), port) as server:
        out_console.print(server.url, markup=False, highlight=False)
        if wait:
            err_console.print("open this address in a browser on this machine; Ctrl-C ends the run")
            server.wait(True)
        result = simulate_watched(
            case.graph, case.inputs, Sender(server, case.graph, case.inputs, speed), seed=seed
        )
        err_console.print(f"ended: {result.ticks} ticks", markup=False)
        say(case.remarks(result))
        if wait:
            server.wait(False)
