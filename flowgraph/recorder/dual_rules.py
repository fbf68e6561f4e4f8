"""The derivative of each operation of a pipeline: one rule an operation, in the order of the table of `ops`.

A rule is handed the values and the tangents of the arguments, and gives the value and the tangent of the
result. What is constant from place to place (a comparison, a rounding, an index) has no tangent.

Where a value is finite, so is its derivative: at a point at which a function has a kink, the rule takes a
slope between those on both sides (0 for `abs` and `hypot` at 0), a guard such as `maximum(x, 1e-30)` or
`clip` counts as holding where its bound is met, and where the slope has no bound (`sqrt` at 0, `acos` at 1)
it is a very large number, so that a change of 0 stays 0.

Source: A. Griewank and A. Walther, "Evaluating Derivatives", 2nd ed., SIAM 2008, secs. 2.2, 3.1, 14 (kinks);
for matrices M. Giles, "Collected matrix derivative results for forward and reverse mode algorithmic
differentiation", 2008, and I. Murray, "Differentiation of the Cholesky decomposition", arXiv:1602.07527,
2016.
"""

from __future__ import annotations

from flowgraph.recorder.dual_elements import ELEMENTWISE
from flowgraph.recorder.dual_moves import MOVES
from flowgraph.recorder.dual_products import PRODUCTS
from flowgraph.recorder.tangents import Rule, plain

_STEPS = """sign floor ceil round trunc floor_divide equal not_equal less less_equal greater greater_equal
logical_and logical_or logical_xor logical_not isfinite isnan any all argmax argmin argsort searchsorted"""


def _constant(name: str) -> Rule:
    """The same from place to place: no tangent."""
    return lambda xp, values, tangents, **attrs: (plain(xp, name)(*values, **attrs), {})


RULES: dict[str, Rule] = {
    **{name: _constant(name) for name in _STEPS.split()},
    **ELEMENTWISE,
    **MOVES,
    **PRODUCTS,
}
"""The rule of each operation that takes real numbers."""
