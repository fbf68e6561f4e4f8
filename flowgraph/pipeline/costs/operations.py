"""Operations of an instruction by kind, and how many of them wait for one another.

Counts are of scalar operations on the sizes of the list: a product of matrices is a multiplication a term and
an addition fewer, a factorization what the textbook says (G. Golub, C. Van Loan, "Matrix Computations", 2013,
secs. 3.2, 4.2). Depths are of the shallowest circuit: sums are trees.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

from flowgraph.pipeline.optimise.elements import MOVES
from flowgraph.pipeline.pipeline import kind_of
from flowgraph.recorder.ops import ELEMENTWISE, FUNCTIONS, SINC, Spec
from flowgraph.recorder.replay import body_of
from flowgraph.recorder.trace import Instruction

KINDS = (
    "multiply",
    "add",
    "divide",
    "root",
    "function",
    "compare",
    "integer multiply",
    "integer add",
    "logic",
)
"""What is counted. Minimum, maximum and `where` compare, shifts and truth values are logic."""

_COMPARE = """
maximum minimum equal not_equal less less_equal greater greater_equal isfinite isnan where sign"""
_LOGIC = """
logical_and logical_or logical_xor logical_not bitwise_and bitwise_or bitwise_xor bitwise_invert
bitwise_left_shift bitwise_right_shift"""
_ADD = "add subtract negative abs floor ceil round trunc positive copysign"
_KIND = (
    dict.fromkeys((*FUNCTIONS, "pow"), "function")
    | dict.fromkeys(_COMPARE.split(), "compare")
    | dict.fromkeys(_LOGIC.split(), "logic")
    | dict.fromkeys(_ADD.split(), "add")
    | {"multiply": "multiply", "square": "multiply", "divide": "divide", "sqrt": "root"}
    | {"remainder": "divide", "floor_divide": "divide"}
)
_FREE = MOVES | {"astype", "materialise", "float32_bits", "take"}
"""Operations that only move numbers, or change how they are written."""


def operations(i: Instruction, specs: Mapping[int, Spec]) -> Counter[str]:
    """How many scalar operations of each kind an instruction takes."""
    size = math.prod(i.spec.shape)
    first = specs[i.args[0]] if i.args else i.spec
    found: Counter[str] = Counter()
    if i.op in _FREE or not size:
        return found
    if i.op == "replay":
        return Counter({kind: first.shape[0] * n for kind, n in _longest_turn(i, specs)[0].items()})
    real = first.dtype == "real" or i.spec.dtype == "real"
    if i.op == SINC:
        found.update(function=size, divide=size, compare=size)
    elif i.op == "hypot":
        found.update(multiply=2 * size, add=size, root=size)
    elif i.op in ELEMENTWISE:
        found[_KIND[i.op]] = size
    elif i.op in ("matmul", "vecdot", "outer", "cross"):
        terms = {"outer": 1, "cross": 2}.get(i.op, first.shape[-1] if first.shape else 1)
        found.update(multiply=size * terms, add=size * (terms - 1))
    elif i.op == "cholesky":
        n, batch = first.shape[-1], math.prod(first.shape[:-2])
        inner = (n**3 - n) // 6
        found.update(
            multiply=batch * inner, add=batch * inner, divide=batch * n * (n - 1) // 2, root=batch * n
        )
    elif i.op == "solve":
        n, batch = first.shape[-1], math.prod(first.shape[:-2])
        inner = (n - 1) * n * (2 * n - 1) // 6 * batch + size * (n - 1)
        divide, compare = size + batch * n * (n - 1) // 2, batch * n * (n - 1) // 2
        if i.attrs.get("assume_a") == "pos":  # half of the elimination, and no search for a pivot
            inner, compare = (n**3 - n) // 6 * batch + size * (n - 1), 0
        found.update(multiply=inner, add=inner, divide=divide, compare=compare)
    else:
        found.update(_over_axis(i.op, math.prod(first.shape), size, specs[i.args[-1]]))
    return found if real else Counter({_INTEGER.get(k, k): n for k, n in found.items()})


def _longest_turn(i: Instruction, specs: Mapping[int, Spec]) -> tuple[Counter[str], int]:
    """The operations of a turn of a replay, in the case that has most, and the longest chain of any."""
    most: Counter[str] = Counter()
    longest = 0
    for case in body_of(i.attrs["body"]).cases:
        row, known = (Spec(specs[a].shape[1:], "real") for a in i.args[:2]), dict[int, Spec]()
        known.update(enumerate(row))
        known |= {n: Spec(a.shape, kind_of(a)) for n, a in case.constants.items()}
        found: Counter[str] = Counter()
        ends: dict[int, int] = {}
        for t in case.turns:
            one = Instruction(t.op, t.args, t.attrs, t.out, t.spec, t.line)
            found += operations(one, known)
            ends[t.out] = depth(one, known) + max((ends.get(a, 0) for a in t.args), default=0)
            known[t.out] = t.spec
        most = max(most, found, key=lambda counts: counts.total())
        longest = max(longest, ends.get(case.result, 0))
    return most, longest


_INTEGER = {"multiply": "integer multiply", "add": "integer add", "divide": "divide"}


def _over_axis(op: str, given: int, size: int, last: Spec) -> dict[str, int]:
    """Reductions, scans, sorting and searching."""
    fewer = max(given - size, 0)
    if op in ("sum", "mean"):
        return {"add": fewer, "divide": size if op == "mean" else 0}
    if op in ("max", "min", "argmax", "argmin"):
        return {"compare": fewer}
    if op in ("any", "all"):
        return {"logic": fewer}
    if op == "prod":
        return {"multiply": fewer}
    if op == "cumulative_sum":
        return {"add": given}
    if op in ("sort", "argsort"):
        return {"compare": given * _levels(given)}
    if op == "searchsorted":
        return {"compare": math.prod(last.shape) * _levels(given + 1)}
    raise NotImplementedError(op)


def depth(i: Instruction, specs: Mapping[int, Spec]) -> int:
    """How many of an instruction's operations wait for one another."""
    if i.op in _FREE:
        return 0
    first = specs[i.args[0]].shape if i.args else ()
    if i.op == "replay":
        return first[0] * _longest_turn(i, specs)[1]
    if i.op in ELEMENTWISE:
        return {"hypot": 3, SINC: 3}.get(i.op, 1)
    if i.op in ("matmul", "vecdot"):
        return 1 + _levels(first[-1])
    if i.op in ("outer", "cross"):
        return {"outer": 1, "cross": 2}[i.op]
    if i.op == "cholesky":  # a column: products, their sum, a root, a quotient
        return sum((1 + _levels(k + 1) if k else 0) + 2 for k in range(first[-1]))
    if i.op == "solve":  # a column: the pivot, a quotient, a product, a difference; then back
        n = first[-1]
        return sum(_levels(n - k) + 3 for k in range(n)) + sum(1 + _levels(k + 1) + 1 for k in range(n))
    gone = max(math.prod(first) // max(math.prod(i.spec.shape), 1), 1)
    levels = _levels(math.prod(first))
    if i.op in ("sort", "argsort"):
        return levels * (levels + 1) // 2
    if i.op in ("cumulative_sum", "searchsorted"):
        return levels
    return _levels(gone) + (i.op == "mean")


def _levels(n: int) -> int:
    """The depth of a binary tree over n."""
    return math.ceil(math.log2(n)) if n > 1 else 0
