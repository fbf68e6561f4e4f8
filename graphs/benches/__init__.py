"""Experiments over the graphs: each a function of settings that returns a table, one module each."""
