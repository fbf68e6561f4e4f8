"""Filters as graphs: one file each, short enough to read beside its paper."""

from flowgraph.graphs.async_kalman import async_kalman
from flowgraph.graphs.ekf import ekf
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.kalman import kalman
from flowgraph.graphs.rbpf_indoor import rbpf_indoor

__all__ = ["async_kalman", "ekf", "kalman", "ins_eskf", "rbpf_indoor"]
