"""Roll and pitch from the accelerometer alone: the baseline that does not drift, and knows no heading.

    roll = atan2(f_y, f_z)      pitch = atan2(-f_x, hypot(f_y, f_z))      yaw = 0

Every reading is taken by itself, so all that accelerates the body, and all noise, is in the result.

Source: M. Pedley, "Tilt sensing using a three-axis accelerometer", Freescale AN3461, 2013, eqs. 25-26, with
the signs of this library: specific force, z up.
"""

from __future__ import annotations

from flowgraph import Case, Flight, Result, Stream, clocks_of, graph
from flowgraph.blocks.metrics.errors import orientation_errors
from flowgraph.blocks.orientation.accelerometer import roll_pitch_attitude
from flowgraph.blocks.signals import Imu
from flowgraph.language.checks import need_numbers


@graph
def roll_pitch(imu: Stream[Imu]):
    """Attitude that the specific force shows, with a yaw of zero.

    Collected: `attitude` at every reading.
    """
    return {"attitude": roll_pitch_attitude(imu, name="attitude")}


@roll_pitch.on_flight
def for_flight(flight: Flight, *, settle: float = 1.0) -> Case:
    """Run it on a flight with an inertial unit.

    Args:
        flight: with the stream `imu`.
        settle: seconds at the start that the errors leave out.
    """
    need_numbers("roll_pitch", not_negative={"settle": settle})
    inputs = flight.need("roll_pitch", "imu")
    truth = flight.truth

    def score(result: Result) -> dict[str, float]:
        return {} if truth is None else orientation_errors(result["attitude"], truth, settle=settle)

    return Case(roll_pitch.build(**clocks_of(inputs)), inputs, score, "attitude")
