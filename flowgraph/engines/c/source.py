"""A pipeline as C: one header, one source file, and nothing else.

Each pattern of present inputs has a reaction of its own, in which everything that depends on presence is
folded away. Beyond `MOST_PATTERNS` there is one reaction in which presence is data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flowgraph.engines.c.file import File, Source
from flowgraph.engines.c.header import NOT_FINITE
from flowgraph.errors import LoweringError
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program

__all__ = ["MOST_PATTERNS", "Source", "every_pattern", "generate"]

MOST_PATTERNS = 8


def generate(
    pipeline: Pipeline,
    dtype: str = "float64",
    *,
    patterns: Sequence[int] | None = None,
    tidy: Callable[[Program], Program] = lambda program: program,
    alone: bool = True,
) -> Source:
    """The C of a pipeline.

    Args:
        pipeline: what to write down.
        dtype: "float64" or "float32", what `real` is.
        patterns: the patterns of present inputs that can come; all if left out.
        tidy: makes a program shorter: that of a pattern, that of all patterns, or that of a turn of a loop.
        alone: whether it has a function that gives registers their first values, and what its entry returns
            says that a queue was full or an output is not finite; or its caller sees to both.

    Raises:
        LoweringError: for an operation that C has no rule for, or more ports than a word has bits.
    """
    if len(pipeline.inputs) > 64 or len(pipeline.outputs) > NOT_FINITE:
        raise LoweringError(
            "too many ports for C",
            path=pipeline.name,
            expected=f"at most 64 inputs and {NOT_FINITE} outputs",
            got=f"{len(pipeline.inputs)} and {len(pipeline.outputs)}",
            fix="join signals that come together into one struct",
        )
    chosen: list[int] | None = sorted(k for k in patterns if k) if patterns is not None else None
    if chosen is None:
        chosen = every_pattern(pipeline)
    if chosen is not None and len(chosen) > MOST_PATTERNS:
        chosen = None
    real = "double" if dtype == "float64" else "float"
    return File(pipeline, real, chosen, tidy, alone).source()


def every_pattern(pipeline: Pipeline) -> list[int] | None:
    """The patterns of present inputs that can come, where they are few: inputs of one clock come together."""
    groups: dict[str, int] = {}
    for k, port in enumerate(pipeline.inputs):
        groups[port.clock] = groups.get(port.clock, 0) | 1 << k
    if 2 ** len(groups) - 1 > MOST_PATTERNS:
        return None
    found = [0]
    for mask in groups.values():
        found += [key | mask for key in found]
    return sorted(found)[1:]
