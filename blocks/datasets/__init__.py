"""Recorded data as flights: one module a format, one shape for all of them.

Each module has one entry point, `load(argument, *, seed=0, settings={}) -> Flight`, and a mapping `SETTINGS`
of what it understands. Nothing is opened, and no library of a format imported, before `load` is called; what
it returns is whole:

    streams   `Series` of SI signals by name: imu, vicon, magnetometer, gps, ...
    truth     `Series` of what is known to be right, where it is known; rows of NaN are masked out
    info      calibration and noise by name, and `absent`: by stream, how many samples were NaN
    notes     what was dropped, masked, shifted or assumed, a sentence each

`studentdata` reads the files of a course, `course` simulates flights in the same form, and `coursework` has
what the course asks of its students.

Rows out of order follow the setting `bad_time` (`tables.POLICIES`); values that cannot be of the unit that a
stream declares are refused.
"""

from __future__ import annotations

from flowgraph.blocks.datasets import (
    ardupilot,
    broad,
    course,
    csv_file,
    ese650,
    euroc,
    gins,
    kitti,
    navego,
    nmea,
    outdoor_quadrotor,
    px4,
    rob6213,
    rosbag,
    rtklib,
    studentdata,
    tum,
    umd,
)

__all__ = [
    "ardupilot",
    "broad",
    "course",
    "csv_file",
    "ese650",
    "euroc",
    "gins",
    "kitti",
    "navego",
    "nmea",
    "outdoor_quadrotor",
    "px4",
    "rob6213",
    "rosbag",
    "rtklib",
    "studentdata",
    "tum",
    "umd",
]
