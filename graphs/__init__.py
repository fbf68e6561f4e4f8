"""Filters as graphs: one file each, short enough to read beside its paper.

A graph is imported when it is first asked for, so that who runs one filter waits for no other.
"""

import sys as _sys
from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING

from flowgraph.moved import Package as _Package

if _TYPE_CHECKING:
    from flowgraph.graphs.async_kalman import async_kalman
    from flowgraph.graphs.attitude_mekf import attitude_mekf
    from flowgraph.graphs.augmented_complementary import augmented_complementary
    from flowgraph.graphs.complementary import complementary
    from flowgraph.graphs.ekf import ekf
    from flowgraph.graphs.gnss_ins import gnss_ins
    from flowgraph.graphs.gyro_integration import gyro_integration
    from flowgraph.graphs.imu_calibration import imu_calibration
    from flowgraph.graphs.ins_ekf_pose import ins_ekf_pose
    from flowgraph.graphs.ins_eskf import ins_eskf
    from flowgraph.graphs.ins_particle import ins_particle
    from flowgraph.graphs.ins_ukf_pose import ins_ukf_pose
    from flowgraph.graphs.ins_ukf_velocity import ins_ukf_velocity
    from flowgraph.graphs.kalman import kalman
    from flowgraph.graphs.marg import marg
    from flowgraph.graphs.orientation_complementary import orientation_complementary
    from flowgraph.graphs.outdoor_eskf import outdoor_eskf
    from flowgraph.graphs.particle import particle
    from flowgraph.graphs.quaternion_ukf import quaternion_ukf
    from flowgraph.graphs.rbpf_indoor import rbpf_indoor
    from flowgraph.graphs.rbpf_outdoor import rbpf_outdoor
    from flowgraph.graphs.roll_pitch import roll_pitch
    from flowgraph.graphs.tag_pose import tag_pose
    from flowgraph.graphs.tracker import tracker
    from flowgraph.graphs.ukf import ukf

__all__ = [
    "complementary",
    "orientation_complementary",
    "augmented_complementary",
    "async_kalman",
    "ekf",
    "kalman",
    "imu_calibration",
    "ins_eskf",
    "gnss_ins",
    "marg",
    "attitude_mekf",
    "rbpf_indoor",
    "ukf",
    "tag_pose",
    "ins_ekf_pose",
    "ins_ukf_pose",
    "ins_ukf_velocity",
    "ins_particle",
    "quaternion_ukf",
    "roll_pitch",
    "gyro_integration",
    "particle",
    "tracker",
    "outdoor_eskf",
    "rbpf_outdoor",
]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(_import_module(f"{__name__}.{name}"), name)
    return found


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))


_sys.modules[__name__].__class__ = _Package
