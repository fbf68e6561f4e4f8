"""Simulated flights. Recorded ones are in `flowgraph.blocks.datasets`.

Each module has one entry point, `load(argument, *, seed=0, settings={}) -> Flight`; `simulated` makes
quadrotor flights; `worlds` has those through the simulated world.
"""

from __future__ import annotations

from flowgraph.blocks.flights import simulated

__all__ = ["simulated"]
