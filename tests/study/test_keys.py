"""Keys: what differs reads differently, and what is equal reads alike in every process."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np

from flowgraph.pipeline.digests import digest


def scaled(factor: float):
    return lambda x: factor * x


class Offset:
    def __init__(self, by: float) -> None:
        self.by = by

    def __call__(self, x: float) -> float:
        return x + self.by

    def added(self, x: float) -> float:
        return x + self.by


def test_functions_that_hold_other_values_differ():
    assert digest(partial(np.add, 1.0)) != digest(partial(np.add, 2.0))
    assert digest(scaled(1.0)) != digest(scaled(2.0))
    assert digest(scaled(1.0)) == digest(scaled(1.0))
    assert digest(Offset(1.0)) != digest(Offset(2.0))
    assert digest(Offset(1.0).added) != digest(Offset(2.0).added)
    assert digest(Offset(1.0)) == digest(Offset(1.0))


def test_a_set_reads_alike_in_every_process():
    code = "from flowgraph.pipeline.digests import digest; print(digest({'a', 'b', 'c', 'd'}))"
    found = set()
    for seed in ("1", "2"):
        env = {"PYTHONHASHSEED": seed}
        done = subprocess.run(
            [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
        )
        found.add(done.stdout)
    assert len(found) == 1
    assert digest({"a", "b"}) != digest({"a", "c"})
