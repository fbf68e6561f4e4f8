"""What a thing is, as a digest: the same digest, the same numbers come of it.

Nested plain values, arrays, recordings, lowered graphs and the code of blocks that run as Python each have
one. By them a study knows which of its runs are done, and a checkpoint of which run it is.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.series import Series
from flowgraph.language.graph import CallNode, Graph
from flowgraph.pipeline.pipeline import Pipeline, Port, Register


@lru_cache(maxsize=1)
def package_version() -> str:
    """The version of the installed distribution."""
    try:
        return version("flowgraph-filters")
    except PackageNotFoundError:
        return "unknown"


def digest(value: Any) -> str:
    """A hexadecimal digest of nested plain values, arrays, dataclasses, signals and series."""
    found = hashlib.sha256()
    _feed(found, value)
    return found.hexdigest()[:40]


def _feed(into: Any, value: Any) -> None:
    """Each part goes in with its kind and length before it, so that no two values read alike."""
    if value is None or isinstance(value, bool | int | float | str):
        word = repr(value).encode()
        into.update(f"{type(value).__name__}:{len(word)}:".encode() + word)
    elif isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        into.update(f"array:{array.dtype.str}:{array.shape}:".encode())
        into.update(array.tobytes() if array.dtype != object else repr(array.tolist()).encode())
    elif isinstance(value, Mapping):
        into.update(f"mapping:{len(value)}:".encode())
        for key in sorted(value, key=repr):
            _feed(into, key)
            _feed(into, value[key])
    elif isinstance(value, set | frozenset):
        _feed(into, ("set", sorted(digest(part) for part in value)))
    elif isinstance(value, partial):
        _feed(into, ("partial", value.func, value.args, value.keywords))
    elif isinstance(value, list | tuple):
        into.update(f"list:{len(value)}:".encode())
        for part in value:
            _feed(into, part)
    elif isinstance(value, Series):
        _feed(into, ("series", value.time, value.gaps, dict(value.leaves)))
    elif isinstance(value, Flight):
        _feed(into, ("flight", dict(value.streams), value.truth, dict(value.info)))
    elif is_dataclass(value) and not isinstance(value, type):
        _feed(into, (type(value).__qualname__, {f.name: getattr(value, f.name) for f in fields(value)}))
    elif isinstance(value, FunctionType):
        closed = [cell.cell_contents for cell in value.__closure__ or ()]
        given = (value.__defaults__, value.__kwdefaults__)
        _feed(into, ("function", value.__module__, value.__qualname__, closed, given))
    elif isinstance(value, MethodType):
        _feed(into, ("method", value.__func__, value.__self__))
    elif inspect.isclass(value) or inspect.isbuiltin(value):
        _feed(into, ("callable", value.__module__ or "", value.__qualname__))
    else:
        held = getattr(value, "__dict__", None)
        _feed(into, (type(value).__qualname__, dict(held) if held else str(value)))


def code_digest(function: Callable[..., Any]) -> str:
    """Of the module that a function is in, but for its comments, its layout and its docstrings."""
    try:
        file = inspect.getsourcefile(inspect.unwrap(function))
        source = Path(str(file)).read_text(encoding="utf-8")
    except (OSError, TypeError):
        return digest(("no source", getattr(function, "__qualname__", "")))
    return _source_digest(source)


@lru_cache(maxsize=256)
def _source_digest(source: str) -> str:
    try:
        tree = ast.parse(source)
    except SyntaxError:  # a shell or a notebook, whose file is no module
        return digest(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            first = body[0].value
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                node.body = body[1:]  # type: ignore[attr-defined]
    return digest(ast.dump(tree))


def structure(pipeline: Pipeline) -> tuple[Any, ...]:
    """Everything of a pipeline but the values of its `settings_of`, and of its registers at the start.

    Two pipelines of one structure are one program on different numbers.
    """
    free = settings_of(pipeline)
    return (
        pipeline.name,
        pipeline.time,
        pipeline.seed,
        _ports(pipeline.inputs),
        _ports(pipeline.outputs),
        tuple((r.path, r.role, _cells(r)) for r in pipeline.registers),
        tuple(
            (n, a.shape, a.dtype.str, None if n in free else a.tobytes())
            for n, a in pipeline.constants.items()
        ),
        tuple((i.op, i.args, _plain(i.attrs), i.out) for i in pipeline.instructions),
        tuple((f.register, f.cell) for f in pipeline.faults),
    )


_PLAIN = (0.0, 0.5, 1.0, 2.0)


def settings_of(pipeline: Pipeline) -> dict[int, np.ndarray]:
    """The real constants that a program need not know: all but tables (`_is_table`) and exponents."""
    exponents = {i.args[1] for i in pipeline.instructions if i.op == "pow"}
    return {
        n: a
        for n, a in pipeline.constants.items()
        if a.dtype.kind == "f" and n not in exponents and not _is_table(a)
    }


def _is_table(array: np.ndarray) -> bool:
    """Whether a constant is a matrix of whole numbers, as that of a product of quaternions is, or one of 0,
    1/2, 1 and 2 but for the sign.

    Such a one belongs to the maths more often than to the settings, and a program that knows it leaves out
    what it multiplies by 0 and 1: that is several times as fast as one that reads it.
    """
    if array.ndim == 0:
        return abs(float(array)) in _PLAIN
    return array.ndim >= 2 and bool((array == np.round(array)).all())


def _ports(ports: tuple[Port, ...]) -> tuple[Any, ...]:
    """The timing is in it too: events are checked against it."""
    return tuple(
        (p.name, p.present, p.timing, tuple((x.name, x.value, x.shape, x.dtype) for x in p.leaves))
        for p in ports
    )


def _cells(register: Register) -> tuple[Any, ...]:
    """Its cells; those of joins and stamps with their values at the start, which no run may set."""
    fixed = register.role in ("join", "stamp")
    return tuple(
        (c.name, c.read, c.write, c.shape, c.dtype, np.asarray(c.reset).tobytes() if fixed else None)
        for c in register.cells
    )


def _plain(attrs: Mapping[str, Any]) -> str:
    return repr(sorted(attrs.items())) if attrs else ""


def graph_digest(pipeline: Pipeline) -> str:
    """Of a lowered graph with all its numbers; its documentation and source lines aside."""
    resets = [[c.reset for c in r.cells] for r in pipeline.registers]
    return digest((structure_digest(pipeline), list(pipeline.constants.values()), resets))


def structure_digest(pipeline: Pipeline) -> str:
    return digest(structure(pipeline))


def python_digest(graph: Graph, *, every: bool = False) -> str:
    """Of the blocks that run as Python and so are not in the pipeline: their modules' code and settings.

    They are those of the host, or, with `every`, all. Empty where there are none.
    """
    calls = [n for n in graph.nodes if isinstance(n, CallNode) and (every or n.block.host)]
    return (
        digest([(n.path, code_digest(n.block.step), _settings(n.settings)) for n in calls]) if calls else ""
    )


def _settings(settings: Mapping[str, Any]) -> Any:
    """The digest of each; of one that holds itself, as a figure does, only its kind."""
    found = {}
    for name, value in settings.items():
        try:
            found[name] = digest(value)
        except RecursionError:
            found[name] = type(value).__qualname__
    return found
