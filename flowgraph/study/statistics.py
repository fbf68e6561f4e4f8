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
    level: float = 0.95, seed: int = 0,
) -> list[dict[str, Any]]:  # fmt: skip
    """Two studies run by run: for each graph of b beside that of a, and each metric, the ratio b / a.

    Runs are paired by seed and flight. A graph is compared with the one of its name, or, where each study has
    only one, with that. Where a pair of seed and flight stands for several runs of a study (a grid), these
    are paired by those `parameters` too that take the same values in both; of runs that even then cannot be
    told apart the median counts.

    Returns:
        For each, `pairs`, the `ratio` (the median of the pairs' ratios) and its bootstrap interval `low` to
        `high`, and `less`: the share of pairs in which b is less.

    Raises:
        DataError: where nothing can be paired.
    """
    table = []
    by = ["data", "seed"]
    if any(len({(r["graph"], r["data"], r["seed"]) for r in rows}) < len(rows) for rows in (a, b)):
        by += [n for n in dict.fromkeys(parameters) if {r.get(n) for r in a} == {r.get(n) for r in b}]
    graphs_a, graphs_b = ({r["graph"]: None for r in rows} for rows in (a, b))
    lone = len(graphs_a) == len(graphs_b) == 1
    for graph in graphs_b:
        other = next(iter(graphs_a)) if lone else graph
        for metric in metrics:
            ours = _by_run([r for r in b if r["graph"] == graph], by, metric)
            theirs = _by_run([r for r in a if r["graph"] == other], by, metric)
            pairs = [(theirs[k], y) for k, y in ours.items() if k in theirs]
            if not pairs:
                continue
            logs = np.log([y / x for x, y in pairs])
            low, high = bootstrap_median(logs, level=level, seed=seed)
            table.append(
                {
                    "graph": graph if graph == other else f"{graph} / {other}",
                    "metric": metric,
                    "pairs": len(pairs),
                    "ratio": float(np.exp(np.median(logs))),
                    "low": math.exp(low),
                    "high": math.exp(high),
                    "less": float(np.mean(logs < 0)),
                }
            )
    if not table:
        raise DataError(
            "these studies have no runs in common",
            path="--compare",
            expected="runs of the same flight with the same seed",
            got=f"{len(a)} and {len(b)} runs",
            fix="run both over the same data and seeds",
        )
    return table


def bootstrap_median(values: np.ndarray, *, level: float, seed: int) -> tuple[float, float]:
    """The percentile interval of a median, by drawing the values anew."""
    draw = np.random.default_rng(seed)
    drawn = draw.integers(0, len(values), (RESAMPLES, len(values)))
    medians = np.median(values[drawn], axis=1)
    low, high = np.quantile(medians, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def _by_run(rows: Sequence[Row], by: Sequence[str], metric: str) -> dict[tuple[Any, ...], float]:
    """The metric of each run, where it is positive, by what tells runs apart."""
    found = {k: finite_values(members, metric) for k, members in grouped(rows, by).items()}
    return {k: float(np.median(v)) for k, v in found.items() if len(v) and (v > 0).all()}
