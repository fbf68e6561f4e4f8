"""The pictures of a report, twice: as PNG for paper and files, and as charts that a browser draws.

Each kind is one idea: boxes of a figure by data set and filter, a figure against a parameter, and the ratios
of two studies. What a chart marks is what its picture shows; a browser reads each mark aloud, and leads from
a run to its view where the page has it.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from flowgraph.drawing import canvas
from flowgraph.drawing.report_page import axis, chart, series
from flowgraph.study.statistics import finite_values, grouped

_FEW = 10  # values of a box that are drawn as points too

Rows = Sequence[Mapping[str, Any]]


class Picture(NamedTuple):
    """One picture of a report: its title, the name of its file, and both ways to draw it."""

    title: str
    name: str
    png: Callable[[], bytes]
    chart: Callable[[Mapping[str, int]], dict[str, Any]]
    """From the runs on the page, by key of a row, to the chart."""


def pictures(rows: Rows, names: Sequence[str], metric: str) -> list[Picture]:
    """Those of a study: boxes by data set and filter, and against each parameter that is a number."""
    found = [
        Picture(
            f"{metric} by data set and filter", "boxes", lambda: _png(lambda f: _draw_boxes(f, rows, metric)),
            lambda shown: _boxes(rows, metric, shown),
        )
    ]  # fmt: skip
    for name in names:
        values = {r.get(name) for r in rows if r.get(name) is not None}
        if len(values) > 1 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            file = "against-" + "".join(c if c.isalnum() else "-" for c in name)[:60]
            file += f"-{len(found)}" if file in [p.name for p in found] else ""
            found.append(
                Picture(
                    f"{metric} against {name}", file,
                    lambda name=name: _png(lambda f: _draw_against(f, rows, name, metric)),  # type: ignore[misc]
                    lambda shown, name=name: _against(rows, name, metric, shown),  # type: ignore[misc]
                )
            )  # fmt: skip
    return found


def ratios(table: Rows) -> Picture:
    """That of a comparison: for each figure the ratio of the second study to the first, with its interval."""
    return Picture(
        "Ratios", "ratio", lambda: _png(lambda f: _draw_ratios(f, table)), lambda _: _ratios(table)
    )


def _png(draw: Callable[[Any], None]) -> bytes:
    sink = io.BytesIO()
    with canvas.plain_matplotlib({"text.parse_math": False}):  # a dollar in a name is a dollar
        figure = canvas.new_figure(9.0, 4.5)
        draw(figure)
        figure.savefig(sink, format="png", dpi=110)
    return sink.getvalue()


# -- boxes ---------------------------------------------------------------------------------------------


Boxes = list[tuple[int, float, list[Mapping[str, Any]]]]
"""Each box as the number of its graph, its place, and its rows."""


def _placed(rows: Rows, metric: str) -> tuple[list[str], list[str], float, Boxes]:
    """The flights, the graphs, the width of a box, and the boxes."""
    graphs, flights = ([str(x) for x in dict.fromkeys(r[n] for r in rows)] for n in ("graph", "data"))
    width = 0.8 / len(graphs)
    found: Boxes = []
    for k, graph in enumerate(graphs):
        for n, data in enumerate(flights):
            own = [r for r in rows if r["graph"] == graph and r["data"] == data]
            own = [r for r in own if len(finite_values([r], metric))]
            if own:
                found.append((k, n - 0.4 + width * (k + 0.5), own))
    return flights, graphs, width, found


def _draw_boxes(figure: Any, rows: Rows, metric: str) -> None:
    """A box a filter at each data set: quartiles, whiskers to the furthest within 1.5 of their distance.

    Of a few runs each is a point as well, for the box of one is only a line.
    """
    ax = figure.add_subplot()
    flights, graphs, width, boxes = _placed(rows, metric)
    for k, graph in enumerate(graphs):
        places = [x for g, x, _ in boxes if g == k]
        values = [finite_values(own, metric) for g, _, own in boxes if g == k]
        if values:
            colour = f"C{k}"
            ax.boxplot(
                values, positions=places, widths=0.85 * width, patch_artist=True,
                flierprops={"markersize": 3},
                boxprops={"facecolor": colour, "alpha": 0.5}, medianprops={"color": "black"},
            )  # fmt: skip
            few = [
                (x, v) for x, found in zip(places, values, strict=True) if len(found) <= _FEW for v in found
            ]
            ax.plot([x for x, _ in few], [v for _, v in few], "o", color=colour, markersize=5)
        ax.plot([], [], color=f"C{k}", linewidth=6, alpha=0.5, label=graph)
    _log_where_wide(ax.yaxis, finite_values(rows, metric))
    ax.set_xticks(range(len(flights)), [short(f) for f in flights], rotation=25 if len(flights) > 3 else 0)
    ax.set_xlim(-0.6, len(flights) - 0.4)
    ax.set_ylabel(metric)
    ax.legend()


def _boxes(rows: Rows, metric: str, shown: Mapping[str, int]) -> dict[str, Any]:
    flights, graphs, width, boxes = _placed(rows, metric)
    lines = []
    for k, graph in enumerate(graphs):
        mine = [(x, own, _five(finite_values(own, metric))) for g, x, own in boxes if g == k]
        told = [
            f"{graph}, {len(own)} runs: median {five[2]:.4g}, quartiles {five[1]:.4g} and {five[3]:.4g}"
            for _, own, five in mine
        ]
        lines.append(
            series(graph, "box", [x for x, _, _ in mine], [five[2] for _, _, five in mine],
                   boxes=[five for _, _, five in mine], words=told, width=width)
        )  # fmt: skip
    for k in range(len(graphs)):  # single runs over the boxes, in their colours
        points = []
        for g, x, own in boxes:
            values, five = finite_values(own, metric), _five(finite_values(own, metric))
            every = len(values) <= _FEW
            points += [
                (x, float(v), r) for r, v in zip(own, values, strict=True)
                if g == k and (every or not five[0] <= v <= five[4] or r.get("key") in shown)
            ]  # fmt: skip
        lines[k] |= {"dots": [_dot(x, v, r, shown) for x, v, r in points]}
    log = _is_wide(finite_values(rows, metric))
    return chart(f"{metric} by data set and filter", axis("", names=[short(f) for f in flights]),
                 axis(metric, log=log), lines, words="Boxes reach from quartile to quartile.")  # fmt: skip


def _dot(x: float, y: float, row: Mapping[str, Any], shown: Mapping[str, int]) -> dict[str, Any]:
    words = f"{row['graph']} on {row['data']}, seed {row['seed']}: {y:.4g}"
    return {"x": x, "y": y, "words": words, "run": shown.get(str(row.get("key")))}


def _five(values: np.ndarray) -> list[float]:
    """The ends of the whiskers, the quartiles and the median."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    inside = values[(values >= low - 1.5 * (high - low)) & (values <= high + 1.5 * (high - low))]
    return [float(v) for v in (inside.min(), low, middle, high, inside.max())]


# -- against a parameter -------------------------------------------------------------------------------


def _by_value(rows: Rows, name: str, metric: str) -> list[tuple[str, dict[float, np.ndarray]]]:
    """For each filter and flight its label, and by value of a parameter the figures."""
    found = []
    for (graph, data), members in grouped(rows, ["graph", "data"]).items():
        points = {
            float(x): finite_values(g, metric)
            for (x,), g in grouped(members, [name]).items()
            if x is not None
        }
        if points := {x: v for x, v in sorted(points.items()) if len(v)}:
            found.append((f"{graph}, {short(data)}", points))
    return found


def _is_single(points: Mapping[float, np.ndarray]) -> bool:
    """Whether values are so many, and runs of each so few, that each run is a point."""
    return len(points) > 30 and max(map(len, points.values())) <= 3


def _draw_against(figure: Any, rows: Rows, name: str, metric: str) -> None:
    """Median and quartiles at each value of a parameter; each run as a point where the values are many."""
    ax = figure.add_subplot()
    for k, (label, points) in enumerate(_by_value(rows, name, metric)):
        if _is_single(points):
            every = [(a, b) for a, v in points.items() for b in v]
            ax.plot(*zip(*every, strict=True), ".", color=f"C{k}", alpha=0.6, label=label)
            continue
        low, middle, high = (
            np.array([np.quantile(v, q) for v in points.values()]) for q in (0.25, 0.5, 0.75)
        )
        ax.plot(list(points), middle, "o-", color=f"C{k}", label=label)
        ax.fill_between(list(points), low, high, color=f"C{k}", alpha=0.2)
    values = [r[name] for r in rows if isinstance(r.get(name), int | float)]
    _log_where_wide(ax.xaxis, np.array(values, dtype=float), wide=9.0)
    _log_where_wide(ax.yaxis, finite_values(rows, metric))
    ax.set_xlabel(name)
    ax.set_ylabel(metric)
    if ax.get_legend_handles_labels()[1]:
        ax.legend()


def _against(rows: Rows, name: str, metric: str, shown: Mapping[str, int]) -> dict[str, Any]:
    lines = []
    for label, points in _by_value(rows, name, metric):
        if _is_single(points):
            every = [(a, float(b)) for a, v in points.items() for b in v]
            told = [f"{label}, {name} {a:.4g}: {b:.4g}" for a, b in every]
            lines.append(series(label, "dots", [a for a, _ in every], [b for _, b in every], words=told))
            continue
        fives = [[float(q) for q in np.quantile(v, [0.25, 0.5, 0.75])] for v in points.values()]
        told = [
            f"{label}, {name} {a:.4g}: median {five[1]:.4g} of {len(v)} runs, {five[0]:.4g} to {five[2]:.4g}"
            for (a, v), five in zip(points.items(), fives, strict=True)
        ]
        lines.append(series(label, "line", list(points), [five[1] for five in fives],
                            ends=[(five[0], five[2]) for five in fives], words=told))  # fmt: skip
    numbers = np.array([r[name] for r in rows if isinstance(r.get(name), int | float)], dtype=float)
    return chart(f"{metric} against {name}", axis(name, log=_is_wide(numbers, 9.0)),
                 axis(metric, log=_is_wide(finite_values(rows, metric))), lines,
                 words="Medians, in bands from quartile to quartile.")  # fmt: skip


# -- ratios --------------------------------------------------------------------------------------------


def _draw_ratios(figure: Any, table: Rows) -> None:
    ax = figure.add_subplot()
    for k, line in enumerate(table):
        ax.plot([line["low"], line["high"]], [k, k], "-", color="C0", linewidth=3, alpha=0.5)
        ax.plot(line["ratio"], k, "o", color="C0")
    ax.axvline(1.0, color="black", linewidth=1)
    ax.set_yticks(range(len(table)), [f"{line['graph']}: {line['metric']}" for line in table])
    ax.invert_yaxis()
    ax.set_xlabel("ratio")


def _ratios(table: Rows) -> dict[str, Any]:
    names = [f"{line['graph']}: {line['metric']}" for line in table]
    told = [
        f"{name}: {line['ratio']:.4g}, {line['low']:.4g} to {line['high']:.4g}"
        for name, line in zip(names, table, strict=True)
    ]
    one = series("ratio, with its 95 % interval", "dots", [line["ratio"] for line in table],
                 list(range(len(table))), ends=[(line["low"], line["high"]) for line in table],
                 words=told)  # fmt: skip
    return chart("Ratios", axis("ratio"), axis("", names=names), [one], marks=[{"name": "equal", "x": 1.0}])


def _is_wide(values: np.ndarray, wide: float = 30.0) -> bool:
    return bool(len(values) and values.min() > 0 and values.max() > wide * values.min())


def _log_where_wide(axis: Any, values: np.ndarray, wide: float = 30.0) -> None:
    if _is_wide(values, wide):
        getattr(axis.axes, f"set_{axis.axis_name}scale")("log")


def short(data: str) -> str:
    """The end of a flight's name, which tells it from others; from a folder on where there is one."""
    if len(data) <= 24:
        return data
    name = data.rstrip("/").rpartition("/")[2]
    return "…/" + name if name != data and len(name) <= 30 else "…" + data[-23:]


__all__ = ["Picture", "pictures", "ratios", "short"]
