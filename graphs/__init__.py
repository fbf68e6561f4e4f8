"""Filters as graphs: one file each, short enough to read beside its paper."""

from flowgraph.graphs.async_kalman import async_kalman
from flowgraph.graphs.augmented_complementary import augmented_complementary
from flowgraph.graphs.complementary import complementary
from flowgraph.graphs.ekf import ekf
from flowgraph.graphs.gyro_integration import gyro_integration
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.kalman import kalman
from flowgraph.graphs.orientation_complementary import orientation_complementary
from flowgraph.graphs.quaternion_ukf import quaternion_ukf
from flowgraph.graphs.rbpf_indoor import rbpf_indoor
from flowgraph.graphs.roll_pitch import roll_pitch
from flowgraph.graphs.ukf import ukf

__all__ = [
    "complementary",
    "orientation_complementary",
    "augmented_complementary",
    "async_kalman",
    "ekf",
    "kalman",
    "ins_eskf",
    "rbpf_indoor",
    "ukf",
    "quaternion_ukf",
    "roll_pitch",
    "gyro_integration",
]
