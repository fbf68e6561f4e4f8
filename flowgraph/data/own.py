"""What a user keeps in a file: graphs and flights by FILE.py:NAME, beside those that packages offer.

    flowgraph run car.py:tracker --data car.py:drive

Such a file is code. It is run, once for each content that it has, by whoever asks for a name in it, and by
nobody else: what only reads results (`flowgraph report`) takes the text for a name and leaves the file alone.
Its folder is put at the end of the import path, so that it finds what lies beside it and hides nothing.

A flight is made by a function of keyword-only settings, which `--set` gives by what their annotations or
defaults say; `seed` is that of the run, and a positional parameter takes what stands behind the name:

    def drive(log: str = "", *, seed: int = 0, duration: float = 60.0) -> Flight: ...

    flowgraph run car.py:tracker --data car.py:drive:monday.log --set duration=30
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from flowgraph.data.files import content_of
from flowgraph.data.flight import Flight
from flowgraph.data.settings import keyword_types, parsed_settings
from flowgraph.errors import DataError, DeclarationError, FlowgraphError, PluginError, UnknownNameError
from flowgraph.language.declare import GraphFunction
from flowgraph.language.graph import Graph

__all__ = ["flight_in_file", "graph_in_file", "is_in_file", "kind_and_place", "settings_by_text"]

_IN_FILE = re.compile(r"(?P<kind>(?P<file>.+?\.py):(?P<name>[^:]+))(?::(?P<place>.*))?", re.DOTALL)
_MOST = 2**24  # bytes of a file of code

_modules: dict[Path, tuple[str, ModuleType]] = {}


def is_in_file(name: str) -> bool:
    """Whether a name means something in a file of a user's."""
    return name.endswith(".py") or bool(_IN_FILE.fullmatch(name))


def kind_and_place(spec: str) -> tuple[str, str]:
    """The two parts of KIND:WHERE, where KIND may be FILE.py:NAME."""
    own = _IN_FILE.fullmatch(spec)
    if own is not None:
        return own["kind"], own["place"] or ""
    kind, _, place = spec.partition(":")
    return kind, place


def graph_in_file(spec: str) -> GraphFunction:
    """The `@graph` function of that name in a file.

    Raises:
        DeclarationError: where there is no such file, or the name is no graph's.
        UnknownNameError: for a name that the file does not have, listing its graphs.
        PluginError: where the file raises, by its line.
    """
    file, name = _parts(spec, "graph")
    held = vars(_module(file))
    if name not in held:
        graphs = [n for n, v in held.items() if isinstance(v, GraphFunction)]
        raise UnknownNameError("graph", name, graphs, path=str(file))
    found = held[name]
    if not isinstance(found, GraphFunction):
        built = isinstance(found, Graph)
        raise DeclarationError(
            f"{name!r} is no graph that can be built for a flight",
            path=f"{file}:{name}",
            expected="a function under @graph",
            got="a graph that is built already" if built else _kind_of(found),
            fix=f"name what {name} was built from" if built else f"put @graph over {name}",
        )
    return found


def flight_in_file(spec: str) -> tuple[Callable[..., Flight], list[str]]:
    """What makes flights under that name in a file, called as every loader is, and the names of its settings.

    Raises:
        DeclarationError, UnknownNameError, PluginError: as `graph_in_file`.
    """
    file, name = _parts(spec, "flight")
    held = vars(_module(file))
    if name not in held:
        made = [n for n, v in held.items() if inspect.isfunction(v) and v.__module__ == held["__name__"]]
        raise UnknownNameError("function that makes a flight", name, made, path=str(file))
    make = held[name]
    if not inspect.isfunction(make):
        raise DeclarationError(
            f"{name!r} makes no flight",
            path=f"{file}:{name}",
            expected="a function of keyword-only settings that returns a Flight",
            got=_kind_of(make),
            fix=f"write def {name}(*, seed: int = 0) -> Flight: ...",
        )
    takes = inspect.signature(make).parameters.values()
    placed = [p.name for p in takes if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    types = keyword_types(make)

    def load(place: str, *, seed: int = 0, settings: Mapping[str, Any] | None = None) -> Flight:
        given = {n: v for n, v in (settings or {}).items() if n in types}
        more, _ = parsed_settings(make, {n: str(v) for n, v in given.items()}, also=(), path=spec)
        if "seed" in types:
            more["seed"] = seed
        if place and not placed:
            raise DeclarationError(
                f"{name} takes no place",
                path=f"{file}:{name}",
                expected=f"a positional parameter, def {name}(place, *, ...)",
                got=place,
                fix=f"write --data {file}:{name}",
            )
        try:
            flight = make(*([place] if place else []), **more)
        except FlowgraphError:
            raise
        except Exception as error:
            raise _broken(file, error, f"{name}() to return a Flight") from error
        if not isinstance(flight, Flight):
            raise DataError(
                f"{name} returned no flight",
                path=f"{file}:{name}",
                expected="a flowgraph.Flight",
                got=_kind_of(flight),
                fix='return Flight("name", {stream: Series(time, values)}, truth=Series(...))',
            )
        return flight

    return load, [n for n in types if n != "seed"]


def settings_by_text(spec: str) -> list[str]:
    """The settings of a flight in a file, by the text of the file, which is not run; none if it is gone."""
    file, name = _parts(spec, "flight")
    try:
        tree = ast.parse(content_of(file.expanduser(), most=_MOST))
    except (OSError, SyntaxError, ValueError):
        return []
    made = [f for f in tree.body if isinstance(f, ast.FunctionDef) and f.name == name]
    return [a.arg for f in made for a in f.args.kwonlyargs if a.arg != "seed"]


def _parts(spec: str, what: str) -> tuple[Path, str]:
    own = _IN_FILE.fullmatch(spec)
    if own is None:
        raise DeclarationError(
            f"this names a file, and no {what} in it",
            path=spec,
            expected="FILE.py:NAME",
            got=spec,
            fix=f"write {spec}:NAME, with the name of the {what}",
        )
    return Path(own["file"]), own["name"]


def _kind_of(value: object) -> str:
    name = getattr(value, "__name__", None)
    return f"the {type(value).__name__} {name}" if name else f"{type(value).__name__}: {value!r}"[:80]


def _module(file: Path) -> ModuleType:
    """The file, run as a module; that of before where nothing in it has changed."""
    try:
        path = file.expanduser().resolve()
        content = content_of(path, most=_MOST)
    except (OSError, RuntimeError, ValueError) as error:
        missing = isinstance(error, FileNotFoundError)
        raise DeclarationError(
            "there is no such file" if missing else "this file cannot be read",
            path=str(file),
            expected="a Python file with a @graph function in it",
            got=f"nothing of that name in {Path.cwd()}" if missing else str(error),
            fix="check the path: a study's is relative to its file, a command's to where it runs",
        ) from None
    digest = hashlib.sha256(content).hexdigest()
    if path not in _modules or _modules[path][0] != digest:
        _modules[path] = digest, _run(path, content)
    return _modules[path][1]


def _run(path: Path, content: bytes) -> ModuleType:
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    name = path.name  # "car.py" is what no import statement can mean
    other = sys.modules.get(name)
    if other is not None and getattr(other, "__file__", None) != str(path):
        name = str(path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    before = sys.modules.get(name)
    sys.modules[name] = module  # annotations and dataclasses look their module up
    try:
        exec(compile(content, str(path), "exec"), vars(module))
    except BaseException as error:
        if before is None:
            del sys.modules[name]
        else:
            sys.modules[name] = before
        if isinstance(error, FlowgraphError) or not isinstance(error, Exception | SystemExit):
            raise
        raise _broken(path, error, "a file that can be imported") from error
    return module


def _broken(path: Path, error: BaseException, expected: str) -> PluginError:
    """What a user's code raised, by the last of its own lines."""
    line = getattr(error, "lineno", None) if isinstance(error, SyntaxError) else None
    for frame in traceback.extract_tb(error.__traceback__):
        if line is None or not isinstance(error, SyntaxError):
            line = frame.lineno if Path(frame.filename) == path.expanduser().resolve() else line
    return PluginError(
        "this file raises an error",
        path=f"{path}, line {line}" if line else str(path),
        expected=expected,
        got=" ".join(f"{type(error).__name__}: {error}".split()),
        fix="mend that line; python " + path.name + " shows the whole trace",
    )
