"""What a run is, as a digest: the same digest, the same result.

A key is taken of everything that a result follows from: the lowered graph, the code that prepares and scores
it, what the flight holds, seed, parameters, engine and version. Taking it for each seed would cost as much as
the run, so graph and flight are described by those of seed 0 at the run's own parameters; what another seed
then changes follows from that seed, which is in the key as well.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from flowgraph.errors import FlowgraphError
from flowgraph.pipeline.digests import digest, package_version

FORMAT = 2
"""Goes into each key; a change of the rules in this module needs another number."""


def failure_digest(error: BaseException) -> str:
    """Of what cannot be described because it raises: other data or other code raise something else."""
    said = str(error) if isinstance(error, FlowgraphError) else repr(error)
    return digest(("failed", type(error).__name__, said))


def run_key(parts: Mapping[str, Any]) -> str:
    """The name of a run's result, from all that it follows from."""
    return digest({"format": FORMAT, "version": package_version(), **parts})


def content_digest(row: Any) -> str:
    """Of a JSON value as it is written, by which a file is known to be whole."""
    return hashlib.sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()
