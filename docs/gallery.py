"""The gallery: each filter's diagram, its equation in words, and how well it does, measured at this build.

A filter is flown on the first of the examples that fits it, for some seconds, with the seed 0, in Python. The
command that prints the same figures stands beside them.
"""

from __future__ import annotations

import inspect
from collections.abc import Collection, Mapping

from flowgraph import FlowgraphError, find_graph, simulate
from flowgraph.cli.options import EXAMPLES, case_of
from flowgraph.data.registry import graph_names

SECONDS = 6
WORDS = {
    "position_rmse_m": ("position", 1e3, "mm"),
    "attitude_rmse_deg": ("attitude", 1.0, "°"),
    "tilt_rmse_deg": ("tilt", 1.0, "°"),
    "velocity_rmse_mps": ("velocity", 1e3, "mm/s"),
}
"""Of the figures that are shown: their word, factor and unit. Others go by their own names."""


def measured(name: str) -> tuple[str, dict[str, float]] | None:
    """The command that was run and what it found; None for a graph that no example fits."""
    for spec, more in EXAMPLES:
        settings = [f"{key}={value}" for key, value in more.items()]
        for asked in ([*settings, f"duration={SECONDS}"], settings):
            try:
                case, _ = case_of(name, spec, asked, 0)
                found = case.score(simulate(case.graph, case.inputs, seed=0))
            except FlowgraphError:
                continue
            command = f"flowgraph run {name} --data {spec} " + " ".join(f"--set {s}" for s in asked)
            return command.strip(), dict(found)
    return None


def figures(found: Mapping[str, float]) -> str:
    """The errors among the figures of a run, in words."""
    known = [
        f"{word} {factor * found[key]:.3g} {unit}"
        for key, (word, factor, unit) in WORDS.items()
        if key in found
    ]
    if not known:
        known = [
            f"{key.removesuffix('_m').replace('_', ' ')} {value:.3g}"
            for key, value in found.items()
            if "rmse" in key
        ]
    return ", ".join(known[:4]) or "it has no figure of error"


def gallery(drawn: Collection[str]) -> str:
    """A section a filter."""
    text: list[str] = []
    for name in graph_names():
        doc = (inspect.getdoc(find_graph(name).function) or "").split("\n\n")[0].replace("\n", " ")
        text += [f"## [{name}](graphs.md#{name})", doc]
        if name in drawn:
            text.append(
                f"[![The diagram of {name}](generated/{name}.svg){{ loading=lazy }}](generated/{name}.svg)"
            )
        found = measured(name)
        if found is not None:
            text.append(f"Root mean square errors: **{figures(found[1])}**.\n\n```sh\n{found[0]}\n```")
        else:
            text.append("None of the simulated flights of a few seconds fits it.")
    return "\n\n".join(text)
