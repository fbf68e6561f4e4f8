"""The instructions of a pipeline: a fixed part of the array-API standard, each with one shape rule.

An `Op` says what the result's shape and dtype are, given those of its arguments and its attributes, and
how to compute it in a namespace (`numpy`, `jax.numpy`). Recording, the reference interpreter and every
backend read this one table, so an operation exists either everywhere or nowhere.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from flowgraph.recorder import ranges
from flowgraph.recorder.replay import Body, Turn, body_of, play
from flowgraph.recorder.specs import ShapeError as ShapeError
from flowgraph.recorder.specs import Spec as Spec
from flowgraph.types import DTYPES, dtype_name


@dataclass(frozen=True)
class Op:
    """One kind of instruction.

    Args:
        name: as in the array-API standard.
        rule: `(specs of the arguments, attributes) -> Spec` of the result; raises `ShapeError`.
        run: `(namespace, *arrays, **attributes) -> array`.
        operands: kind to which the arguments are brought first: "same", "real", "bool", "int" or "as is".
        local: whether the result at a place depends on the arguments at that place only.
    """

    name: str
    rule: Callable[..., Spec]
    run: Callable[..., Any]
    operands: str = "as is"
    local: bool = False

    @property
    def count(self) -> int | None:
        """How many arguments it takes; None: one or more."""
        kinds = [p.kind for p in inspect.signature(self.rule).parameters.values()]
        if inspect.Parameter.VAR_POSITIONAL not in kinds:
            return kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD)
        return None if self.name in ("concat", "stack") else 1 if self.name in _UNARY.split() else 2


_OF_ONE = "sqrt exp expm1 log log1p log2 sin cos tan asin acos atan sinh cosh tanh"
_OF_TWO = "atan2 hypot copysign"
SINC = "unnormalized_sinc"
"""sin(x) / x, and 1 at 0. NumPy's `sinc` is another function: of pi x."""

ASSUMED = ("gen", "pos")
"""What `solve` may be told of its matrix, by SciPy's names: nothing, or that it is symmetric and positive."""

FUNCTIONS = frozenset(f"{_OF_ONE} {_OF_TWO}".split())
"""Functions of real numbers; C has them under the same names."""

_UNARY = f"""abs negative sign square positive {_OF_ONE} {SINC} floor ceil round trunc logical_not
isfinite isnan bitwise_invert"""
"""Those among the operations element by element that take one argument; the others take two."""


_RANK = {"bool": 0, "uint32": 1, "int32": 1, "int64": 2, "uint64": 3, "real": 4}


def promote(*dtypes: str) -> str:
    """The kind of number that holds all of `dtypes`."""
    if {"uint32", "int32"} <= set(dtypes):
        dtypes = (*dtypes, "int64")
    return max(dtypes, key=_RANK.__getitem__)


def broadcast(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """The common shape under broadcasting."""
    rank = max(map(len, shapes), default=0)
    padded = [(1,) * (rank - len(s)) + s for s in shapes]
    out = []
    for sizes in zip(*padded, strict=True):
        wide = {n for n in sizes if n != 1}
        if len(wide) > 1:
            raise ShapeError(f"shapes {', '.join(map(str, shapes))} do not broadcast")
        out.append(wide.pop() if wide else 1)
    return tuple(out)


def _axis(axis: int, rank: int) -> int:
    if not -rank <= axis < rank:
        raise ShapeError(f"axis {axis} is outside an array of {rank} axes")
    return axis % rank


def _elementwise(dtype: str | None) -> Callable[..., Spec]:
    def rule(*args: Spec, **_: Any) -> Spec:
        return Spec(broadcast(*(a.shape for a in args)), dtype or promote(*(a.dtype for a in args)))

    return rule


_COUNTS = {"bool": "int64", "int32": "int64", "uint32": "uint64"}
"""What sums of small integers are kept in."""


def _numeric(*args: Spec) -> Spec:
    spec = Spec(broadcast(*(a.shape for a in args)), promote(*(a.dtype for a in args)))
    if spec.dtype == "bool":
        raise ShapeError("truth values are no numbers: convert with xp.astype, or use the logical operations")
    return spec


def _reduction(dtype: str | None, counted: bool = False) -> Callable[..., Spec]:
    def rule(x: Spec, *, axis: Any = None, keepdims: bool = False) -> Spec:
        axes = range(len(x.shape)) if axis is None else [axis] if isinstance(axis, int) else axis
        gone = {_axis(a, len(x.shape)) for a in axes}
        shape = tuple(1 if i in gone else n for i, n in enumerate(x.shape) if keepdims or i not in gone)
        kind = dtype or (_COUNTS.get(x.dtype, x.dtype) if counted else x.dtype)
        return Spec(shape, kind)

    return rule


def _single(dtype: str) -> Callable[..., Spec]:
    def rule(x: Spec, *, axis: int | None = None) -> Spec:
        if axis is None:
            return Spec((), dtype)
        gone = _axis(axis, len(x.shape))
        return Spec(x.shape[:gone] + x.shape[gone + 1 :], dtype)

    return rule


def _matmul(a: Spec, b: Spec) -> Spec:
    if not a.shape or not b.shape:
        raise ShapeError("matmul needs at least one axis on both sides")
    left = a.shape if len(a.shape) > 1 else (1, *a.shape)
    right = b.shape if len(b.shape) > 1 else (*b.shape, 1)
    if left[-1] != right[-2]:
        raise ShapeError(f"matmul of {a.shape} and {b.shape}: {left[-1]} columns meet {right[-2]} rows")
    tail = (left[-2:-1] if len(a.shape) > 1 else ()) + (right[-1:] if len(b.shape) > 1 else ())
    return Spec(broadcast(left[:-2], right[:-2]) + tail, promote(a.dtype, b.dtype))


def _square(x: Spec) -> Spec:
    if len(x.shape) < 2 or x.shape[-1] != x.shape[-2]:
        raise ShapeError(f"needs a square matrix, not {x.shape}")
    return x


def _solve(a: Spec, b: Spec, *, assume_a: str = "gen") -> Spec:
    if assume_a not in ASSUMED:
        raise ShapeError(f"solve assumes one of {', '.join(ASSUMED)}, not {assume_a!r}")
    _square(a)
    if len(b.shape) == 1:
        if b.shape[0] != a.shape[-1]:
            raise ShapeError(f"solve of {a.shape} with {b.shape}")
        return Spec((*a.shape[:-2], b.shape[0]), "real")
    if b.shape[-2] != a.shape[-1]:
        raise ShapeError(f"solve of {a.shape} with {b.shape}")
    return Spec((*broadcast(a.shape[:-2], b.shape[:-2]), *b.shape[-2:]), "real")


def _permute(x: Spec, *, axes: list[int]) -> Spec:
    if sorted(axes) != list(range(len(x.shape))):
        raise ShapeError(f"axes {axes} do not permute an array of {len(x.shape)} axes")
    return Spec(tuple(x.shape[a] for a in axes), x.dtype)


def _transpose(x: Spec) -> Spec:
    if len(x.shape) < 2:
        raise ShapeError(f"matrix_transpose needs two axes, not {x.shape}")
    return Spec((*x.shape[:-2], x.shape[-1], x.shape[-2]), x.dtype)


def _reshape(x: Spec, *, shape: list[int]) -> Spec:
    size = math.prod(x.shape)
    if shape.count(-1) == 1:
        rest = -math.prod(shape)
        shape = [size // rest if n == -1 and rest else n for n in shape]
    if math.prod(shape) != size:
        raise ShapeError(f"cannot reshape {x.shape} to {tuple(shape)}")
    return Spec(tuple(shape), x.dtype)


def _broadcast_to(x: Spec, *, shape: list[int]) -> Spec:
    if broadcast(x.shape, tuple(shape)) != tuple(shape):
        raise ShapeError(f"cannot broadcast {x.shape} to {tuple(shape)}")
    return Spec(tuple(shape), x.dtype)


def _concat(*xs: Spec, axis: int) -> Spec:
    along = _axis(axis, len(xs[0].shape))
    others = {x.shape[:along] + x.shape[along + 1 :] for x in xs}
    if len(others) > 1 or len({len(x.shape) for x in xs}) > 1:
        raise ShapeError(f"cannot concat {', '.join(str(x.shape) for x in xs)} along axis {axis}")
    shape = list(xs[0].shape)
    shape[along] = sum(x.shape[along] for x in xs)
    return Spec(tuple(shape), promote(*(x.dtype for x in xs)))


def _stack(*xs: Spec, axis: int) -> Spec:
    if len({x.shape for x in xs}) > 1:
        raise ShapeError(f"cannot stack {', '.join(str(x.shape) for x in xs)}")
    along = _axis(axis, len(xs[0].shape) + 1)
    shape = (*xs[0].shape[:along], len(xs), *xs[0].shape[along:])
    return Spec(shape, promote(*(x.dtype for x in xs)))


def _getitem(x: Spec, *, index: list[Any]) -> Spec:
    shape = []
    for size, entry in zip(x.shape, index, strict=True):
        if isinstance(entry, int):
            if not -size <= entry < size:
                raise ShapeError(f"index {entry} is outside an axis of size {size}")
        else:
            shape.append(len(range(*slice(*entry).indices(size))))
    return Spec(tuple(shape), x.dtype)


def _run_getitem(xp: Any, x: Any, *, index: list[Any]) -> Any:
    return x[tuple(e if isinstance(e, int) else slice(*e) for e in index)]


def _take(x: Spec, indices: Spec, *, axis: int) -> Spec:
    along = _axis(axis, len(x.shape))
    return Spec(x.shape[:along] + indices.shape + x.shape[along + 1 :], x.dtype)


def _cross(a: Spec, b: Spec) -> Spec:
    shape = broadcast(a.shape, b.shape)
    if not shape or shape[-1] != 3:
        raise ShapeError(f"cross needs vectors of length 3, not {a.shape} and {b.shape}")
    return Spec(shape, promote(a.dtype, b.dtype))


def _vecdot(a: Spec, b: Spec) -> Spec:
    if a.shape[-1:] != b.shape[-1:] or not a.shape:
        raise ShapeError(f"vecdot of {a.shape} and {b.shape}")
    return Spec(broadcast(a.shape, b.shape)[:-1], promote(a.dtype, b.dtype))


def _outer(a: Spec, b: Spec) -> Spec:
    if len(a.shape) != 1 or len(b.shape) != 1:
        raise ShapeError(f"outer needs two vectors, not {a.shape} and {b.shape}")
    return Spec((*a.shape, *b.shape), promote(a.dtype, b.dtype))


def _astype(x: Spec, *, dtype: str) -> Spec:
    return Spec(x.shape, dtype)


def _float32_bits(x: Spec) -> Spec:
    if x.dtype != "int32":
        raise ShapeError(f"float32_bits needs int32, not {x.dtype}")
    return x


def _along(x: Spec, axis: Any) -> Spec:
    for a in axis if isinstance(axis, list | tuple) else [] if axis is None else [axis]:
        _axis(a, len(x.shape))
    return x


def _same(x: Spec, **_: Any) -> Spec:
    return x


def _replay(history: Spec, rows: Spec, first: Spec, count: Spec, *, body: Any) -> Spec:
    if len(history.shape) != 2 or len(rows.shape) != 2 or history.shape[0] != rows.shape[0]:
        raise ShapeError(f"replay needs a row for each place, not {history.shape} and {rows.shape}")
    if (history.dtype, rows.dtype, first, count) != ("real", "real", Spec((), "int32"), Spec((), "int32")):
        raise ShapeError("replay needs a history and rows of reals, and the first place and a count in int32")
    _check_body(body_of(body), history.shape[1], rows.shape[1])
    return history


def _check_body(body: Body, before: int, row: int) -> None:
    """Refuse turns that are no lists of instructions from one vector to the next; once for each body."""
    if (before, row) in body.checked:
        return
    for case in body.cases:
        specs = {0: Spec((before,), "real"), 1: Spec((row,), "real")}
        specs |= {n: Spec(a.shape, dtype_name(a)) for n, a in case.constants.items()}
        for turn in case.turns:
            op = OPS.get(turn.op)
            if (
                op is None
                or turn.op == "replay"
                or turn.out in specs
                or any(a not in specs for a in turn.args)
            ):
                raise ShapeError(f"a turn of replay cannot do {turn.op}{list(turn.args)}")
            found = op.rule(*(specs[a] for a in turn.args), **turn.attrs)
            if found != turn.spec:
                raise ShapeError(f"{turn.op} in a turn of replay gives {found}, not {turn.spec}")
            specs[turn.out] = found
        if specs.get(case.result) != specs[0]:
            raise ShapeError(f"a turn of replay gives {specs.get(case.result)}, not {specs[0]}")
    body.checked.add((before, row))


def _int_of(x: Spec, v: Spec, *, side: str = "left") -> Spec:
    if len(x.shape) != 1:
        raise ShapeError(f"searchsorted needs a vector to search in, not {x.shape}")
    return Spec(v.shape, "int64")


def _where(c: Spec, a: Spec, b: Spec) -> Spec:
    return Spec(broadcast(c.shape, a.shape, b.shape), promote(a.dtype, b.dtype))


def _namespace(name: str) -> Callable[..., Any]:
    return lambda xp, *args, **attrs: getattr(xp, name)(*args, **attrs)


def _linalg(name: str) -> Callable[..., Any]:
    return lambda xp, *args, **attrs: getattr(xp.linalg, name)(*args, **attrs)


def _many(name: str) -> Callable[..., Any]:
    return lambda xp, *args, **attrs: getattr(xp, name)(args, **attrs)


def _run_int64(name: str) -> Callable[..., Any]:
    return lambda xp, *args, **attrs: getattr(xp, name)(*args, **attrs).astype(DTYPES["int64"])


def _run_astype(xp: Any, x: Any, *, dtype: Any) -> Any:
    return ranges.cast(xp, xp.asarray(x), dtype)


def _run_shape(name: str) -> Callable[..., Any]:
    return lambda xp, x, *, shape: getattr(xp, name)(x, tuple(shape))


def _run_axes(xp: Any, x: Any, *, axes: list[int]) -> Any:
    return xp.permute_dims(x, tuple(axes))


def _run_reduce(name: str) -> Callable[..., Any]:
    def run(xp: Any, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return getattr(xp, name)(x, axis=tuple(axis) if isinstance(axis, list) else axis, keepdims=keepdims)

    return run


def _run_replay(xp: Any, *args: Any, body: Any) -> Any:
    """In a namespace that has a loop of its own, by that; else in NumPy, turn by turn."""
    if hasattr(xp, "replay"):
        return xp.replay(*args, body=body)

    def bind(turn: Turn, real: Any) -> Callable[..., Any]:
        return partial(OPS[turn.op].run, xp, **bound_attrs(turn.op, turn.attrs, real))

    history, rows, first, count = args
    return play(history, rows, first, count, body, bind)


def _table() -> dict[str, Op]:
    ops: dict[str, Op] = {}

    def add(
        names: str, rule: Callable[..., Spec], operands: str, run: Callable[[str], Any] = _namespace
    ) -> None:
        for name in names.split():
            ops[name] = Op(name, rule, run(name), operands)

    def each(names: str, rule: Callable[..., Spec], operands: str) -> None:
        for name in names.split():
            ops[name] = Op(name, rule, _namespace(name), operands, local=True)

    each("add multiply maximum minimum abs", _elementwise(None), "same")
    each("subtract remainder floor_divide pow negative sign square positive", _numeric, "same")
    each(f"divide {_OF_TWO} {_OF_ONE} {SINC}", _elementwise("real"), "real")
    each("floor ceil round trunc", _numeric, "same")
    each("equal not_equal less less_equal greater greater_equal", _elementwise("bool"), "same")
    each("logical_and logical_or logical_xor logical_not", _elementwise("bool"), "bool")
    each("isfinite isnan", _elementwise("bool"), "real")
    each(
        "bitwise_and bitwise_or bitwise_xor bitwise_invert bitwise_left_shift bitwise_right_shift",
        _elementwise(None),
        "int",
    )
    each("where", _where, "as is")
    each("float32_bits", _float32_bits, "as is")
    each("materialise", _same, "as is")
    ops["astype"] = Op("astype", _astype, _run_astype, local=True)
    add("sum prod", _reduction(None, counted=True), "as is", _run_reduce)
    add("max min", _reduction(None), "as is", _run_reduce)
    add("mean", _reduction("real"), "real", _run_reduce)
    add("any all", _reduction("bool"), "bool", _run_reduce)
    add("argmax argmin", _single("int64"), "as is")
    add("sort", lambda x, *, axis=-1: _along(x, axis), "as is")
    add("flip", lambda x, *, axis=None: _along(x, axis), "as is")
    add("roll", lambda x, *, shift, axis=None: _along(x, axis), "as is")
    add("argsort", lambda x, *, axis=-1: Spec(_along(x, axis).shape, "int64"), "as is")
    add(
        "cumulative_sum",
        lambda x, *, axis: Spec(_along(x, axis).shape, _COUNTS.get(x.dtype, x.dtype)),
        "as is",
    )
    add("concat stack", _concat, "same", _many)
    ops["stack"] = Op("stack", _stack, _many("stack"), "same")
    add("matmul", _matmul, "same")
    add("matrix_transpose", _transpose, "as is")
    add("cholesky", _square, "real", _linalg)
    ops["solve"] = Op("solve", _solve, lambda xp, a, b, *, assume_a="gen": xp.linalg.solve(a, b), "real")
    add("cross", _cross, "same", _linalg)
    add("vecdot", _vecdot, "same", _linalg)
    add("outer", _outer, "same", _linalg)
    add("searchsorted", _int_of, "same", _run_int64)
    add("tril triu", lambda x, *, k=0: x, "as is")
    ops["permute_dims"] = Op("permute_dims", _permute, _run_axes)
    ops["reshape"] = Op("reshape", _reshape, _run_shape("reshape"))
    ops["broadcast_to"] = Op("broadcast_to", _broadcast_to, _run_shape("broadcast_to"))
    ops["getitem"] = Op("getitem", _getitem, _run_getitem)
    ops["replay"] = Op("replay", _replay, _run_replay)
    ops["take"] = Op("take", _take, lambda xp, x, i, *, axis: xp.take(x, i, axis=axis, mode="clip"))
    return ops


OPS = _table()
"""All instructions by name."""

ELEMENTWISE = frozenset(name for name, op in OPS.items() if op.local)
"""Operations whose result at a place depends on the arguments at that place only."""


def bound_attrs(op: str, attrs: dict[str, Any], real: Any) -> dict[str, Any]:
    """The attributes with kinds of number replaced by concrete dtypes; `real` is float64 or float32."""
    if "dtype" not in attrs:
        return attrs
    name = attrs["dtype"]
    return {**attrs, "dtype": real if name == "real" else DTYPES[name]}
