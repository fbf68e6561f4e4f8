"""Steps written out: what a block does, as lines of Python that need not call it.

The recorded list of a step is its text: an operation on arrays becomes a line that calls NumPy's function
itself, with nothing of the block around it, no signal to take apart and none to put together. Single numbers
are Python's own, which cost less than the addition that a NumPy scalar takes part in, where Python does the
same to the bit: sums, differences and products of reals (both are IEEE doubles), comparisons, logic,
selections, and counts within 32 or 64 bits, which wrap around as NumPy's do. A quotient is not among them,
which Python refuses where IEEE gives an infinity, nor is a function of a library.

What is known before the run is computed before it. What only one arm of a selection by a single number reads
stands under it, and is computed where it is taken: the places that a cloud would be drawn anew from, where it
is not.

Left to be called is what somebody would miss: a step that was not recorded, and a user's that does more than
its list says, as one that prints.
"""

from __future__ import annotations

import ast
import dis
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from functools import lru_cache, partial
from hashlib import blake2b
from types import BuiltinFunctionType, CellType, CodeType, FunctionType
from typing import Any

import numpy as np

from flowgraph.language.block import Block
from flowgraph.language.capturing import is_own_function, names_read
from flowgraph.language.recording import StepTrace
from flowgraph.pipeline.evaluate import evaluate
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import ELEMENTWISE, OPS, Spec, bound_attrs
from flowgraph.recorder.random import Site
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


_ARRAYS = {
    "add": "{0} + {1}", "subtract": "{0} - {1}", "multiply": "{0} * {1}", "divide": "{0} / {1}",
    "negative": "-{0}", "matmul": "{0} @ {1}", "matrix_transpose": "{0}.mT", "materialise": "{0}",
}  # fmt: skip
_REDUCED = {
    "sum": np.add.reduce, "max": np.maximum.reduce, "min": np.minimum.reduce,
    "any": np.logical_or.reduce, "all": np.logical_and.reduce,
}  # fmt: skip
_LIFTED = 1_000_000  # added to the number of a value, for the same as an array
_LINEAR = {"vecdot", "cholesky", "solve"}
_CALLED = ELEMENTWISE - {"astype", "float32_bits", "materialise"} | _LINEAR


@dataclass(frozen=True)
class Line:
    """An instruction as an expression of its arguments {0}, {1}, ...

    One with `arms` is a selection: its first argument says whether the lines of the first are gone through
    and {1} is taken, or those of the second and {2}.
    """

    instruction: Instruction
    form: str
    arms: tuple[list[Line], list[Line]] | None = None


@dataclass(frozen=True)
class Written:
    """A step as text.

    Args:
        constants: as text, by value number.
        lines: in their order.
        numbers: the values that are Python's numbers; all others are NumPy's.
        names: what the text needs. Operations are named by what they do and arrays by what they are, alike in
            all steps, and in all variants of one.
        scalars: the values of NumPy's without axes.
        shapes: of the values.
        sites: what is drawn, by the name of the function that gives it at a time.
    """

    constants: dict[int, str]
    lines: list[Line]
    numbers: set[int]
    names: dict[str, Any]
    scalars: set[int]
    shapes: dict[int, tuple[int, ...]]
    sites: dict[str, Site] = field(default_factory=dict)


def single(type_: ArrayType) -> bool:
    """Whether a leaf passes from block to block as a number of Python's."""
    return not type_.shape and type_.dtype in KINDS


def written(step: Any, arguments: Sequence[Type | None], state: Type | None) -> Written | None:
    """A recorded step as text; None where it has to be called."""
    if not isinstance(step, StepTrace):
        return None
    trace = step.trace
    made = Written({}, [], {step.time, step.dt}, {}, set(), {step.time: (), step.dt: ()})
    kinds: dict[int, str] = {step.time: "int64", step.dt: "real"}
    for type_, numbers in ((state, step.state), *zip(arguments, step.arguments, strict=True)):
        for n, (_, leaf) in zip(numbers or (), leaves_of(type_) if numbers and type_ else (), strict=True):
            kinds[n], made.shapes[n] = leaf.dtype, leaf.shape  # type: ignore[assignment]
            if single(leaf):
                made.numbers.add(n)
    known: dict[int, np.ndarray] = {}
    for n, array in trace.constants.items():
        _know(n, array, known, kinds, made)
    ends = {n for o in step.outputs for n in (*o.leaves, o.presence) if isinstance(n, int)}
    ends |= set(step.next_state)
    wanted = set(ends)
    for i in reversed(trace.instructions):
        if i.out in wanted:
            wanted |= set(i.args)
    for site, n in step.sites:
        if n in wanted:
            _drawn(site, n, kinds, made)
    first: dict[tuple[Any, ...], int] = {}  # what is computed twice, once
    same: dict[int, int] = {}
    for whole in trace.instructions:
        if whole.out in wanted:
            i = replace(whole, args=tuple(same.get(a, a) for a in whole.args))
            if all(a in known for a in i.args):
                _know(i.out, np.asarray(evaluate(i, *(known[a] for a in i.args))), known, kinds, made)
                continue
            kinds[i.out], made.shapes[i.out] = i.spec.dtype, tuple(i.spec.shape)
            again = first.setdefault((i.op, i.args, repr(i.attrs), i.spec), i.out)
            if again != i.out:
                same[i.out] = again
                if again in made.numbers:
                    made.numbers.add(i.out)
                if i.out in ends:
                    made.lines.append(Line(replace(i, args=(again,)), "{0}"))
                continue
            form = _number(i, kinds) if made.numbers.issuperset(i.args) else None
            if form is not None:
                made.numbers.add(i.out)
            elif not i.spec.shape:
                made.scalars.add(i.out)
            elif (chosen := _chosen(i, known, kinds, made)) is not None:
                made.lines.append(chosen)
                continue
            else:
                i = _with_arrays(i, kinds, made)
            made.lines.append(Line(i, form or _array(i, kinds, made)))
    return replace(made, lines=_under(made.lines, ends))


def _drawn(site: Site, n: int, kinds: dict[int, str], made: Written) -> None:
    """The line of a draw. What stands for the name in the counter is all that tells one from another."""
    kinds[n], made.shapes[n] = "real", site.shape
    name = "_".join(map(str, (f"q{site.hash}", site.kind, *site.shape)))
    made.sites[name] = site
    if not site.shape:
        made.numbers.add(n)
    line = Instruction("draw", (), {}, n, Spec(site.shape, "real"), "")
    made.lines.append(Line(line, f"{name}(t)" if site.shape else f"float({name}(t))"))


def _know(
    n: int, array: np.ndarray, known: dict[int, np.ndarray], kinds: dict[int, str], made: Written
) -> None:
    """Note a value that is known before the run."""
    known[n], kinds[n], made.shapes[n] = array, dtype_name(array), array.shape
    value = array.item() if not array.shape and kinds[n] in KINDS else None
    if value is not None and (not isinstance(value, float) or math.isfinite(value)):
        made.constants[n] = f"({value!r})"
        made.numbers.add(n)
    else:
        _name(n, array, made)


def _name(n: int, array: np.ndarray, made: Written) -> None:
    """Name a known array by what it is: a number of a value would mean another in a step's other variants."""
    which = repr((array.dtype.str, array.shape, array.strides)).encode() + array.tobytes()
    made.constants[n] = f"k_{blake2b(which, digest_size=12).hexdigest()}"
    made.names[made.constants[n]] = array


def _chosen(
    i: Instruction, known: dict[int, np.ndarray], kinds: dict[int, str], made: Written
) -> Line | None:
    """A selection of whole arrays by a single number: one of them as it is; None where it is another."""
    if i.op != "where" or made.shapes[i.args[0]]:
        return None
    args = [i.args[0]]
    for a in i.args[1:]:
        if kinds[a] != i.spec.dtype:
            return None
        if made.shapes[a] != tuple(i.spec.shape):
            if a not in known or known[a].shape:
                return None
            lifted = a + _LIFTED * (i.out + 2)
            _know(lifted, np.full(i.spec.shape, known[a]), known, kinds, made)
            a = lifted
        args.append(a)
    return Line(replace(i, args=tuple(args)), "{1} if {0} else {2}", ([], []))


def _under(lines: list[Line], ends: set[int]) -> list[Line]:
    """The lines, with those under a selection that only one of its arms reads."""
    readers: dict[int, set[tuple[int, int]]] = {}  # by value: who reads it, and as which argument
    for line in lines:
        for k, a in enumerate(line.instruction.args):
            readers.setdefault(a, set()).add((line.instruction.out, k))
    gone: set[int] = set()
    for at in range(len(lines) - 1, -1, -1):
        line = lines[at]
        if line.arms is None or line.instruction.out in gone:
            continue
        for k in (1, 2):
            inside: dict[int, Line] = {}
            for before in reversed(lines[:at]):
                out = before.instruction.out
                if out in ends or out in gone or out not in readers:
                    continue
                if all(r in inside or (r, n) == (line.instruction.out, k) for r, n in readers[out]):
                    inside[out] = before
            line.arms[k - 1].extend(reversed(inside.values()))
            gone |= inside.keys()
    return [line for line in lines if line.instruction.out not in gone]


def _number(i: Instruction, kinds: dict[int, str]) -> str | None:
    """An instruction on Python's numbers; None where Python might do another thing."""
    of = [kinds[a] for a in i.args]
    if i.spec.shape or i.spec.dtype not in KINDS or not of:
        return None
    if i.op == "where":
        return "{1} if {0} else {2}" if of[0] == "bool" and of[1] == of[2] == i.spec.dtype else None
    if i.op == "astype":
        return "{0}" if of[0] == i.spec.dtype else _CASTS.get((of[0], i.spec.dtype))
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


def _with_arrays(i: Instruction, kinds: dict[int, str], made: Written) -> Instruction:
    """The instruction, with arrays of no axes for the Python numbers that an array is combined with: NumPy
    takes twice as long over the others."""
    if i.op not in _ARRAYS or not i.spec.shape:
        return i
    given = []
    for a in i.args:
        if a in made.numbers and kinds[a] == "real":
            lifted = a + _LIFTED
            if a in made.constants:
                _name(lifted, np.asarray(ast.literal_eval(made.constants[a])), made)
            elif lifted not in kinds:
                spec = i.spec._replace(shape=())
                line = replace(i, op="asarray", args=(a,), attrs={}, out=lifted, spec=spec)
                made.lines.append(Line(line, "asarray({0})"))
            kinds[lifted] = "real"
            given.append(lifted)
        else:
            given.append(a)
    return replace(i, args=tuple(given))


def _array(i: Instruction, kinds: dict[int, str], made: Written) -> str:
    """An instruction on arrays, or on numbers of NumPy's."""
    places = [f"{{{k}}}" for k in range(len(i.args))]
    settings = repr(sorted(i.attrs.items())).encode()
    name = f"o_{i.op}" + (f"_{blake2b(settings, digest_size=8).hexdigest()}" if i.attrs else "")
    if not made.numbers.issuperset(i.args):
        if i.op in _ARRAYS and not i.attrs:
            return _ARRAYS[i.op]
        if i.op == "reshape" and i.args[0] in made.scalars:
            return f"{{0}}[{', '.join(['None'] * len(i.attrs['shape'])) or '()'}]"
        if i.op == "reshape":
            return f"{{0}}.reshape({tuple(i.attrs['shape'])})"
        if i.op == "getitem":
            return f"{{0}}[{_index(i.attrs['index'])}]"
    if (method := _method(i, kinds)) is not None and i.args[0] not in made.numbers | made.scalars:
        function = _REDUCED.get(i.op)
        made.names.update({} if function is None else {f"reduce_{i.op}": function})
        return method
    if i.op == "concat":
        return f"concatenate(({', '.join(places)},), {i.attrs['axis']})"
    called = i.op in _CALLED and i.attrs.keys() <= {"assume_a"}
    if i.op == "where" and made.shapes[i.args[0]]:
        name, made.names["o_each"] = "o_each", np.where
    elif called:
        made.names[name] = getattr(NUMPY.linalg if i.op in _LINEAR else NUMPY, i.op)
    else:
        made.names[name] = partial(OPS[i.op].run, NUMPY, **bound_attrs(i.op, i.attrs, np.float64))
    given = [
        f"{KINDS[kinds[a]][1]}({p})"
        if a in made.numbers and not (called and kinds[a] in ("real", "bool"))
        else p
        for p, a in zip(places, i.args, strict=True)
    ]  # a whole number of Python's says not how wide it is
    return f"{name}({', '.join(given)})"


def _method(i: Instruction, kinds: dict[int, str]) -> str | None:
    """An instruction as NumPy's own method or reduction; None where that might do another thing."""
    of, axis = kinds[i.args[0]] if i.args else "", i.attrs.get("axis")
    axis = tuple(axis) if isinstance(axis, list | tuple) else axis
    if i.op in _REDUCED and i.attrs.keys() <= {"axis", "keepdims"}:
        same = of == ("bool" if i.op in ("any", "all") else "real")
        return f"reduce_{i.op}({{0}}, {axis}, None, None, {i.attrs.get('keepdims', False)})" if same else None
    if i.op == "astype" and i.spec.dtype == "real":
        return "{0}.astype(real)"
    if i.op == "cumulative_sum" and of in ("real", "int64") and i.attrs.keys() == {"axis"}:
        return f"{{0}}.cumsum({axis})"
    if i.op == "take" and i.attrs.keys() == {"axis"}:
        return f'{{0}}.take({{1}}, {axis}, None, "clip")'
    return None


def _index(entries: Sequence[Any]) -> str:
    """An index as text; what takes the whole of the last axes is left out, since it is the same view."""
    kept = list(entries)
    while len(kept) > 1 and kept[-1] == [None, None, None]:
        kept.pop()
    return ", ".join(
        str(e) if isinstance(e, int) else ":".join("" if part is None else str(part) for part in e)
        for e in kept
    )


@lru_cache(maxsize=256)
def _straight(code: CodeType) -> bool:
    """Whether a function is one expression without branches, loops and writes."""
    return not any(i.opname.startswith(_NOT_STRAIGHT) for i in dis.get_instructions(code))


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
            if not _straight(code):
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
    return step is None or isinstance(step, _PLAIN) or is_dataclass(step)
