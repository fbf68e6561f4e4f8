"""The simulated world: bodies that move in known ways, for sensors to read.

A `World` answers for any times with a `Motion`: position and its derivatives, attitude and body rate, all
exact. `thesis_flight` draws a random quadrotor flight, `Quadrotor` follows given key points, `RoundTrip`
turns out and back in its place, `Hover` stays. `smooth` is the figure of `sim`, two blocks;
`drive` a car on a road.
"""

from __future__ import annotations

from flowgraph.blocks.world import thesis
from flowgraph.blocks.world.drive import NO_ROAD, REST_OF_DRIVE, drive_motion, road_of
from flowgraph.blocks.world.feasibility import LIMITS, Limits, feasible
from flowgraph.blocks.world.figures import Figures, figures
from flowgraph.blocks.world.hover import Hover, hover_waves
from flowgraph.blocks.world.minimum_jerk import KeyPoint, Primitives, join, primitive
from flowgraph.blocks.world.motion import Motion, World, motion_over, world_motion
from flowgraph.blocks.world.plane import plane_motion, plane_shape
from flowgraph.blocks.world.quadrotor import Quadrotor, carried_by_thrust
from flowgraph.blocks.world.roundtrip import RoundTrip
from flowgraph.blocks.world.smooth import AT_REST, figure_motion, figure_shape
from flowgraph.blocks.world.thesis import thesis_flight

__all__ = [
    "World",
    "Motion",
    "world_motion",
    "motion_over",
    "KeyPoint",
    "Primitives",
    "join",
    "primitive",
    "Quadrotor",
    "carried_by_thrust",
    "Limits",
    "LIMITS",
    "feasible",
    "thesis_flight",
    "thesis",
    "RoundTrip",
    "Hover",
    "hover_waves",
    "Figures",
    "figures",
    "NO_ROAD",
    "REST_OF_DRIVE",
    "drive_motion",
    "road_of",
    "AT_REST",
    "figure_motion",
    "figure_shape",
    "plane_motion",
    "plane_shape",
]
