"""Filters as graphs: one file each, short enough to read beside its paper."""

from flowgraph.graphs.async_kalman import async_kalman
from flowgraph.graphs.augmented_complementary import augmented_complementary
from flowgraph.graphs.complementary import complementary
from flowgraph.graphs.ekf import ekf
from flowgraph.graphs.imu_calibration import imu_calibration
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.kalman import kalman
from flowgraph.graphs.marg import marg
from flowgraph.graphs.orientation_complementary import orientation_complementary
from flowgraph.graphs.rbpf_indoor import rbpf_indoor

__all__ = [
    "complementary",
    "orientation_complementary",
    "augmented_complementary",
    "async_kalman",
    "ekf",
    "kalman",
    "imu_calibration",
    "ins_eskf",
    "marg",
    "rbpf_indoor",
]
