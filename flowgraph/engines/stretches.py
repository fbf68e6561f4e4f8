"""Outputs that come in stretches of ticks, put together."""

from __future__ import annotations

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.types import DTYPES


def joined(
    pipeline: Pipeline, parts: list[list[tuple[np.ndarray, list[np.ndarray]]]], tape: Tape
) -> list[tuple[np.ndarray, list[np.ndarray]]]:
    """For each output its times and leaves in one, from those of each stretch."""
    outputs = []
    for port, kept in zip(pipeline.outputs, parts, strict=True):
        count = sum(len(t) for t, _ in kept)
        whole = count == len(tape.time)
        times = tape.time if whole else np.concatenate([t for t, _ in kept])
        arrays = [
            np.concatenate([leaves[k] for _, leaves in kept])
            if kept
            else np.zeros((0, *leaf.shape), DTYPES[leaf.dtype])
            for k, leaf in enumerate(port.leaves)
        ]
        outputs.append((times, arrays))
    return outputs
