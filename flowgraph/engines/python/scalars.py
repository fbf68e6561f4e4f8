"""Steps of scalars written out: what a block does to single numbers, as expressions of plain Python.

A NumPy scalar costs more than the addition that it takes part in. Where the recorded step of a block is
made of nothing but single numbers and operations that Python's own numbers do to the same bits, a loop need
not call it: the recorded list is the text. Such are sums, differences and products of reals (both are IEEE
doubles), comparisons, logic and selections, and counts within 32 or 64 bits, which wrap around as NumPy's
do. A quotient is not among them, which Python refuses where IEEE gives an infinity, nor is a function of a
library.
"""

from __future__ import annotations

import dis
import math
from collections.abc import Mapping, Sequence
from functools import partial
from types import BuiltinFunctionType, CellType, FunctionType
from typing import Any

import numpy as np

from flowgraph.language.block import Block
from flowgraph.language.capturing import is_own_function, names_read
from flowgraph.language.recording import StepTrace
from flowgraph.recorder.trace import Instruction
from flowgraph.types import ArrayType, Signal, StructType, Type, dtype_name, leaves_of

_NOT_STRAIGHT = (
    "POP_JUMP", "JUMP", "FOR_ITER", "RAISE", "STORE_GLOBAL", "STORE_ATTR", "STORE_SUBSCR", "STORE_DEREF",
    "DELETE", "IMPORT", "YIELD", "RETURN_GENERATOR", "SEND", "BEFORE_WITH", "MAKE_FUNCTION",
)  # fmt: skip
_PLAIN = (bool, int, float, str, np.generic, np.ndarray, np.ufunc, ArrayType, StructType, Signal)

KINDS = {"real": ("float", "real"), "bool": ("bool", "bool_"), "int32": ("int", "int32"),
         "int64": ("int", "int64")}  # fmt: skip
"""Kinds of single numbers that are written out: what makes one Python's, and what NumPy's."""

_REAL = {
    "add": "{0} + {1}", "subtract": "{0} - {1}", "multiply": "{0} * {1}", "square": "{0} * {0}",
    "negative": "-{0}", "positive": "{0}", "abs": "abs({0})",
}  # fmt: skip
_COMPARED = {
    "equal": "{0} == {1}", "not_equal": "{0} != {1}", "less": "{0} < {1}", "less_equal": "{0} <= {1}",
    "greater": "{0} > {1}", "greater_equal": "{0} >= {1}",
}  # fmt: skip
_LOGIC = {
    "logical_and": "{0} and {1}", "logical_or": "{0} or {1}", "logical_xor": "{0} != {1}",
    "logical_not": "not {0}", "bitwise_and": "{0} and {1}", "bitwise_or": "{0} or {1}",
    "bitwise_xor": "{0} != {1}", "bitwise_invert": "not {0}",
}  # fmt: skip
_WHOLE = {"add": "{0} + {1}", "subtract": "{0} - {1}", "multiply": "{0} * {1}"}
_ENDS = {"minimum": "min({0}, {1})", "maximum": "max({0}, {1})"}
_CASTS = {
    ("bool", "real"): "float({0})", ("int32", "real"): "float({0})", ("int64", "real"): "float({0})",
    ("bool", "int32"): "int({0})", ("bool", "int64"): "int({0})", ("int32", "int64"): "{0}",
}  # fmt: skip


def plain(type_: Type | None) -> bool:
    """Whether a value of this type is one number or several that can be written out."""
    return type_ is not None and all(not t.shape and t.dtype in KINDS for _, t in leaves_of(type_))


def expression(i: Instruction, kinds: Mapping[int, str]) -> str | None:
    """An instruction as an expression of its arguments {0}, {1}, ...; None where it must be called."""
    of = [kinds.get(a) for a in i.args]
    if i.spec.shape or i.spec.dtype not in KINDS or not all(k in KINDS for k in of):
        return None
    if i.op == "where":
        return "{1} if {0} else {2}" if of[0] == "bool" and of[1] == of[2] == i.spec.dtype else None
    if i.op == "astype":
        return "{0}" if of[0] == i.spec.dtype else _CASTS.get((str(of[0]), i.spec.dtype))
    if any(k != of[0] for k in of):
        return None
    if i.op in _COMPARED:
        return _COMPARED[i.op]
    if of[0] == "bool":
        return _LOGIC.get(i.op)
    if of[0] == "real":
        return _REAL.get(i.op) if i.spec.dtype == "real" else None
    if i.op in _ENDS:
        return _ENDS[i.op]
    half = 1 << (31 if of[0] == "int32" else 63)
    whole = _WHOLE.get(i.op)
    return None if whole is None else f"({whole} + {half}) % {2 * half} - {half}"


def written(
    step: Any, arguments: Sequence[Type | None], state: Type | None
) -> tuple[dict[int, str], list[tuple[Instruction, str]]] | None:
    """A recorded step as its constants by number, and the instructions that count, each with its expression.

    None where it has to be called: it was not recorded, draws, or is not of single numbers alone.
    """
    if not isinstance(step, StepTrace) or step.sites:
        return None
    trace = step.trace
    kinds: dict[int, str] = {step.time: "int64", step.dt: "real"}
    for type_, numbers in ((state, step.state), *zip(arguments, step.arguments, strict=True)):
        if numbers:
            if not plain(type_):
                return None
            assert type_ is not None
            kinds |= {n: leaf.dtype for n, (_, leaf) in zip(numbers, leaves_of(type_), strict=True)}
    constants = {}
    for number, array in trace.constants.items():
        if not array.shape and dtype_name(array) in KINDS:
            kinds[number] = dtype_name(array)
            value = array.item()
            finite = not isinstance(value, float) or math.isfinite(value)
            constants[number] = f"({value!r})" if finite else f"float({str(value)!r})"
    wanted = {n for o in step.outputs for n in (*o.leaves, o.presence) if isinstance(n, int)}
    wanted |= set(step.next_state)
    for i in reversed(trace.instructions):
        if i.out in wanted:
            wanted |= set(i.args)
    lines = []
    for i in trace.instructions:
        if i.out in wanted:
            form = expression(i, kinds)
            if form is None:
                return None
            kinds[i.out] = i.spec.dtype
            lines.append((i, form))
    return (constants, lines) if wanted <= set(kinds) else None


def silent(step: Any) -> bool:
    """Whether a function does nothing that its recorded list does not: nobody misses the call.

    So it is for a user's function that is one straight expression of its arguments, of numbers, and of
    functions that are so themselves. One that prints, branches on what it is handed, raises or writes is
    called. Functions of this package only hand on the functions that they were given.
    """
    if isinstance(step, FunctionType):
        held = [cell.cell_contents for cell in step.__closure__ or () if cell != CellType()]
        held += [*(step.__defaults__ or ()), *(step.__kwdefaults__ or {}).values()]
        if is_own_function(step):
            code, around = step.__code__, step.__globals__
            if any(i.opname.startswith(_NOT_STRAIGHT) for i in dis.get_instructions(code)):
                return False
            names = set(names_read(code)) - set(code.co_freevars)
            if not all(name in around for name in names):
                return False  # of Python itself, such as print
            held += [around[name] for name in names]
        return all(map(silent, held))
    if isinstance(step, Block):
        return silent(step.step)
    if isinstance(step, partial):
        return all(map(silent, (step.func, *step.args, *step.keywords.values())))
    if isinstance(step, BuiltinFunctionType):
        return step.__module__ == "_operator"
    if isinstance(step, tuple):
        return all(map(silent, step))
    return step is None or isinstance(step, _PLAIN)
