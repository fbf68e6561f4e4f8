"""Fixed point: a pipeline's instructions in integers, each value with a number format of its own.

A real number x is kept as the whole number x 2^f, of `width` bits with its sign; f is chosen for each
element of each value and may be larger than the width, or negative (`flowgraph.pipeline.formats`). What an
operation gives is rounded to the nearest, half upwards, and saturates. The integers here are the definition
of fixed point: generated C and hardware are equal to them to the bit.
"""

from flowgraph.engines.fixed.engine import ENGINE, FixedEngine

__all__ = ["ENGINE", "FixedEngine"]
