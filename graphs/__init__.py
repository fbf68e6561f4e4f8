"""Filters as graphs: one file each, short enough to read beside its paper."""

from flowgraph.graphs.async_kalman import async_kalman
from flowgraph.graphs.augmented_complementary import augmented_complementary
from flowgraph.graphs.complementary import complementary
from flowgraph.graphs.ekf import ekf
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.kalman import kalman
from flowgraph.graphs.orientation_complementary import orientation_complementary
from flowgraph.graphs.outdoor_eskf import outdoor_eskf
from flowgraph.graphs.particle import particle
from flowgraph.graphs.rbpf_indoor import rbpf_indoor
from flowgraph.graphs.rbpf_outdoor import rbpf_outdoor

__all__ = [
    "complementary",
    "orientation_complementary",
    "augmented_complementary",
    "async_kalman",
    "ekf",
    "kalman",
    "ins_eskf",
    "particle",
    "rbpf_indoor",
    "outdoor_eskf",
    "rbpf_outdoor",
]
