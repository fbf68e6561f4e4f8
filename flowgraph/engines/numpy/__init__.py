"""The instructions in NumPy, each over all ticks of a recording at once: quick, and without a compiler.

A value is an array whose last axis is the ticks. `guards` tells in which ticks a value bears on anything, so
that what fires once is computed once; `plan` puts values in order across ticks, where a register that holds
what came last, or sums what comes, is one pass over its ticks, and what loops in another way is played tick
by tick; `rules` has each operation with that axis; `steps` does what was planned.
"""
