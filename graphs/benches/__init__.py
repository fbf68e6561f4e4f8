"""Experiments over the graphs of the library, found by name through `flowgraph.benches`."""
