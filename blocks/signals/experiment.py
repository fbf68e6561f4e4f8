"""What a simulated experiment carries: how its world moves, and what is drawn once for a flight."""

from __future__ import annotations

from flowgraph import Array, Signal, real

__all__ = ["BodyMotion", "Drawn", "FigureShape", "PlaneShape", "Vector"]


class BodyMotion(Signal):
    """How a rigid body moves at one time: all that sensors may read of it.

    acceleration: the second derivative of the position. attitude: body to world. rate: of the body, so that
    dq/dt = q * (0, rate) / 2.
    """

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    acceleration: Array = real(3, unit="m/s^2", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    rate: Array = real(3, unit="rad/s", frame="body")


class Drawn(Signal):
    """What is drawn once for a flight, as its world reads it: see `World.shaped`."""

    numbers: Array = real("n")


class FigureShape(Signal):
    """A smooth figure: three waves an axis, and two of the yaw.

    sizes: m. frequencies: rad/s. phases, yaw_phases: rad, at the start. origin, yaw_origin: the value of each
    wave there (m, rad), from which it counts.
    """

    sizes: Array = real(3, 3, unit="m")
    frequencies: Array = real(3, 3, unit="rad/s")
    phases: Array = real(3, 3, unit="rad")
    yaw_phases: Array = real(2, unit="rad")
    origin: Array = real(3, 3, unit="m")
    yaw_origin: Array = real(2, unit="rad")


class PlaneShape(Signal):
    """A smooth figure in the plane: three waves an axis, of one pace each.

    sizes: m. phases: rad, at the start. paces: rad/s.
    """

    sizes: Array = real(2, 3, unit="m")
    phases: Array = real(2, 3, unit="rad")
    paces: Array = real(3, unit="rad/s")


class RoadPiece(Signal):
    """How a car goes along its road for some seconds, and the pieces of the road that it reaches meanwhile.

    begin, length: s. along: coefficients of the road's parameter in the share of the seconds gone, lowest
    powers first. first: the parameter where the first piece begins, the others each 1 further. road: their
    coefficients in the parameter since they began.
    """

    begin: Array = real(unit="s")
    length: Array = real(unit="s")
    along: Array = real(10, unit="1")
    first: Array = real(unit="1")
    road: Array = real(3, 6, 3, unit="m")


class Vector(Signal):
    """Three numbers along the axes of the body: an error of a reading, in its unit."""

    vector: Array = real(3)
