"""Experiments: each a function of keyword settings that returns a `Report`, found by `flowgraph bench`."""
