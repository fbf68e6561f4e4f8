"""The Earth's field in a world with x east, y north and z up.

For a declination D (east of north) and a dip I (below the horizon) it is

    m = strength (cos I sin D, cos I cos D, -sin I)

One field fixes two of three angles, so a magnetometer that reads it, R^T m, is the honest form
(`read_magnetometer`). The thesis's reads the whole attitude; that is `read_attitude`.
"""

from __future__ import annotations

import math

import numpy as np

__all__ = ["earth_field"]


def earth_field(declination: float, dip: float, strength: float) -> np.ndarray:
    """The field (3,) in the world, in the unit of `strength`; angles in rad."""
    level, down = math.cos(dip), math.sin(dip)
    return strength * np.array([level * math.sin(declination), level * math.cos(declination), -down])
