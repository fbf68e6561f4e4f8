"""The block library, room by room.

A room holds what belongs to one question. They stand on each other: a module imports from its own room and
from rooms before it in this list, never from one after it, and nothing goes in a circle.

    What is said
      signals      the types of all wires: each quantity with its unit and frame
    The ground
      geometry     rotations, angles, curved states, places on the Earth
      metrics      errors against a truth, and what an honest filter's would be
    Methods
      kalman       linear, extended, on roots; smoothing; a gate's way back
      unscented    sigma points
      inertial     an inertial unit: prediction, aiding, alignment, calibration
      particles    clouds, resampling, Rao-Blackwell
      statespace   how something moves and what is seen of it: models, for every method
      filtering    a filter of any model by any method
      control      plants, controllers, and loops that close through them
    What is estimated
      vision       cameras and tags, and the poses that they give
      models       points, poses and inertial navigation, for each of the methods
      orientation  attitudes by gyroscope, gravity, and magnetic field
      outdoor      six sensors of a vehicle outdoors
    Where data come from
      datasets     recorded flights, a module a format
      world        bodies that move in known ways
      sensors      which read that world
      flights      both together: simulated flights
    What it was worth
      scoring      a case of a flight and a filter, and its score

A room's public names are importable from it, `from flowgraph.blocks.kalman import update_linear`; of
`models`, `datasets` and `flights` the modules are public. A graph of one's own starts at `signals` and at the
room of its method; `flowgraph.graphs` shows what is made of them.
"""

from __future__ import annotations

__all__ = [
    "signals",
    "geometry",
    "metrics",
    "kalman",
    "unscented",
    "inertial",
    "particles",
    "statespace",
    "filtering",
    "control",
    "vision",
    "models",
    "orientation",
    "outdoor",
    "datasets",
    "world",
    "sensors",
    "flights",
    "scoring",
]
