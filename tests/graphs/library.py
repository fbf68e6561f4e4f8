"""A short flight for every graph of the library that lowers, for tests that go over all of them."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from flowgraph import Case
from flowgraph.cli.options import case_of
from flowgraph.data.registry import graph_names
from tests.blocks.datasets.test_datasets import course

ON_HOST = {"tag_pose"}
"""PnP is a host block, so the graph plays in Python."""

LIBRARY = [name for name in graph_names() if name not in ON_HOST]

_THESIS = "sensors=imu,gps,gps2,altimeter,magnetometer,optical_flow"
_FEW = "particles=60"

OWN = {
    "orientation_complementary": ("sim:thesis", ["sensors=gyro,coordinate_acceleration,thrust"]),
    "attitude_mekf": ("sim:thesis", ["sensors=body_rate,magnetic_attitude"]),
    "outdoor_eskf": ("sim:thesis", [_THESIS]),
    "gnss_ins": ("sim:drive", ["gps.rate=5", "sensors=gps,gps_velocity,magnetometer,barometer"]),
    "rbpf_outdoor": ("sim:thesis", [_THESIS, _FEW]),
    "rbpf_indoor": ("sim", [_FEW]),
    "marg": ("sim:thesis", ["sensors=imu,magnetometer"]),
    "particle": ("sim:plane", [_FEW]),
    "tracker": ("sim:plane", []),
    "ins_ekf_pose": ("course", []),
    "ins_ukf_pose": ("course", []),
    "ins_ukf_velocity": ("course", []),
    "ins_particle": ("course", [_FEW]),
}
"""The flight of a graph, and settings, where it is not `sim`."""


@cache
def library_case(name: str, duration: float = 1.0) -> Case:
    """The graph on `duration` seconds of a flight that has what it needs."""
    if name == "imu_calibration":
        with tempfile.TemporaryDirectory() as folder:
            for n in (1, 2):  # one calibrates the other
                course(Path(folder), n, seconds=max(duration, 4.0))
            return case_of(name, f"ese650:{folder}:1", [], 0)[0]
    data, settings = OWN.get(name, ("sim", []))
    return case_of(name, data, [f"duration={duration:g}", *settings], 0)[0]
