"""Filters as graphs: one file each, short enough to read beside its paper."""

from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.rbpf_indoor import rbpf_indoor

__all__ = ["ins_eskf", "rbpf_indoor"]
