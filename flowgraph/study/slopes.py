"""The likelihood of a recording with its slope, in one run.

The settings of a graph are the real constants of its pipeline and the initial values of its registers, and
those of a flight are the values of its streams. How these change with a parameter is found by building the
case twice more, which runs nothing; how the innovations change with them, by playing the pipeline with its
own forward derivatives (`pipeline.sensitivity`) once. With the residual r of covariance S, and their changes
dr and dS,

    d [ (r^T S^-1 r + log det S) / 2 ] = r^T S^-1 dr - 1/2 r^T S^-1 dS S^-1 r + 1/2 tr(S^-1 dS)

A parameter that changes the program, or when something happens (a time offset), has no such slope: it is then
left to differences of whole runs.

Source: N. Gupta and R. Mehra, "Computational aspects of maximum likelihood estimation and reduction in
sensitivity function calculations", IEEE Trans. Automatic Control 19(6), 1974.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.registry import Case
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.engines.contract import PipelineEngine
from flowgraph.engines.options import RunOptions
from flowgraph.engines.playback import play
from flowgraph.engines.registry import find_engine
from flowgraph.engines.subject import LoadedPipeline
from flowgraph.language.graph import Graph, join_states
from flowgraph.pipeline.digests import settings_of, structure
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.pipeline import Pipeline, type_of_leaves
from flowgraph.pipeline.sensitivity import CHANGE, sensitivity
from flowgraph.study.lifting import CONSTANTS, lifted
from flowgraph.types import flatten, leaves_of, unflatten

__all__ = ["Slopes", "surprise_and_slope"]

Starts = dict[tuple[str, str], np.ndarray]


class Slopes:
    """Plays cases with their derivatives; pipelines that are alike are differentiated once.

    Args:
        engine: that plays them.
    """

    def __init__(self, engine: str) -> None:
        self.engine = engine
        self._made: list[tuple[Any, Pipeline]] = []

    @property
    def possible(self) -> bool:
        """Whether the engine plays pipelines at all."""
        return isinstance(find_engine(self.engine), PipelineEngine)

    def of(
        self, case: Case, ends: Sequence[tuple[Case, Case]], widths: Sequence[float], seed: int
    ) -> tuple[float, float, np.ndarray]:
        """The surprise of a case, how many values it is of, and its slope (p,); NaN where it has none.

        Args:
            case: at the point.
            ends: for each parameter the case beyond the point and the one before it.
            widths: how far these two are apart.
            seed: of the run.

        Raises:
            FlowgraphError: as the run does.
        """
        base = lower(case.graph)
        if base.host:
            return math.nan, 0.0, np.full(len(ends), np.nan)
        known = structure(base)
        streams, starts = _streams(case), _starts(case.graph)
        smooth: list[int] = []
        changes: list[tuple[Starts, Starts]] = []
        for k, (after, before) in enumerate(ends):
            found = None
            if all(structure(lower(c.graph)) == known for c in (after, before)):
                found = self._changes(case, after, before, widths[k])
            if found is not None:
                smooth.append(k)
                changes.append(found)
        slope = np.full(len(ends), np.nan)
        if not smooth:
            return math.nan, 0.0, slope
        cells = _stacked(starts, [c for c, _ in changes])
        values = {(n, f): a for n, series in streams.items() for f, a in series.leaves.items()}
        moved = _stacked(values, [d for _, d in changes])
        wanted = [p.name for p in base.outputs if {"residual", "covariance"} <= {x.name for x in p.leaves}]
        which = (len(smooth), frozenset(cells), frozenset(moved), known)
        made = self._differentiated(case.graph, which, wanted)
        started = starts | {(path, name + CHANGE): a for (path, name), a in cells.items()}
        first = [started.get((r.path, c.name), c.reset) for r in made.registers for c in r.cells]
        subject = LoadedPipeline(made, first)  # other numbers in one program, which is compiled once
        result = play(subject, _given(made, streams, moved), RunOptions(engine=self.engine, seed=seed))
        total, count, d = surprise_and_slope(result, len(smooth))
        slope[smooth] = d / max(count, 1.0)
        return total / count if count else math.nan, count, slope

    def _changes(self, case: Case, after: Case, before: Case, width: float) -> tuple[Starts, Starts] | None:
        """How registers at the start and streams change; None where a time does."""
        a, b = _streams(after), _streams(before)
        inputs: Starts = {}
        for name, series in _streams(case).items():
            same = all(np.array_equal(s[name].time, series.time) for s in (a, b))
            if not same:
                return None
            for field, right in a[name].leaves.items():
                left = b[name].leaves[field]
                if left is not right and not np.array_equal(left, right, equal_nan=True):
                    if right.dtype.kind != "f" or (np.isnan(left) != np.isnan(right)).any():
                        return None
                    inputs[name, field] = np.nan_to_num((right - left) / width)
        one, other = _starts(after.graph), _starts(before.graph)
        cells = {k: (one[k] - other[k]) / width for k in one if not np.array_equal(one[k], other[k])}
        return cells, inputs

    def _differentiated(self, graph: Graph, which: Any, wanted: list[str]) -> Pipeline:
        for other, made in self._made:
            if other == which:
                return made
        p, cells, moved, _ = which
        fresh = sensitivity(lower(lifted(graph)), p, cells, wanted, moved)
        self._made = [*self._made[-3:], (which, fresh)]
        return fresh


def _streams(case: Case) -> dict[str, Series]:
    given = case.inputs.streams if isinstance(case.inputs, Flight) else case.inputs
    return {name: given[name] for name in case.graph.sources}


def _starts(graph: Graph) -> Starts:
    """What a run starts from, real constants as `lifted` has them: real arrays by register and cell."""
    joins = join_states(graph)
    found: Starts = {}
    for index, node in graph.registers:
        if node.role == "stamp" or index in joins:
            continue
        for (name, t), leaf in zip(leaves_of(node.type), flatten(node.initial, node.type), strict=True):
            if t.dtype == "real":
                found[node.path, name] = np.asarray(leaf, dtype=float)
    constants = settings_of(lower(graph))
    return found | {(f"{CONSTANTS}{n}", "value"): np.asarray(a, dtype=float) for n, a in constants.items()}


def _stacked(base: Starts, changes: Sequence[Starts]) -> Starts:
    """The changes (p, *shape) of what changes along any direction."""
    keys = dict.fromkeys(k for change in changes for k in change)
    return {k: np.stack([c.get(k, np.zeros(base[k].shape)) for c in changes]) for k in keys}


def _given(pipeline: Pipeline, streams: Mapping[str, Series], moved: Starts) -> dict[str, Any]:
    """The streams as inputs of the pipeline, with the changes (n, p, *shape) of those that have any."""
    found = {}
    for port in pipeline.inputs:
        series = streams[port.name]
        leaves = dict(series.leaves)
        for (name, field), change in moved.items():
            if name == port.name:
                leaves[field + CHANGE] = np.moveaxis(change, 0, 1)
        type_ = type_of_leaves(port.type, port.leaves)
        values = unflatten(type_, iter([leaves[leaf.name] for leaf in port.leaves]))
        found[port.name] = Series(series.time, values, type=type_, name=port.name, gaps=series.gaps)
    return found


def surprise_and_slope(result: Result, p: int) -> tuple[float, float, np.ndarray]:
    """The negative log-likelihood of all innovations, how many values they are, and the slope (p,) of it."""
    total, count, slope = 0.0, 0.0, np.zeros(p)
    for series in result.series.values():
        leaves = series.leaves
        if not {"residual", "covariance"} <= set(leaves) or not len(series):
            continue
        r, S = leaves["residual"], leaves["covariance"]
        sign, size = np.linalg.slogdet(S)
        if not (sign > 0).all() or not np.isfinite(r).all():
            return math.inf, 1.0, np.zeros(p)
        parts = leaves["parts"] if "parts" in leaves else np.full(len(r), float(r.shape[-1]))
        weighed = np.linalg.solve(S, r[..., None])[..., 0]
        total += 0.5 * float(((r * weighed).sum(-1) + size + parts * math.log(2.0 * math.pi)).sum())
        count += float(parts.sum())
        dr, dS = leaves["residual" + CHANGE], leaves["covariance" + CHANGE]
        outer = np.linalg.inv(S) - weighed[:, :, None] * weighed[:, None, :]
        slope += np.einsum("ni,npi->p", weighed, dr) + 0.5 * np.einsum("nij,npji->p", outer, dS)
    return total, count, slope
