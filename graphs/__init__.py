"""Filters as graphs: one file each, short enough to read beside its paper."""

from flowgraph.graphs.ins_eskf import ins_eskf

__all__ = ["ins_eskf"]
