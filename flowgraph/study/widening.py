"""Values that need more bits than the others: in which order, how few, and what a person is told of them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TypeVar

from flowgraph.engines.fixed.abreast import Recorded
from flowgraph.engines.fixed.counts import names_of
from flowgraph.engines.fixed.rounding import Judged, decisions, estimates, impacts
from flowgraph.engines.fixed.shifts import MOVES
from flowgraph.pipeline.formats import Formats
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.study.differences import DECISIONS

Made = TypeVar("Made")


def with_own(pipeline: Pipeline, formats: Formats) -> list[int]:
    """The values that have a format of their own: what is only moved keeps the one that it had."""
    moves = {i.out for i in pipeline.instructions if i.op in MOVES}
    return [n for n in sorted(formats.fractions) if n not in moves]


def most_needed(flight: Recorded, formats: Formats, port: int, bounds: Collection[str]) -> list[int]:
    """The values that may be widened, those first whose rounding moves most what the bounds are of.

    Args:
        flight: on which that is seen.
        formats: in which they are too narrow. What has wider words already is left as it is.
        port: the place of the output whose numbers are judged.
        bounds: figures.
    """
    pipeline = flight.pipeline
    values = [n for n in with_own(pipeline, formats) if n not in formats.wider]
    kinds: list[Judged] = [decisions] if DECISIONS in bounds else []
    if set(bounds) - {DECISIONS}:
        leaves = pipeline.outputs[port].leaves
        real = [k for k, x in enumerate(leaves) if x.dtype == "real" and not x.name.endswith("covariance")]
        kinds.append(estimates(port, real))
    sizes = impacts(flight, formats.fractions, values, kinds)
    return sorted(values, key=lambda n: (-sizes[n], n))


def fewest(most: int, tried: Callable[[int], Made], holds: Callable[[Made], bool]) -> Made:
    """What is made of the smallest count up to `most` that a bisection finds to hold; that of `most` where it
    does not hold itself. That 0 does not is known."""
    best = tried(most)
    low, high = 0, most
    while holds(best) and high - low > 1:
        middle = (low + high) // 2
        made = tried(middle)
        if holds(made):
            best, high = made, middle
        else:
            low = middle
    return best


def wide_words(pipeline: Pipeline, formats: Formats, some: Collection[int]) -> str:
    """A sentence: how many of all values, and on which lines, have wider words: those of `some`."""
    names, lines = names_of(pipeline), dict[str, int]()
    for n in sorted(some):
        place = names[n].partition(", ")[2] or names[n].partition(" ")[2]
        lines[place] = lines.get(place, 0) + 1
    listed = ", ".join(line + (f" ({count})" if count > 1 else "") for line, count in lines.items())
    bits = " or ".join(map(str, sorted({formats.width_of(n) for n in some})))
    whole = len(with_own(pipeline, formats))
    return f"{len(some)} of {whole:,} values have {bits} bits beside {formats.width}: {listed}"
