"""Statistics of a study's table: summaries by setting, and paired comparisons of two studies.

The middle of a metric is its median and its spread the quartiles, for errors of filters have long tails. Two
studies are compared run by run, on the same flight with the same seed: the ratio of each pair is free of how
hard the flight was. Its interval is a bootstrap over pairs (B. Efron, R. Tibshirani, "An Introduction to the
Bootstrap", 1993, ch. 13: percentiles).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.errors import DataError

Row = Mapping[str, Any]
QUANTILES = (0.25, 0.5, 0.75, 0.95)
_NAMES = ("graph", "data", "seed", "error", "key", "ticks", "compared_ticks")
RESAMPLES = 2000


def metrics_of(
    rows: Sequence[Row], parameters: Iterable[str], chosen: Sequence[str] | None = None
) -> list[str]:
    """The columns that are measures: numbers, and neither names, parameters nor times."""
    other = {*_NAMES, *parameters}
    found = dict.fromkeys(
        n
        for row in rows
        for n, v in row.items()
        if n not in other and not n.endswith("_s") and isinstance(v, int | float)
    )
    return [n for n in chosen if n in found] if chosen else list(found)


def finite_values(rows: Sequence[Row], metric: str) -> np.ndarray:
    """The values of a metric in the runs that have it and did not fail."""
    values = [row.get(metric) for row in rows if row.get("error") is None]
    numbers = np.array([v for v in values if isinstance(v, int | float)], dtype=float)
    return np.asarray(numbers[np.isfinite(numbers)])


def grouped(rows: Sequence[Row], by: Sequence[str]) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by their values in some columns, in the order in which these first come."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row.get(n) for n in by), []).append(row)
    return found


def summarised(
    rows: Sequence[Row],
    parameters: Sequence[str],
    chosen: Sequence[str] | None = None,
    *,
    most: int | None = None,
) -> list[dict[str, Any]]:
    """A row a setting (graph, flight, parameters): how many runs, how many failed, and each metric as
    "median (quartile .. quartile)", or the one value; of the first `most` metrics."""
    by = ["graph", "data", *parameters]
    names = metrics_of(rows, parameters, chosen)[:most]
    table = []
    for setting, members in grouped(rows, by).items():
        line: dict[str, Any] = {n: "" if v is None else v for n, v in zip(by, setting, strict=True)}
        line["runs"] = len(members)
        line["failed"] = sum(r.get("error") is not None for r in members)
        for name in names:
            values = finite_values(members, name)
            low, middle, high = np.quantile(values, (0.25, 0.5, 0.75)) if len(values) else [math.nan] * 3
            spread = f" ({low:.4g} .. {high:.4g})" if len(values) > 1 else ""
            line[name] = f"{middle:.4g}{spread}" if len(values) else "-"
        table.append(line)
    return table


def quantiles(
    rows: Sequence[Row], parameters: Sequence[str], chosen: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """A row a setting and metric, with the number of runs and the quantiles as numbers."""
    by = ["graph", "data", *parameters]
    table = []
    for setting, members in grouped(rows, by).items():
        for name in metrics_of(rows, parameters, chosen):
            values = finite_values(members, name)
            if not len(values):
                continue
            line = dict(zip(by, setting, strict=True))
            line.update(
                metric=name, runs=len(values), failed=sum(r.get("error") is not None for r in members)
            )
            line.update({f"q{round(100 * q)}": float(np.quantile(values, q)) for q in QUANTILES})
            table.append(line)
    return table


def compared(
    a: Sequence[Row], b: Sequence[Row], metrics: Sequence[str], parameters: Iterable[str] = (), *,
    flight: Iterable[str] = (), level: float = 0.95, seed: int = 0,
) -> list[dict[str, Any]]:  # fmt: skip
    """Two studies run by run: for each graph of b beside that of a, and each metric, the ratio b / a.

    Runs are paired by seed and flight. A graph is compared with the one of its name, or, where each study has
    only one, with that. Where a pair of seed and flight stands for several runs of a study (a grid), these
    are paired by those `parameters` too that take the same values in both; of runs that even then cannot be
    told apart the median counts.

    Args:
        a, b: rows of the tables.
        metrics: columns.
        parameters: the columns that are settings.
        flight: those of them that are settings of the flight, as its duration: another value is another
            flight.
        level: of the interval.
        seed: of its draws.

    Returns:
        For each, `pairs`, the `ratio` (the median of the pairs' ratios) and its bootstrap interval `low` to
        `high`, and `less`: the share of pairs in which b is less. What the ratio leaves out is counted, in
        runs of both studies: `failed`, `unusable` (zero, negative or no number, of which there is no ratio)
        and `unpaired` (the other study has no such run that can be used).

    Raises:
        DataError: where nothing can be paired, saying what was left out and which settings differ.
    """
    table = []
    by = ["data", "seed", *dict.fromkeys(flight)]
    if any(len({(r["graph"], *(r.get(n) for n in by)) for r in rows}) < len(rows) for rows in (a, b)):
        by += [
            n for n in dict.fromkeys(parameters)
            if n not in by and {r.get(n) for r in a} == {r.get(n) for r in b}
        ]  # fmt: skip
    graphs_a, graphs_b = ({r["graph"]: None for r in rows} for rows in (a, b))
    lone = len(graphs_a) == len(graphs_b) == 1
    for graph in graphs_b:
        other = next(iter(graphs_a)) if lone else graph
        pair = [r for r in b if r["graph"] == graph], [r for r in a if r["graph"] == other]
        for metric in metrics:
            ours, theirs = (_by_run(rows, by, metric) for rows in pair)
            both = [k for k in ours if k in theirs]
            if not both:
                continue
            logs = np.log([float(np.median(ours[k]) / np.median(theirs[k])) for k in both])
            low, high = bootstrap_median(logs, level=level, seed=seed)
            usable = [len(v) for found in (ours, theirs) for v in found.values()]
            paired = [len(found[k]) for found in (ours, theirs) for k in both]
            failed = sum(r.get("error") is not None for rows in pair for r in rows)
            table.append(
                {
                    "graph": graph if graph == other else f"{graph} / {other}",
                    "metric": metric,
                    "pairs": len(both),
                    "ratio": float(np.exp(np.median(logs))),
                    "low": math.exp(low),
                    "high": math.exp(high),
                    "less": float(np.mean(logs < 0)),
                    "failed": failed,
                    "unusable": sum(map(len, pair)) - failed - sum(usable),
                    "unpaired": sum(usable) - sum(paired),
                }
            )
    if not table:
        apart = differing(a, b, parameters)
        said = [
            f"{sum(r.get('error') is not None for r in rows)} of {len(rows)} runs failed" for rows in (a, b)
        ]
        raise DataError(
            "these studies have no runs in common",
            path="--compare",
            expected="runs of the same flight, at the same settings of it, with the same seed",
            got="; ".join([*said, *(f"{n}: {x} and {y}" for n, (x, y) in apart.items())]),
            fix="run both over the same data, seeds and settings of the flight, or name those settings in which"
            " runs of a pair may differ: --across NAME",
        )
    return table


def differing(a: Sequence[Row], b: Sequence[Row], parameters: Iterable[str]) -> dict[str, tuple[str, str]]:
    """The settings that do not take the same values in two studies, and the values of each as text."""
    found = {}
    for name in dict.fromkeys(parameters):
        values = [list(dict.fromkeys(r.get(name) for r in rows)) for rows in (a, b)]
        if set(values[0]) != set(values[1]):
            found[name] = (_few(values[0]), _few(values[1]))
    return found


def _few(values: Sequence[Any], most: int = 6) -> str:
    """Some values as text; None is what is not set."""
    shown = ["not set" if v is None else f"{v:g}" if isinstance(v, float) else str(v) for v in values[:most]]
    more = f", ... ({len(values)} values)" if len(values) > most else ""
    return ", ".join(shown) + more


def bootstrap_median(values: np.ndarray, *, level: float, seed: int) -> tuple[float, float]:
    """The percentile interval of a median, by drawing the values anew."""
    draw = np.random.default_rng(seed)
    drawn = draw.integers(0, len(values), (RESAMPLES, len(values)))
    medians = np.median(values[drawn], axis=1)
    low, high = np.quantile(medians, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def _by_run(rows: Sequence[Row], by: Sequence[str], metric: str) -> dict[tuple[Any, ...], np.ndarray]:
    """The values of a metric that have a logarithm, by what tells runs apart; none where there are none."""
    found = {k: finite_values(members, metric) for k, members in grouped(rows, by).items()}
    return {k: v[v > 0] for k, v in found.items() if (v > 0).any()}
