"""Models: what moves, how it is measured, and the numbers that a filter keeps of it; one module a model.

The rooms of methods (`kalman`, `unscented`, `particles`) know nothing of bodies. Here is what they are given:

    point           position and velocity, driven by an acceleration in the world; linear
    pose            position, velocity and attitude with ten numbers: the extended filter, and its smoother
    unscented_pose  the same state as functions of a point, for sigma points
    euler_ins       pose and biases with Euler angles: fifteen numbers, the extended filter
    unscented_ins   the same by sigma points, and a camera's velocity
    particle_ins    the same by particles
    plane           a point in the plane: the smallest problem for particles
    tracking        points, vehicles that turn and a pendulum, for any method of `filtering`
    inertial_pose   the pose that an IMU carries, for any method
    navigation      the same with what is estimated outdoors beside it

Several have a `STATE` and a `move`, so the modules are what is public: `from flowgraph.blocks.models import
pose`, or names from a module. None is imported before it is asked for: those that see by a camera load
OpenCV.
"""

from __future__ import annotations

__all__ = [
    "point",
    "pose",
    "unscented_pose",
    "euler_ins",
    "unscented_ins",
    "particle_ins",
    "plane",
    "tracking",
    "inertial_pose",
    "navigation",
]
