"""Roll and pitch from the accelerometer alone: the baseline that does not drift, and knows no heading.

    roll = atan2(f_y, f_z)      pitch = atan2(-f_x, hypot(f_y, f_z))      yaw = 0

Every reading is taken by itself, so all that accelerates the body, and all noise, is in the result.

Source: M. Pedley, "Tilt sensing using a three-axis accelerometer", Freescale AN3461, 2013, eqs. 25-26, with
the signs of this library: specific force, z up.
"""

from __future__ import annotations

from flowgraph import Case, Stream, graph
from flowgraph.blocks.metrics.errors import orientation_errors
from flowgraph.blocks.orientation.accelerometer import roll_pitch_attitude
from flowgraph.blocks.scoring.cases import OnFlight, Scored, on_flight
from flowgraph.blocks.signals import Imu


@graph
def roll_pitch(imu: Stream[Imu]):
    """Attitude that the specific force shows, with a yaw of zero.

    Collected: `attitude` at every reading.
    """
    return {"attitude": roll_pitch_attitude(imu, name="attitude")}


_UNSMOOTHED = "each reading is taken by itself, so the later ones say nothing of it"


@on_flight(roll_pitch, "imu", measured=None, unsmoothed=_UNSMOOTHED)
def for_flight(on: OnFlight, *, scored: Scored) -> Case:
    """Run it on a flight with an inertial unit.

    Args:
        flight: with the stream `imu`.
    """
    return on.case(scored.score(on, orientation_errors, estimate="attitude", innovations=False))
