"""What a simulated flight was made by: a graph of world and sensors, of which a run is the flight.

The same world can then stand in one graph with the filter and its score, and no flight is ever written down.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from flowgraph.language.declare import GraphFunction


@dataclass(frozen=True, eq=False)
class Experiment:
    """The world of a flight.

    Args:
        world: its sources keep time, and what is `given`; it gives the flight's streams, and "truth".
        ticks: for each of its sources the `Series` of when it ticks, all by one clock for all seeds.
        settings: of the world.
        given: what its other sources get for a seed, such as a way that no reaction of fixed size finds.
    """

    world: GraphFunction
    ticks: Mapping[str, Any]
    settings: Mapping[str, Any] = field(default_factory=dict)
    given: Callable[[int], Mapping[str, Any]] = lambda seed: {}
