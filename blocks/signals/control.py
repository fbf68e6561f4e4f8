"""What controllers tell, and what they remember."""

from __future__ import annotations

from flowgraph import Array, Signal, real

__all__ = ["Controller", "FlightCommand"]


class Controller(Signal):
    """What a PID controller remembers: its integral, the last error, and the slope of the error (1/s)."""

    integral: Array = real()
    error: Array = real()
    slope: Array = real()


class FlightCommand(Signal):
    """What a quadrotor is told: thrust per mass along body z (m/s^2) and body rate (rad/s, body)."""

    thrust: Array = real(unit="m/s^2", frame="body")
    rate: Array = real(3, unit="rad/s", frame="body")
