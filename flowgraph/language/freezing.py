"""Freezing a step: what it reads from around it is copied when it is wired, and stays as it was.

A graph does not change after it is declared, and a step that is recorded has the values of that moment in
its instructions. So that it has them in Python too, it is wired as a new function of the same code, whose
closure, defaults and globals are copies. Arrays among them are read-only. Modules, classes and functions
are kept, but the functions of the user's own modules are frozen in the same way, and so are the attributes
that a step reads from such a module or class. What cannot be copied is noted, and refused where it matters.
"""

from __future__ import annotations

import collections
import contextlib
import copy
import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from types import BuiltinFunctionType, CellType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from flowgraph.language.block import Block
from flowgraph.language.capturing import Chains, is_own, is_own_function, is_own_namespace, names_read
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.types import ArrayType, Signal, StructType

_KEPT = (
    *(type(None), bool, int, float, complex, str, bytes, slice, range, type, ModuleType, BuiltinFunctionType),
    *(np.generic, np.dtype, np.ufunc, Enum, ArrayType, StructType, Symbolic),
)
_OF_A_MODULE = ("__name__", "__builtins__", "__file__", "__package__", "__spec__", "__loader__")
_OF_THE_LANGUAGE = ("flowgraph.language", "flowgraph.recorder")
_VALUES = (bool, int, float, complex, str, bytes, np.ndarray, np.generic, list, dict, set, tuple)
_WRITERS = (list, dict, set, collections.deque, bytearray)


class Holder(NamedTuple):
    """Something that a step could write to: its name, its contents now, and how to read them again."""

    name: str
    contents: list[Any]
    read: Callable[[], Iterable[Any]]

    def written(self) -> bool:
        """Whether it holds anything else than it did."""
        now = list(self.read())
        return len(now) != len(self.contents) or any(
            a is not b for a, b in zip(now, self.contents, strict=True)
        )


class Freezer:
    """Copies what one step reads; what is met twice is copied once.

    Attributes:
        holders: what the step could write to.
        uncopied: names of what could not be copied, with what it is.
        own: whether any function of the user's is among what was met.
    """

    def __init__(self) -> None:
        self.holders: list[Holder] = []
        self.uncopied: list[tuple[str, Any]] = []
        self.own = False
        self._done: dict[int, tuple[Any, Any]] = {}

    def written(self) -> list[str]:
        """The names of what has been written to since."""
        return [holder.name for holder in self.holders if holder.written()]

    def block(self, block: Block[Any]) -> Block[Any]:
        """The block with its step frozen; itself where its step reads nothing that can change."""
        step = self.value(block.step, block.name)
        return block if step is block.step else block.with_step(step)

    def value(self, value: Any, name: str) -> Any:
        """The value as it is now; `name` says in messages where it is."""
        if isinstance(value, _KEPT):
            if is_own_namespace(value) and isinstance(value, type):
                self._watch_class(value, name)
            return value
        if id(value) not in self._done:
            self._done[id(value)] = value, value  # met again while it is copied: as it is
            self._done[id(value)] = value, self._copied(value, name)
        return self._done[id(value)][1]

    def _copied(self, value: Any, name: str) -> Any:
        if isinstance(value, FunctionType):
            return self._function(value, name)
        if isinstance(value, MethodType):
            return MethodType(self.value(value.__func__, name), self.value(value.__self__, name))
        if isinstance(value, Block):
            return self.block(value)
        if type(value) is functools.partial:
            parts = {k: self.value(v, f"{name}.{k}") for k, v in value.keywords.items()}
            given = [self.value(v, name) for v in value.args]
            return functools.partial(self.value(value.func, name), *given, **parts)
        if isinstance(value, np.ndarray):
            return self._array(value, name)
        if isinstance(value, tuple):
            items = [self.value(v, f"{name}[{i}]") for i, v in enumerate(value)]
            if all(a is b for a, b in zip(items, value, strict=True)):
                return value
            return value._make(items) if hasattr(value, "_make") else type(value)(items)
        if isinstance(value, _WRITERS):
            return self._container(value, name)
        return value if isinstance(value, frozenset) else self._object(value, name)

    def _array(self, value: np.ndarray, name: str) -> np.ndarray:
        if value.dtype != object and not value.flags.writeable and value.base is None:
            return value
        made = value.copy(order="K")
        if value.dtype == object:
            made.ravel()[:] = [self.value(v, name) for v in value.ravel()]
        made.flags.writeable = False
        return made

    def _container(self, value: Any, name: str) -> Any:
        made = copy.copy(value)
        self._done[id(value)] = value, made
        if isinstance(made, dict):
            for key, item in value.items():
                made[key] = self.value(item, f"{name}[{key!r}]")
            self._hold(name, lambda: [x for pair in made.items() for x in pair])
        elif isinstance(made, set | bytearray):
            self._hold(name, lambda: sorted(made, key=id) if isinstance(made, set) else [*made])
        else:
            for at, item in enumerate(value):
                made[at] = self.value(item, f"{name}[{at}]")
            self._hold(name, lambda: list(made))
        return made

    def _object(self, value: Any, name: str) -> Any:
        kind = type(value)
        if kind.__module__.startswith(_OF_THE_LANGUAGE):
            return value
        attributes = _attributes(value)
        house = kind.__module__.startswith("flowgraph.") or is_own(kind.__module__)
        if attributes is None or not house or hasattr(kind, "__deepcopy__"):
            return self._deep(value, name)
        members = self._members(kind, attributes, name)
        if _is_value(value) and not members:  # copied only where what it holds has to be
            parts = {k: self.value(v, f"{name}.{k}") for k, v in attributes.items()}
            if all(parts[k] is v for k, v in attributes.items()):
                return value
        try:
            made = copy.copy(value)
        except Exception as error:
            return self._uncopied(value, name, error)
        if made is value:
            return value
        self._done[id(value)] = value, made
        for key, item in attributes.items():
            object.__setattr__(made, key, self.value(item, f"{name}.{key}"))
        if members:
            like = {"__slots__": (), "__module__": kind.__module__, "__qualname__": kind.__qualname__}
            with contextlib.suppress(TypeError):  # a class that may have no subclass stays as it is
                meta: Any = type(kind)
                object.__setattr__(made, "__class__", meta(kind.__name__, (kind,), {**members, **like}))
        every = [pair for c in kind.__mro__ for pair in vars(c).items()]
        lazy = {k for k, v in every if isinstance(v, functools.cached_property)}
        if is_own(kind.__module__):
            self._hold(
                name,
                lambda: [
                    x for pair in (_attributes(made) or {}).items() if pair[0] not in lazy for x in pair
                ],
            )
        return made

    def _members(self, kind: type, attributes: Mapping[str, Any], name: str) -> dict[str, Any]:
        """What a class of the user's gives its instances, frozen: methods that read globals, and values."""
        found: dict[str, Any] = {}
        if "__init_subclass__" in {k for c in kind.__mro__[:-1] for k in vars(c)}:
            return found  # such a class counts its subclasses
        for key, item in [pair for c in reversed(kind.__mro__) for pair in vars(c).items()]:
            found.pop(key, None)
            inner = item.fget if isinstance(item, property) else getattr(item, "__func__", item)
            if isinstance(inner, FunctionType) and is_own_function(inner) and _reads_changing(inner):
                frozen = self.value(inner, f"{name}.{key}")
                found[key] = frozen if inner is item else type(item)(frozen)
            elif isinstance(item, _VALUES) and not key.startswith("__") and key not in attributes:
                found[key] = self.value(item, f"{name}.{key}")
        return found

    def _deep(self, value: Any, name: str) -> Any:
        try:
            return copy.deepcopy(value)
        except Exception as error:
            return self._uncopied(value, name, error)

    def _uncopied(self, value: Any, name: str, error: Exception) -> Any:
        self.uncopied.append((name, f"{type(value).__name__} ({error})"))
        return value

    def _function(self, function: FunctionType, name: str) -> Any:
        own = is_own_function(function)
        self.own |= own
        reads = names_read(function.__code__)
        around = function.__globals__
        named = {k: c for k, c in reads.items() if k in around and k not in function.__code__.co_freevars}
        held = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
        if not (held or function.__defaults__ or function.__kwdefaults__ or (own and named)):
            return function
        scope = {k: around[k] for k in _OF_A_MODULE if k in around} if own and named else around
        cells = tuple(CellType() for _ in held)
        # what the interpreter learns of globals is kept with the code, so each scope has a copy of its own
        code = function.__code__ if scope is around else function.__code__.replace()
        made = FunctionType(code, scope, function.__name__, None, cells)
        made.__dict__.update(function.__dict__)
        made.__annotations__, made.__doc__ = function.__annotations__, function.__doc__
        made.__qualname__, made.__module__ = function.__qualname__, function.__module__
        if own:
            self._done[id(function)] = function, made
        same = scope is around
        for cell, (label, old) in zip(cells, held.items(), strict=True):
            try:
                inside = old.cell_contents
            except ValueError:  # not assigned yet
                continue
            cell.cell_contents = self._used(inside, label, reads.get(label, frozenset()))
            same &= cell.cell_contents is inside
        if scope is not around:
            for label, chains in named.items():
                scope[label] = self._used(around[label], label, chains)
            self._hold(f"the globals of {function.__qualname__}", lambda: list(scope.values()))
        if cells and own:
            self._hold(", ".join(held), lambda: [c.cell_contents for c in cells if not _is_empty(c)])
        places = function.__code__.co_varnames[: function.__code__.co_argcount]
        defaults = function.__defaults__ or ()
        made.__defaults__ = tuple(
            self.value(v, k) for k, v in zip(places[len(places) - len(defaults) :], defaults, strict=True)
        )
        made.__kwdefaults__ = {k: self.value(v, k) for k, v in (function.__kwdefaults__ or {}).items()}
        same &= all(a is b for a, b in zip(made.__defaults__, defaults, strict=True))
        same &= all(made.__kwdefaults__[k] is v for k, v in (function.__kwdefaults__ or {}).items())
        return function if same and not own else made

    def _used(self, value: Any, name: str, chains: Chains) -> Any:
        """A value that a function reads; of own modules and classes, only what it reads of them."""
        if not is_own_namespace(value) or not chains or () in chains:
            return self.value(value, name)
        first = dict.fromkeys(chain[0] for chain in chains)
        if not all(hasattr(value, key) for key in first):
            return value  # what is misspelt is said in the words of Python
        deeper = {key: frozenset(c[1:] for c in chains if c[0] == key) for key in first}
        made = SimpleNamespace(
            **{key: self._used(getattr(value, key), f"{name}.{key}", deeper[key]) for key in first}
        )
        self._hold(name, lambda: list(vars(made).values()))
        return made

    def _hold(self, name: str, read: Callable[[], Iterable[Any]]) -> None:
        self.holders.append(Holder(name, list(read()), read))

    def _watch_class(self, kind: type, name: str) -> None:
        if id(kind) in self._done:
            return
        self._done[id(kind)] = kind, kind
        self._hold(name, lambda: [v for k, v in list(vars(kind).items()) if not k.startswith("_")])


def _reads_changing(function: FunctionType) -> bool:
    """Whether a function reads globals that may change, more than modules, classes and others' functions."""
    around = function.__globals__
    named = [around[k] for k in names_read(function.__code__) if k in around]
    return bool(function.__closure__) or any(
        (
            not isinstance(v, ModuleType | type | BuiltinFunctionType)
            and not (isinstance(v, FunctionType) and not is_own_function(v))
        )
        or is_own_namespace(v)
        for v in named
    )


def _is_empty(cell: CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018 (reading it is the test)
    except ValueError:
        return True
    return False


def _attributes(value: Any) -> Mapping[str, Any] | None:
    """The attributes of an instance, or None where they are not in Python's hands."""
    declared = [vars(c).get("__slots__", ()) for c in type(value).__mro__]
    names = [s for found in declared for s in ([found] if isinstance(found, str) else found)]
    slots = [s for s in names if s not in ("__dict__", "__weakref__")]
    if not hasattr(value, "__dict__") and not slots:
        return None
    return {**getattr(value, "__dict__", {}), **{s: getattr(value, s) for s in slots if hasattr(value, s)}}


def _is_value(value: Any) -> bool:
    """Whether an instance is a value that nobody writes to: a signal, a frozen dataclass, a manifold."""
    kind = type(value)
    if isinstance(value, Signal) or not is_own(kind.__module__):
        return True
    if is_dataclass(value):
        return bool(kind.__dataclass_params__.frozen)
    return False


def fingerprint(value: Any, seen: tuple[int, ...] = ()) -> Any:
    """What tells one frozen value from another, to the last bit.

    Raises:
        NotPlainError: where that cannot be said.
    """
    if value is None or isinstance(value, bool | int | str):
        return type(value), value
    if isinstance(value, float):
        return float, value.hex()
    if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
        return np.ndarray, value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, type | ModuleType | BuiltinFunctionType | np.ufunc):
        return type, value
    if id(value) in seen:
        return "seen", seen.index(id(value))
    inner = (*seen, id(value))
    if type(value) in (tuple, list):
        return type(value), *(fingerprint(v, inner) for v in value)
    if type(value) in (dict, SimpleNamespace):
        items = value if isinstance(value, dict) else vars(value)
        return type(value), *((fingerprint(k), fingerprint(v, inner)) for k, v in items.items())
    if is_dataclass(value) and not isinstance(value, type):
        return type(value), *(fingerprint(getattr(value, f.name), inner) for f in fields(value))
    if isinstance(value, FunctionType):
        return _function_fingerprint(value, inner)
    kind = type(value)
    if isinstance(kind.__eq__, FunctionType) and kind.__hash__ is not None:
        return kind, value  # an immutable value, such as a state space
    raise NotPlainError


class NotPlainError(Exception):
    """A value that cannot be told from another."""


def _function_fingerprint(function: FunctionType, inner: tuple[int, ...]) -> Any:
    """Its code, what it closes over, its defaults, and its globals where they are its own copies."""
    if any(_is_empty(cell) for cell in function.__closure__ or ()):
        raise NotPlainError
    scope, around = function.__globals__, []
    if own := is_own_function(function):
        around = [scope[name] for name in names_read(function.__code__) if name in scope]
    return (
        *(FunctionType, function.__code__, function.__module__ if own else id(scope)),
        *(fingerprint(cell.cell_contents, inner) for cell in function.__closure__ or ()),
        *(fingerprint(v, inner) for v in (*around, *(function.__defaults__ or ()))),
        fingerprint(function.__kwdefaults__, inner),
    )
