"""Flights: where recorded and simulated data come from.

Each module has one entry point, `load(argument, *, seed=0, settings={}) -> Flight`; `simulated` makes
quadrotor flights (`worlds` has those through the simulated world), `euroc` reads a folder of the EuRoC MAV
dataset.
"""

from __future__ import annotations

from flowgraph.blocks.flights import euroc, simulated

__all__ = ["euroc", "simulated"]
