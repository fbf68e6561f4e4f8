"""How many cycles the machine takes for what: the registers of `machine/*.v`, as its programs know them.

These numbers stand here alone. What the Verilog needs of them it is given as parameters; where a number is
how many registers lie one behind the other in it, `tests/engines/verilog/test_latency.py` measures that.
"""

from __future__ import annotations

FETCH = 6
"""From the number of a step to its microword."""

LATENCY = 25
"""From the microword that writes a word to the first that can read it."""

DEEP = 4
"""More where the memory is several blocks deep, or has banks; `SPARE_DEEP` of them it does not need."""

SPARE_DEEP = 1
"""Cycles that a word of a deep memory is there before a program reads it: with 3 for `DEEP` rounds have
lengths at which fewer elements are made at a time, and `rbpf_indoor` with 10 particles takes 11 % longer."""

AHEAD = 4
"""More until an index can be read: the places of words are worked out before they are read."""

UNIT_LATENCY = {"divide": 49, "root": 49, "logarithm": 197, "angle": 97}
"""From the microword that starts a unit to the first that can take what it made."""

READ = 3
"""From a place that the host asks for to its word."""

READ_DEEP = READ + DEEP - SPARE_DEEP
"""The same where the memory is deep."""

_MARGIN = 3


def drained(rows: bool) -> int:
    """From the last microword of a run until the machine is ready: all that was begun is written.

    Args:
        rows: whether there are indices.
    """
    return LATENCY + DEEP + AHEAD * rows + _MARGIN


__all__ = ["AHEAD", "DEEP", "FETCH", "LATENCY", "READ", "READ_DEEP", "SPARE_DEEP", "UNIT_LATENCY", "drained"]
