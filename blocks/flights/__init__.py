"""Simulated flights: a world, sensors in it, and a `Flight` of what they read.

`simulated` is the maker that `sim` stands for, `load(argument, *, seed=0, settings={}) -> Flight`. Its flight
without an argument is `figure`, a graph: a smooth figure of a quadrotor with an IMU and a motion capture.
`worlds` has the flights through the simulated world with sensors of choice, `plane` a point in the plane.
Recorded flights are in `datasets`.
"""

from __future__ import annotations

from flowgraph.blocks.flights import figure, plane, simulated, worlds

__all__ = ["figure", "plane", "simulated", "worlds"]
