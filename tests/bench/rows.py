"""A row of the benchmark's table, and the timing behind it: medians of interleaved pairs.

On a machine that is shared, speeds drift by a factor over seconds. So ours and the peer take turns, A B A B,
and what is compared is the median of the ratios of neighbours, not the ratio of two medians. A piece that
lasts longer than a turn of the system's scheduler measures other programs too: better
many short ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median
from time import perf_counter, process_time
from typing import Any


@dataclass(frozen=True)
class Row:
    """One comparison.

    Args:
        name: what is measured.
        ours, peer: the two figures, in `unit`; no peer where its library is missing.
        unit: of both.
        against: what the peer is, or why there is none.
        ratio: ours / peer, the median over pairs; None without a peer.
        bound: what must hold, in words; None where the row is for information only.
        met: whether it holds; None without a bound.
        details: anything else worth keeping; only in the JSON.
    """

    name: str
    ours: float
    peer: float | None
    unit: str
    against: str
    ratio: float | None
    bound: str | None = None
    met: bool | None = None
    details: dict[str, Any] = field(default_factory=dict)


def missing(name: str, ours: float, unit: str, library: str, error: ImportError) -> Row:
    """A row without a peer: its library is not installed, or does not work with what is."""
    return Row(name, ours, None, unit, f"none: {library} is not to be had ({error})", None)


def seconds(work: Callable[[], object]) -> float:
    """How long one call takes."""
    start = perf_counter()
    work()
    return perf_counter() - start


def worked(work: Callable[[], object]) -> float:
    """The processor time that one call takes: what else the machine does is not in it."""
    start = process_time()
    work()
    return process_time() - start


def interleaved(
    ours: Callable[[], float], peer: Callable[[], float], repeats: int
) -> tuple[float, float, float]:
    """Medians of what `ours` and `peer` return when called in turn, and the median of their ratios.

    Each is called once before, unmeasured, so that neither pays for what is done only once in a process.
    """
    ours(), peer()
    pairs = [(ours(), peer()) for _ in range(repeats)]
    return median(a for a, _ in pairs), median(b for _, b in pairs), median(a / b for a, b in pairs)
