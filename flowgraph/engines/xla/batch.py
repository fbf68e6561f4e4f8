"""Many runs in XLA: chunks of one size, each through one compiled scan under `vmap`.

The runs of a batch share their ticks, and of the outputs only what is kept is computed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.batch import Runs
from flowgraph.data.tape import Tape
from flowgraph.engines.contract import ManyOutcome, ManyRuns, real_leaves
from flowgraph.engines.options import RunOptions
from flowgraph.engines.xla.devices import Devices, chosen_device
from flowgraph.engines.xla.scan import Chunk, Scan, bytes_per_tick
from flowgraph.errors import DataError
from flowgraph.pipeline.pipeline import Pipeline, Port
from flowgraph.recorder.random import seed_words

Outputs = list[tuple[np.ndarray, list[np.ndarray]]]
"""Of a chunk, for each output a mask and its leaves."""

_TICKS_AT_ONCE = 512
_CHUNK_BYTES = 64 * 2**20


def vectorised(runs: ManyRuns, passes: tuple[str, ...], options: RunOptions) -> ManyOutcome:
    """Play the runs, `options.runs_at_once` in a call, or a few more where devices share them."""
    pipeline, first, seeds = _pruned(runs.pipeline, runs.keep), runs.first, runs.seeds
    devices = Devices(runs.pipeline, options.shard) if options.shard else None
    size, real = options.runs_at_once, np.dtype(options.dtype)
    if devices is not None:
        size = devices.rounded(size)
    keys = first.patterns
    per_tick = size * bytes_per_tick(pipeline)
    ticks = max(1, min(_TICKS_AT_ONCE, len(first.time), _CHUNK_BYTES // max(per_tick, 1)))
    shard = tuple((options.shard or {}).items())
    which = (keys, real.name, ticks, size, runs.shared, repr(runs.keep), passes, chosen_device(), shard)
    # they live as long as the pipeline does
    compiled: dict[Any, Scan] = runs.pipeline.__dict__.setdefault("_batched", {})
    if which not in compiled:
        compiled[which] = Scan(
            pipeline, keys, real, ticks, runs=size, shared=runs.shared, passes=passes, devices=devices
        )
    scan = compiled[which]
    columns_first = _columns([first], True, real)
    chunks: list[list[Outputs]] = []
    wall = 0.0
    for n, members in enumerate(_chunks(len(seeds), size)):
        columns = columns_first if runs.shared else _columns(_tapes(runs, members), False, real)
        last = cells = _cells_of(runs, members)
        words = np.stack([seed_words(seeds[k]) for k in members])
        scan.compile(cells, words, columns)
        start = perf_counter()
        parts = []
        for part, after in scan(cells, words, first.time, first.key, columns, first.rows):
            parts.append(_without_absent(part))
            last = after
        wall += perf_counter() - start
        chunks.append(parts)
        done = min((n + 1) * size, len(seeds))
        for row in range(done - n * size):
            runs.finish(members[row], [cell[row] for cell in last])
        if options.progress is not None:
            options.progress.update(done, 0)
    series = {
        port.name: _collected(port, k, first.time, chunks, len(seeds))
        for k, port in enumerate(pipeline.outputs)
    }
    return ManyOutcome(series, len(first.time), wall)


def _pruned(pipeline: Pipeline, kept: Mapping[str, list[str]]) -> Pipeline:
    ports = tuple(
        replace(port, leaves=tuple(leaf for leaf in port.leaves if leaf.name in kept[port.name]))
        for port in pipeline.outputs
        if port.name in kept
    )
    return replace(pipeline, outputs=ports)


def _chunks(count: int, size: int) -> Iterator[tuple[int, ...]]:
    """Places of runs in chunks of one size; the last is filled up with its last run."""
    for start in range(0, count, size):
        part = tuple(range(start, min(start + size, count)))
        yield part + (part[-1],) * (size - len(part))


def _tapes(runs: ManyRuns, members: tuple[int, ...]) -> list[Tape]:
    made: dict[int, Tape] = {}
    for run in members:
        if run not in made:
            made[run] = runs.tape(run)
            _same_ticks(runs, made[run], runs.seeds[run])
    return [made[run] for run in members]


def _same_ticks(runs: ManyRuns, other: Tape, seed: int) -> None:
    first = runs.first
    if np.array_equal(first.time, other.time) and np.array_equal(first.key, other.key):
        return
    raise DataError(
        "runs in one batch must have their events at the same times",
        path=f"{runs.name}, seed {seed}",
        expected=f"the {len(first.time)} ticks of the first run",
        got=f"{len(other.time)} ticks, or others",
        fix='run them one by one: engine="python", or a simulate(...) each',
    )


def _cells_of(runs: ManyRuns, members: tuple[int, ...]) -> list[np.ndarray]:
    """Register cells with a leading axis of runs."""
    made = {run: runs.cells(run) for run in set(members)}
    return [np.stack(column) for column in zip(*(made[run] for run in members), strict=True)]


def _columns(tapes: list[Tape], shared: bool, real: Any) -> list[list[np.ndarray]]:
    """The leaves of each input; with a leading axis of runs where inputs differ."""
    made = [[real_leaves(s, real) for s in t.series] for t in tapes]
    if shared:
        return made[0]
    return [[np.stack(leaves) for leaves in zip(*ports, strict=True)] for ports in zip(*made, strict=True)]


def _without_absent(part: Chunk) -> Outputs:
    """The outputs, without the ticks at which one is known to be absent in all runs."""
    found = []
    for mask, leaves in part.outputs:
        there = np.ones(part.ticks, bool) if mask is None else mask
        whole = there.ndim > 1 or there.all()
        found.append((there, leaves if whole else [leaf[:, there] for leaf in leaves]))
    return found


def _collected(port: Port, k: int, time: np.ndarray, chunks: list[list[Outputs]], runs: int) -> Runs:
    """One output of all runs, at the ticks in which it is present in any."""

    def joined(pick: Callable[[Outputs], np.ndarray]) -> np.ndarray:
        rows = [np.concatenate([pick(part) for part in parts], axis=1) for parts in chunks]
        return (rows[0] if len(rows) == 1 else np.concatenate(rows))[:runs]

    masks = [part[k][0] for part in chunks[0]]
    if all(mask.ndim == 1 for mask in masks):  # the same in all runs, and already left out where absent
        some: np.ndarray = np.concatenate(masks)
        present = np.ones((runs, int(some.sum())), dtype=bool)
        leaves = {leaf.name: joined(lambda p, n=n: p[k][1][n]) for n, leaf in enumerate(port.leaves)}  # type: ignore[misc]
        return Runs(port.name, time[some], present, leaves)
    present = joined(lambda part: part[k][0])
    some = np.asarray(present.any(axis=0))
    leaves = {
        leaf.name: joined(lambda p, n=n: p[k][1][n])[:, some]  # type: ignore[misc]
        for n, leaf in enumerate(port.leaves)
    }
    return Runs(port.name, time[some], present[:, some], leaves)
