"""Where a filter on outdoor sensors starts.

Its force and its magnetometer show an attitude, which it starts with if nothing is set. Nothing can be left
out of its readings, since each of optical flow is over the time since the one before, or since the first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from flowgraph import Series
from flowgraph.blocks.inertial.alignment import StartSpread, rest_seconds
from flowgraph.blocks.outdoor.flight import OutdoorSensors, OutdoorStart, outdoor_flight, without_gaps
from flowgraph.blocks.scoring.cases import OnFlight
from flowgraph.blocks.scoring.settings import Positive
from flowgraph.blocks.scoring.start import UNKNOWN_HEADING, Started
from flowgraph.blocks.scoring.tuning import given
from flowgraph.errors import DataError, DeclarationError

__all__ = ["StartedOutdoor"]


@dataclass(frozen=True)
class StartedOutdoor(Started):
    """Where a filter starts outdoors.

    Args:
        start: truth, file (the first force and field) or unknown_yaw (nothing is known of the heading); file
            if left out.
        biases: whether those of the unit are estimated; if left out, where the flight says that it has any.
        gyro_bias, accelerometer_bias: rad/s and m/s^2, deviations of the biases at the start; the flight's if
            left out, or 0.1.
    """

    biases: bool | None = None
    gyro_bias: Positive | None = None
    accelerometer_bias: Positive | None = None

    def estimates(self, on: OnFlight) -> bool:
        """Whether biases are estimated.

        Raises:
            DeclarationError: where a bias is told to a filter that has none.
        """
        told = [name for name in ("gyro_bias", "accelerometer_bias") if getattr(self, name) is not None]
        if self.biases is False and told:
            raise DeclarationError(
                "this filter is to estimate no biases",
                path=f"{on.name}.{told[0]}",
                expected="biases=true",
                got="biases=false",
                fix=f"leave {told[0]} out, or write biases=true",
            )
        return self.biases if self.biases is not None else bool(told or any(_biases(on)))

    def _unsure(self, on: OnFlight, spread: StartSpread) -> StartSpread:
        """The spread of a start, with that of the biases."""
        of_flight = (b or usual for b, usual in zip(_biases(on), (0.1, 0.1), strict=True))
        told = (
            given(s, b) for s, b in zip((self.gyro_bias, self.accelerometer_bias), of_flight, strict=True)
        )
        gyro, force = told
        return replace(spread, gyro_bias=gyro, accelerometer_bias=force)

    def begin(self, on: OnFlight) -> tuple[dict[str, Series], OutdoorSensors, OutdoorStart]:
        """The inputs, what is known of the sensors, and the start, which a note names.

        Raises:
            DataError: as `outdoor_flight` and `pose`, and where a truth that begins later would leave optical
                flow a gap.
        """
        inputs, sensors, first, notes = outdoor_flight(on.flight, on.name)
        first = replace(first, spread=self._unsure(on, first.spread))
        on.first_up("imu", inputs["imu"]["specific_force"])  # says what was passed over
        shows = "magnetometer" in inputs
        if not shows and self.start is None and self.start_heading is None:
            on.notes.extend(notes)
            return inputs, sensors, first
        if not shows and self.start == "file":
            raise DataError(
                f"this flight shows {on.name} no heading",
                path=f"{on.name}.start",
                expected="a magnetometer",
                got=", ".join(inputs),
                fix="write --set start=unknown_yaw, or --set start.heading=RADIANS",
            )
        rests = math.inf
        if self.start == "truth":
            rests = float(on.flight.info.get("still", rest_seconds(inputs["imu"])))
        place = inputs.get("gps", inputs.get("gps2"))
        if place is None and self.start != "truth":
            on.notes.append(notes[0])  # on the position, which comes first
        usual = "file" if shows else "unknown_yaw"
        pose = self.pose(on, inputs, position=place, shown=first.attitude, usual=usual, rests=rests)
        here = first.position if place is None and self.start != "truth" else pose.position
        if pose.time > min(int(series.time[0]) for series in inputs.values()):
            without_gaps(on.flight.name, pose.inputs)
        known = StartSpread().heading if pose.told or self.start_heading is not None else first.spread.heading
        heading = UNKNOWN_HEADING if pose.unknown else known
        spread = replace(first.spread, heading=heading)
        return pose.inputs, sensors, OutdoorStart(here, pose.attitude, spread)


def _biases(on: OnFlight) -> tuple[float, float]:
    """Deviations of the constant biases that the flight says of its unit, rad/s and m/s^2; 0 where none."""
    noise = on.flight.info.get("noise", {})
    gyro, force = (float(noise.get(part, {}).get("bias", 0.0)) for part in ("gyro", "accelerometer"))
    return gyro, force
