"""How hard a flight is, in three numbers: root mean squares of acceleration, tilt and body rate.

`print(figures(thesis_flight(s) for s in range(50)))` is the report on the thesis's family.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.world.motion import World

__all__ = ["Figures", "figures"]


@dataclass(frozen=True)
class Figures:
    """Root mean squares over time, averaged over flights.

    Args:
        flights: how many.
        acceleration: m/s^2, of |a|.
        tilt: degrees, of the angle between body z and world z.
        rate: rad/s, of |body rate|.
        most_thrust, most_tilt, most_rate: the largest of all, in m/s^2, degrees, rad/s.
    """

    flights: int
    acceleration: float
    tilt: float
    rate: float
    most_thrust: float
    most_tilt: float
    most_rate: float

    def __str__(self) -> str:
        flights = "one flight" if self.flights == 1 else f"{self.flights} flights"
        return (
            f"RMS acceleration {self.acceleration:.2f} m/s^2, tilt {self.tilt:.1f} deg, body rate "
            f"{self.rate:.2f} rad/s over {flights}; most: thrust {self.most_thrust:.1f} m/s^2, "
            f"tilt {self.most_tilt:.0f} deg, body rate {self.most_rate:.1f} rad/s"
        )


def figures(worlds: World | Iterable[World], *, rate: float = 200.0) -> Figures:
    """The figures of one world or the average of several, sampled at `rate` Hz."""
    rows = []
    for world in [worlds] if isinstance(worlds, World) else worlds:
        motion = world.at(np.arange(int(world.duration * rate) + 1) / rate)
        sizes = [np.linalg.norm(x, axis=-1) for x in (motion.acceleration, motion.rate)]
        parts = (sizes[0], np.degrees(motion.tilt), sizes[1])
        most = (motion.thrust.max(), parts[1].max(), parts[2].max())
        rows.append([*(np.sqrt(np.mean(x**2)) for x in parts), *most])
    table = np.array(rows)
    return Figures(len(table), *table[:, :3].mean(0).tolist(), *table[:, 3:].max(0).tolist())
