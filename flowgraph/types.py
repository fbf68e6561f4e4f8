"""Signal types: what a wire carries.

A leaf is an array of fixed shape, with a kind of number, a unit and a frame. A `Signal` is a small
frozen struct of leaves (or of other signals) with a name of its own, so that two quantities that only
look alike, such as specific force and coordinate acceleration, are different types. A tuple of signals
is a type too. Everything that moves through a graph, and every register in it, has such a type; a value
of it is flattened to its leaves in declaration order and put together again from them.

`real` becomes float64 or float32 when a run is started. A size may be a name (`real("N", 3)`), which is
bound when the graph is built.
"""

from __future__ import annotations

import inspect
import types as _pytypes
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, TypeAlias, dataclass_transform, get_args, get_origin

import numpy as np

from flowgraph.errors import DeclarationError, TypeMismatchError

Array: TypeAlias = Any
"""An array of any array-API namespace: NumPy in simulation, symbolic when lowered."""

DTYPES = {
    "real": np.float64,
    "bool": np.bool_,
    "int32": np.int32,
    "int64": np.int64,
    "uint32": np.uint32,
    "uint64": np.uint64,
}


@dataclass(frozen=True)
class ArrayType:
    """The type of one leaf: `shape`, kind of number, `unit` and `frame` (None: not stated, fits any).

    `axes` keeps the names of symbolic sizes once they are bound: axes along which work is parallel.
    """

    shape: tuple[int | str, ...] = ()
    dtype: str = "real"
    unit: str | None = None
    frame: str | None = None
    axes: tuple[str | None, ...] = field(default=(), compare=False)

    def __str__(self) -> str:
        size = f"[{','.join(map(str, self.shape))}]" if self.shape else ""
        return ", ".join([self.dtype + size, *(p for p in (self.unit, self.frame) if p)])


@dataclass(frozen=True)
class StructType:
    """The type of a `Signal` subclass, a tuple or a dict: named fields in order."""

    name: str
    fields: tuple[tuple[str, Type], ...]
    cls: type

    def __str__(self) -> str:
        if self.cls is tuple:
            return "(" + ", ".join(str(f) for _, f in self.fields) + ")"
        return self.name


Type: TypeAlias = ArrayType | StructType


def real(*shape: int | str, unit: str | None = None, frame: str | None = None) -> Any:
    """A leaf of real numbers: `real(3, unit="m/s", frame="world")`; no shape means a scalar."""
    return ArrayType(shape, "real", unit, frame)


def boolean(*shape: int | str) -> Any:
    """A leaf of truth values."""
    return ArrayType(shape, "bool")


def integer(*shape: int | str, dtype: str = "int32", unit: str | None = None) -> Any:
    """A leaf of integers: `dtype` is "int32", "int64" or "uint32"."""
    return ArrayType(shape, dtype, unit)


Scalar = Annotated[Any, ArrayType()]
"""A real scalar without a unit, for annotations: `Stream[Scalar]`."""


Tick = Annotated[Any, ArrayType((), "bool")]
"""What a source that only keeps time carries: `Stream[Tick]`."""


@dataclass_transform(frozen_default=True, field_specifiers=(real, boolean, integer))
class Signal:
    """Base class of signal types: a frozen struct of fixed-shape arrays.

    Declare fields as in a dataclass; each is a leaf or another signal:

        class Imu(Signal):
            gyro: Array = real(3, unit="rad/s", frame="body")
            specific_force: Array = real(3, unit="m/s^2", frame="body")

    A value is made with `Imu(gyro=..., specific_force=...)`; leading batch axes are allowed on all fields.
    """

    _fields: typing.ClassVar[tuple[str, ...]] = ()
    _leaf_types: typing.ClassVar[dict[str, ArrayType]] = {}

    def __init_subclass__(cls) -> None:
        leaves = dict(cls._leaf_types)
        names = list(cls._fields)
        for name in inspect.get_annotations(cls):
            default = cls.__dict__.get(name)
            if isinstance(default, ArrayType):
                leaves[name] = default
                delattr(cls, name)
            elif default is not None:
                raise DeclarationError(
                    f"field {name!r} is not declared as a leaf",
                    path=cls.__name__,
                    expected="real(...), boolean(...), integer(...) or the annotation of another Signal",
                    got=repr(default),
                    fix=f"write {name}: Array = real(3, unit=..., frame=...)",
                )
            names.append(name)
        cls._fields, cls._leaf_types = tuple(names), leaves
        body = "\n".join(["  __fields = __self.__dict__", *(f"  __fields[{n!r}] = {n}" for n in names)])
        scope: dict[str, Any] = {}
        exec(f"def __init__(__self, {', '.join(names)}):\n{body}", scope)  # as dataclasses does
        cls.__init__ = scope["__init__"]  # type: ignore[method-assign]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{type(self).__name__} is immutable: use .replace({name}=...)")

    def replace(self, **fields: Array) -> typing.Self:
        """A copy with some fields exchanged."""
        return type(self)(**{**self.__dict__, **fields})

    def __repr__(self) -> str:
        inside = ", ".join(f"{n}={getattr(self, n)!r}" for n in self._fields)
        return f"{type(self).__name__}({inside})"


def struct_type(cls: type[Signal]) -> StructType:
    """The type of a `Signal` subclass."""
    cached = cls.__dict__.get("_struct_type")
    if cached is None:
        hints = typing.get_type_hints(cls, include_extras=True)
        fields: list[tuple[str, Type]] = []
        for name in cls._fields:
            declared = cls._leaf_types.get(name) or annotation_type(hints[name])
            if declared is None:
                raise DeclarationError(
                    f"field {name!r} has no type",
                    path=cls.__name__,
                    expected="a leaf or another Signal",
                    got=repr(hints[name]),
                    fix=f"write {name}: Array = real(3, unit=..., frame=...)",
                )
            fields.append((name, declared))
        cached = StructType(cls.__name__, tuple(fields), cls)
        cls._struct_type = cached  # type: ignore[attr-defined]
    return typing.cast(StructType, cached)


def tuple_type(items: Sequence[Type]) -> StructType:
    """The type of a tuple of values."""
    return StructType("tuple", tuple((str(i), t) for i, t in enumerate(items)), tuple)


def annotation_type(annotation: object) -> Type | None:
    """The type that an annotation names, or None where it leaves it open (`Any`, no annotation)."""
    if isinstance(annotation, ArrayType | StructType):
        return annotation
    if isinstance(annotation, type) and issubclass(annotation, Signal):
        return struct_type(annotation)
    if annotation in (float, int, bool):
        return ArrayType((), {float: "real", int: "int64", bool: "bool"}[typing.cast(type, annotation)])
    if get_origin(annotation) is Annotated:
        return next((a for a in get_args(annotation)[1:] if isinstance(a, ArrayType)), None)
    if get_origin(annotation) is tuple:
        items = [annotation_type(a) for a in get_args(annotation)]
        return None if None in items else tuple_type(typing.cast(list[Type], items))
    return None


def without_none(annotation: object) -> tuple[object, bool]:
    """Split `X | None` into `X` and whether None was allowed."""
    if get_origin(annotation) in (typing.Union, _pytypes.UnionType):
        rest = [a for a in get_args(annotation) if a is not type(None)]
        if len(rest) < len(get_args(annotation)):
            return (rest[0] if len(rest) == 1 else typing.Union[tuple(rest)]), True  # noqa: UP007
    return annotation, False


def children(value: Any, type_: StructType) -> list[Any]:
    """The field values of a struct value, in order."""
    if type_.cls is tuple:
        return list(value)
    if type_.cls is dict:
        return [value[name] for name, _ in type_.fields]
    return [getattr(value, name) for name, _ in type_.fields]


def flatten(value: Any, type_: Type) -> list[Array]:
    """The leaves of a value, in declaration order."""
    if isinstance(type_, ArrayType):
        return [value]
    return [
        leaf
        for child, (_, t) in zip(children(value, type_), type_.fields, strict=True)
        for leaf in flatten(child, t)
    ]


def unflatten(type_: Type, leaves: Iterator[Array]) -> Any:
    """A value of `type_` from an iterator over its leaves."""
    if isinstance(type_, ArrayType):
        return next(leaves)
    parts = [unflatten(t, leaves) for _, t in type_.fields]
    if type_.cls is tuple:
        return tuple(parts)
    if type_.cls is dict:
        return {name: part for (name, _), part in zip(type_.fields, parts, strict=True)}
    return type_.cls(*parts)


def leaves_of(type_: Type, prefix: str = "") -> list[tuple[str, ArrayType]]:
    """Dotted names and types of the leaves; a lone leaf is called "value"."""
    if isinstance(type_, ArrayType):
        return [(prefix or "value", type_)]
    return [leaf for name, t in type_.fields for leaf in leaves_of(t, f"{prefix}.{name}" if prefix else name)]


def map_leaves(type_: Type, change: typing.Callable[[ArrayType], ArrayType]) -> Type:
    """The type with every leaf type changed."""
    if isinstance(type_, ArrayType):
        return change(type_)
    return replace(type_, fields=tuple((n, map_leaves(t, change)) for n, t in type_.fields))


def dtype_name(array: Any) -> str:
    """The kind of number of an array or Python scalar, one of `DTYPES`."""
    kind = np.dtype(getattr(array, "dtype", None) or np.asarray(array).dtype)
    if kind.kind == "f":
        return "real"
    if kind.kind == "b":
        return "bool"
    if kind.name in DTYPES:
        return kind.name
    raise DeclarationError(
        "a signal cannot carry this kind of number",
        expected="float, bool, int32, int64, uint32 or uint64",
        got=kind.name,
        fix="convert it with astype",
    )


def type_of(value: Any) -> Type:
    """The type of a value: a signal, a tuple, a dict, an array or a Python number."""
    if isinstance(value, Signal):
        declared = struct_type(type(value))
        fields = tuple(
            (name, _leaf_or_inner(getattr(value, name), t, f"{declared.name}.{name}"))
            for name, t in declared.fields
        )
        return replace(declared, fields=fields)
    if isinstance(value, tuple):
        return tuple_type([type_of(v) for v in value])
    if isinstance(value, Mapping):
        return StructType("dict", tuple((k, type_of(v)) for k, v in value.items()), dict)
    shape = getattr(value, "shape", None)
    return ArrayType(tuple(np.asarray(value).shape if shape is None else shape), dtype_name(value))


def _leaf_or_inner(value: Any, declared: Type, where: str) -> Type:
    if isinstance(declared, StructType):
        inner = type_of(value)
        check_fits(inner, declared, given_at=where, wanted_at=where, sizes={})
        return inner
    given = type_of(value)
    if not isinstance(given, ArrayType):
        raise TypeMismatchError(
            "a leaf must be an array", path=where, expected=declared, got=given, fix="pass an array"
        )
    given = replace(given, unit=declared.unit, frame=declared.frame, axes=axis_names(declared))
    check_fits(given, declared, given_at=where, wanted_at=where, sizes={})
    return given


def axis_names(leaf: ArrayType) -> tuple[str | None, ...]:
    """The names of a leaf's axes; empty where none has one."""
    names = tuple(d if isinstance(d, str) else None for d in leaf.shape)
    return leaf.axes or (names if any(names) else ())


def check_fits(given: Type, wanted: Type, *, given_at: str, wanted_at: str, sizes: dict[str, int]) -> None:
    """Check that a value of type `given` may go where `wanted` is asked for; bind symbolic sizes in `sizes`.

    Raises:
        TypeMismatchError: naming both ends, what was expected, what came and the fix.
    """

    def refuse(what: str, fix: str, leaf: str = "", expected: object = None, got: object = None) -> None:
        raise TypeMismatchError(
            f"{what} of {given_at}{leaf} does not fit {wanted_at}{leaf}",
            path=wanted_at or None,
            expected=str(wanted if expected is None else expected),
            got=str(given if got is None else got),
            fix=fix,
        )

    if isinstance(given, StructType) and isinstance(wanted, StructType):
        if given.cls is not wanted.cls or [n for n, _ in given.fields] != [n for n, _ in wanted.fields]:
            refuse(
                "the signal type",
                f"convert it in a block {given} -> {wanted}: these are different quantities",
            )
        for (name, g), (_, w) in zip(given.fields, wanted.fields, strict=True):
            check_fits(g, w, given_at=f"{given_at}.{name}", wanted_at=f"{wanted_at}.{name}", sizes=sizes)
        return
    if isinstance(given, StructType) or isinstance(wanted, StructType):
        refuse("the signal type", "take the field out, or pack the array, with .map(...)")
        return
    if given.dtype != wanted.dtype:
        refuse("the dtype", f"convert with .map(lambda x: ...) to {wanted.dtype}")
    bound = tuple(sizes.get(d, d) if isinstance(d, str) else d for d in wanted.shape)
    if len(bound) != len(given.shape):
        refuse("the shape", "reshape it in a .map(...)")
    for size, want in zip(given.shape, bound, strict=True):
        want = sizes.get(want, want) if isinstance(want, str) else want  # bound by an axis before
        if isinstance(want, str):
            if isinstance(size, int):
                sizes[want] = size
        elif isinstance(size, int) and size != want:
            known = {n: s for n, s in sizes.items() if n in wanted.shape}
            refuse(
                "the shape",
                "make the sizes agree" + (f" (bound so far: {known})" if known else ""),
            )
    if None not in (given.unit, wanted.unit) and given.unit != wanted.unit:
        refuse("the unit", f"convert it in a block: {given.unit} -> {wanted.unit}")
    if None not in (given.frame, wanted.frame) and given.frame != wanted.frame:
        refuse("the frame", f"rotate it in a block: {given.frame} -> {wanted.frame}")


def bind(type_: Type, sizes: Mapping[str, int]) -> Type:
    """The type with symbolic sizes replaced where they are known."""
    return map_leaves(
        type_,
        lambda leaf: replace(
            leaf,
            shape=tuple(sizes.get(d, d) if isinstance(d, str) else d for d in leaf.shape),
            axes=axis_names(leaf),
        ),
    )


def as_value(value: Any, type_: Type, *, path: str, real_dtype: Any = np.float64) -> Any:
    """A copy of `value` whose leaves are read-only NumPy arrays of `type_` (scalars: NumPy scalars).

    Raises:
        TypeMismatchError: where the value is of another type or shape. DeclarationError: where it is of a
            kind that no signal carries.
    """
    try:
        given = type_of(value)
    except DeclarationError as error:
        error.path = error.path or path
        raise
    if isinstance(type_, ArrayType) and isinstance(given, ArrayType):
        if type_.dtype != given.dtype != "bool" and np.can_cast(
            np.asarray(value).dtype, DTYPES[type_.dtype], "same_kind"
        ):
            given = replace(given, dtype=type_.dtype)  # an int literal where a real is meant
        if type_.dtype == "real" and given.dtype in ("int32", "int64"):
            given = replace(given, dtype="real")
    check_fits(given, type_, given_at=f"the value for {path}", wanted_at=path, sizes={})
    made = []
    for leaf, (_, leaf_type) in zip(flatten(value, type_), leaves_of(type_), strict=True):
        dtype = real_dtype if leaf_type.dtype == "real" else DTYPES[leaf_type.dtype]
        array = np.array(leaf, dtype=dtype)
        array.flags.writeable = False
        made.append(array[()] if array.ndim == 0 else array)
    return unflatten(type_, iter(made))


def zeros(type_: Type) -> Any:
    """A value of `type_` whose leaves are all zero (False).

    Raises:
        DeclarationError: where a size is not bound.
    """
    for name, leaf in leaves_of(type_):
        for size in leaf.shape:
            if isinstance(size, str):
                raise DeclarationError(
                    f"size {size!r} is not bound",
                    path=name,
                    expected="every size known when the graph is built",
                    got=str(leaf),
                    fix=f"give it to build: build(sizes={{{size!r}: ...}})",
                )
    return unflatten(
        type_,
        iter(
            np.zeros(typing.cast(tuple[int, ...], t.shape), DTYPES[t.dtype])[()] for _, t in leaves_of(type_)
        ),
    )
