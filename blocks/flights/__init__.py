"""Simulated flights: a world, sensors in it, and a `Flight` of what they read.

`simulated` is the maker that `sim` stands for, `load(argument, *, seed=0, settings={}) -> Flight`: a smooth
figure of a quadrotor with an IMU and a motion capture, or one of the others. `worlds` has the flights through
the simulated world with sensors of choice, `plane` a point in the plane, and `figure` the figure as a graph.
Recorded flights are in `datasets`.
"""

from __future__ import annotations

from flowgraph.blocks.flights import figure, plane, simulated, worlds

__all__ = ["figure", "plane", "simulated", "worlds"]
