"""Where a filter on six outdoor sensors starts.

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
from flowgraph.blocks.scoring.start import UNKNOWN_HEADING, Started

__all__ = ["StartedOutdoor"]


@dataclass(frozen=True)
class StartedOutdoor(Started):
    """Where a filter starts outdoors.

    Args:
        start: truth, file (the first force and field) or unknown_yaw (nothing is known of the heading); file
            if left out.
    """

    def begin(self, on: OnFlight) -> tuple[dict[str, Series], OutdoorSensors, OutdoorStart]:
        """The inputs, what is known of the sensors, and the start, which a note names.

        Raises:
            DataError: as `outdoor_flight` and `pose`, and where a truth that begins later would leave optical
                flow a gap.
        """
        inputs, sensors, first = outdoor_flight(on.flight, on.name)
        rests = math.inf
        if self.start == "truth":
            rests = float(on.flight.info.get("still", rest_seconds(inputs["imu"])))
        pose = self.pose(on, inputs, position=inputs["gps"], shown=first.attitude, usual="file", rests=rests)
        if pose.time > min(int(series.time[0]) for series in inputs.values()):
            without_gaps(on.flight.name, pose.inputs)
        on.first_up("imu", inputs["imu"]["specific_force"])  # says what was passed over
        known = StartSpread().heading if pose.told or self.start_heading is not None else first.spread.heading
        heading = UNKNOWN_HEADING if pose.unknown else known
        spread = replace(first.spread, heading=heading)
        return pose.inputs, sensors, OutdoorStart(pose.position, pose.attitude, spread)
