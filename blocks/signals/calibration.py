"""What is learned of an inertial unit at rest or beside a motion capture: alignment, biases, scales."""

from __future__ import annotations

from flowgraph import Array, Signal, real

__all__ = [
    "Alignment",
    "Rest",
    "CountsSum",
    "Window",
    "NormalEquations",
]


class Alignment(Signal):
    """What the readings of a body at rest say of it.

    attitude: body to world. gyro_bias: rad/s, body. resting: 1 while the readings are those of a body at
    rest, else 0; then attitude and bias are the last that were found. seconds: how long it has rested.
    """

    attitude: Array = real(4, unit="1", frame="world<-body")
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    resting: Array = real()
    seconds: Array = real(unit="s")


class Rest(Signal):
    """Whether the body rests: 1 or 0."""

    still: Array = real()


class CountsSum(Signal):
    """The integral of counts over time so far, each reading held until the next.

    total: (gyro, force), counts s. running: 1 once there was a reading, before that 0.
    """

    total: Array = real(6)
    running: Array = real()


class Window(Signal):
    """Mean counts over a window beside what the motion capture says they are worth.

    counts: (gyro, force). rate: rad/s, body. force: m/s^2, body.
    """

    counts: Array = real(6)
    rate: Array = real(3, unit="rad/s", frame="body")
    force: Array = real(3, unit="m/s^2", frame="body")


class NormalEquations(Signal):
    """A^T A and A^T y of both fits, so far, with a = [(c - CENTRE) / SPAN, 1].

    The unknowns of each are 3 x 3 and a constant. used: how many windows counted.
    """

    gyro_square: Array = real(4, 4)
    gyro_right: Array = real(4, 3)
    force_square: Array = real(4, 4)
    force_right: Array = real(4, 3)
    used: Array = real(2)
