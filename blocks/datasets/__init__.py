"""Recorded flights: a loader a family of files, each `load(argument, *, seed=0, settings={}) -> Flight`."""
