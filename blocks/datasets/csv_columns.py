"""What the columns of a table may hold: fields of streams, their units, and the settings that say so."""

from __future__ import annotations

from collections.abc import Mapping

from flowgraph.blocks.datasets.dialect import DELIMITERS
from flowgraph.blocks.datasets.shape import MEASURED_NOISE, NOISE_SETTINGS, stream_settings
from flowgraph.blocks.datasets.tables import POLICIES
from flowgraph.blocks.datasets.turns import ORDERS
from flowgraph.blocks.datasets.units import ANGLE, FIELD, FORCE, LENGTH, PRESSURE, RATE, SPEED, TIME

__all__ = ["OPTIONAL", "SETTINGS", "STREAMS", "TURNS", "WAYS", "said_by"]

_QUATERNION = {"wxyz": 1.0, "xyzw": 1.0}
_ROWS = {"rows": 1.0, "columns": 1.0}
TURNS = {"attitude": (4, _QUATERNION), "angles": (3, ANGLE), "matrix": (9, _ROWS)}

WAYS: Mapping[str, str] = {**dict.fromkeys(TURNS, "attitude"), "pressure": "height"}
"""Fields that are ways to write another."""

OPTIONAL = frozenset(("deviation",))
"""Fields that a stream need not have."""

STREAMS: Mapping[str, Mapping[str, tuple[int, Mapping[str, float]]]] = {
    "imu": {"gyro": (3, RATE), "specific_force": (3, FORCE)},
    "vicon": {"position": (3, LENGTH), **TURNS},
    "leica": {"position": (3, LENGTH)},
    "gps": {"latitude": (1, ANGLE), "longitude": (1, ANGLE), "height": (1, LENGTH)},
    "gps_velocity": {"velocity": (3, SPEED)},
    "magnetometer": {"field": (3, FIELD)},
    "heading": {"angle": (1, ANGLE), "deviation": (1, ANGLE)},
    "barometer": {"height": (1, LENGTH), "pressure": (1, PRESSURE)},
    "wheels": {"speed": (1, SPEED)},
    "truth": {
        "position": (3, LENGTH),
        **TURNS,
        "velocity": (3, SPEED),
        "gyro_bias": (3, RATE),
        "accelerometer_bias": (3, FORCE),
    },
}
"""The fields of each stream: how many columns, and the units (or orders of numbers) that they may have, the
first where nothing is said. `attitude`, `angles` and `matrix` are three ways to write one field, of which one
is given, as are `height` and `pressure`. All other fields of a stream are needed, but for `OPTIONAL`; of the
truth, an attitude alone, with a position, or all five."""


def said_by(field: str) -> str:
    """The setting of what the columns of a field are in."""
    return "order" if field in ("attitude", "matrix") else "unit"


SETTINGS: Mapping[str, str] = {
    "time": "the column of the stamps; if left out, that of a name such as t, time or stamp, else the first",
    "time.unit": "of the stamps: " + ", ".join(TIME),
    "delimiter": "between columns: " + ", ".join(DELIMITERS) + "; found if left out",
    "decimal": "the decimal mark: point, comma; found if left out",
    "comment": "a mark that lines to pass over begin with, beside # % // ! ;",
    **{
        f"{stream}.{field}": f"{n} columns, comma-separated"
        for stream, fields in STREAMS.items()
        for field, (n, _) in fields.items()
    },
    **{
        f"{stream}.{field}.{said_by(field)}": ", ".join(units)
        for stream, fields in STREAMS.items()
        for field, (_, units) in fields.items()
        if len(units) > 1
    },
    "gps_velocity.axes": "of its three columns: enu (left out: east, north, up) or ned",
    "heading.axes": "enu (left out: from east, to the left) or ned (from north, to the right, as a compass)",
    "heading.noise": "rad, the deviation of a heading without a column for it",
    "heading.baseline": "from the one antenna to the other in the body: three numbers; 1,0,0 if left out",
    **{
        f"{stream}.angles.order": "of the turns, each about an axis of the turned body: " + ", ".join(ORDERS)
        for stream in ("vicon", "truth")
    },
    **NOISE_SETTINGS,
    **MEASURED_NOISE,
    **stream_settings(*STREAMS),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""
