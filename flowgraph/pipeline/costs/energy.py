"""Energy of a tick, from a table of what an operation takes in a chip.

The table is for 45 nm at 0.9 V and 32-bit numbers: M. Horowitz, "Computing's energy problem (and what we can
do about it)", ISSCC 2014, figure 1.1.9. It is of arithmetic and memories alone, without control, clock and
leakage, which make a processor 10 to 100 times as hungry: a lower bound, good for comparing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

SOURCE = "M. Horowitz, ISSCC 2014, fig. 1.1.9: 45 nm, 0.9 V, 32-bit numbers"

PICOJOULES = {"multiply": 3.7, "add": 0.9, "integer multiply": 3.1, "integer add": 0.1}
"""An operation of 32 bits."""

ACCESS = ((8 * 1024, 5.0), (32 * 1024, 10.0), (1024 * 1024, 50.0))
"""An access of 32 bits to a memory of at most so many bytes, pJ: half of what the table has for 64 bits."""

EXPANSION: dict[str, dict[str, int]] = {
    "divide": {"multiply": 5, "add": 4},
    "root": {"multiply": 8, "add": 2},
    "function": {"multiply": 9, "add": 9},
    "compare": {"integer add": 1},
    "logic": {"integer add": 1},
}
"""What the table does not have, in terms of what it has. Quotient: two Newton steps for the reciprocal from
an 8-bit table, and a product. Root: the same for the reciprocal root, three products a step and two more.
Function: a polynomial of degree 7 after a reduction of range. A comparison or a logical operation counts as
an addition of integers, which is more than it takes."""


def expanded(counts: Mapping[str, int]) -> Counter[str]:
    """Operations, in kinds that the table has."""
    found: Counter[str] = Counter()
    for kind, n in counts.items():
        for simple, factor in EXPANSION.get(kind, {kind: 1}).items():
            found[simple] += n * factor
    return found


def arithmetic_pj(counts: Mapping[str, int]) -> float:
    """Energy of operations, pJ."""
    return sum(PICOJOULES[kind] * n for kind, n in expanded(counts).items())


def access_pj(words: int, memory_bytes: int) -> float:
    """Energy of accesses to 32-bit words of a memory of that size, pJ; above 1 MB that of 1 MB."""
    for largest, pj in ACCESS:
        if memory_bytes <= largest:
            return words * pj
    return words * ACCESS[-1][1]
