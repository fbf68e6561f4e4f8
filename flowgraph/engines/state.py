"""The state of a run as a tree of arrays: made, loaded, saved to a file and read back to the same bits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import arrays_of, whole
from flowgraph.errors import DataError, DeclarationError, UnknownNameError
from flowgraph.language.graph import Graph, join_states
from flowgraph.types import DTYPES, ArrayType, Type, as_value, flatten, leaves_of, unflatten


def check_settable(path: str, roles: Mapping[str, str], *, graph: str) -> None:
    """Refuse an initial value for what is no register, or one of a join or a clock; `roles` is by path.

    Raises:
        UnknownNameError, DeclarationError: listing the registers that can be set.
    """
    valid = [p for p, role in roles.items() if role not in ("join", "stamp")]
    if path not in roles:
        raise UnknownNameError("register", path, valid, path=graph)
    if path not in valid:
        what = "the state of a join" if roles[path] == "join" else "the time at which a clock last ticked"
        raise DeclarationError(
            "this register cannot be set",
            path=f"{graph}, {path}",
            expected="one of " + ", ".join(sorted(valid)) if valid else "no initial values: none can be set",
            got=f"{path!r}, {what}",
            fix="leave it out of init=; a run that goes on takes a whole state=",
        )


def check_start(init: object, state: object, *, path: str) -> None:
    """Refuse initial values together with a state.

    Raises:
        DeclarationError: where both are given.
    """
    if init is not None and state is not None:
        raise DeclarationError(
            "a run starts from initial values or from a state",
            path=path,
            expected="init or state",
            got="both",
            fix="leave one of them out",
        )


def initial_registers(graph: Graph, init: Mapping[str, Any] | None) -> list[Any]:
    """One slot a node: the initial value of each register, None elsewhere.

    Raises:
        UnknownNameError, DeclarationError: where `init` names no register, or one of a join or a clock.
    """
    slots: list[Any] = [None] * len(graph.nodes)
    joins = join_states(graph)
    places, roles = {}, {}
    for index, node in graph.registers:
        slots[index] = int(node.initial) if node.role == "stamp" else node.initial
        places[node.path] = (index, node.type)
        roles[node.path] = "join" if index in joins else node.role
    for path, value in (init or {}).items():
        check_settable(path, roles, graph=graph.name)
        index, type_ = places[path]
        slots[index] = as_value(value, type_, path=path)
    return slots


def to_tree(value: Any, type_: Type) -> Any:
    """A value as nested dicts of arrays of their own."""
    if isinstance(type_, ArrayType):
        return np.array(value)
    return {
        name: np.array(leaf) for (name, _), leaf in zip(leaves_of(type_), flatten(value, type_), strict=True)
    }


def state_tree(graph: Graph, registers: list[Any], last: Mapping[str, int], seed: int) -> dict[str, Any]:
    """`{"registers": {path: arrays}, "sources": {name: last time}, "seed": number}`."""
    return {
        "registers": {node.path: to_tree(registers[index], node.type) for index, node in graph.registers},
        "sources": {name: np.asarray(time, dtype=np.int64) for name, time in last.items()},
        "seed": np.asarray(seed, dtype=np.uint64),
    }


def load_registers(graph: Graph, tree: Mapping[str, Any]) -> tuple[list[Any], dict[str, int], int]:
    """Register slots, last times and seed from a state tree of this graph.

    Raises:
        DataError: where the tree is malformed, or of another graph.
    """
    types = {node.path: node.type for _, node in graph.registers}
    found, last, seed = read_tree(tree, types, list(graph.sources), name=graph.name)
    slots: list[Any] = [None] * len(graph.nodes)
    for index, node in graph.registers:
        value = unflatten(node.type, iter(found[node.path]))
        slots[index] = int(value) if node.role == "stamp" else value
    return slots, last, seed


def read_tree(
    tree: Any, types: Mapping[str, Type], sources: Sequence[str], *, name: str, of: str = "graph"
) -> tuple[dict[str, list[Any]], dict[str, int], int]:
    """The leaves of each register (read-only copies), last times and seed, from a state tree.

    Raises:
        DataError: naming the part that is malformed, or of another graph.
    """
    _check_members(tree, ("registers", "sources", "seed"), f"{name}: state", "this is no state", of)
    other = f"this state is of another {of}"
    _check_members(tree["registers"], types, name, other, of)
    _check_members(tree["sources"], sources, f"{name}: last times", other, of)
    found = {}
    for path, type_ in types.items():
        part, where = tree["registers"][path], f"{name}: state of {path}"
        if isinstance(type_, ArrayType):
            part = {"value": part}
        leaves = leaves_of(type_)
        _check_members(part, [n for n, _ in leaves], where, other, of)
        single = len(leaves) == 1
        found[path] = [_leaf(part[n], t, where if single else f"{where}, {n}") for n, t in leaves]
    stamp = ArrayType((), "int64")
    last = {n: int(_leaf(tree["sources"][n], stamp, f"{name}: last time of {n}")) for n in sources}
    return found, last, int(_leaf(tree["seed"], ArrayType((), "uint64"), f"{name}: seed"))


def _check_members(part: Any, wanted: Iterable[str], where: str, message: str, of: str) -> None:
    names = list(wanted)
    given = list(part) if isinstance(part, Mapping) else None
    if given is None or set(given) != set(names):
        absent = [n for n in names if n not in (given or [])]
        extra = [str(n) for n in given or [] if n not in names]
        differs = [f"none called {n!r}" for n in absent] + [f"{n!r}, which is not there" for n in extra]
        raise DataError(
            message,
            path=where,
            expected=", ".join(names) or "nothing",
            got=type(part).__name__ if given is None else ", ".join(differs[:4]),
            fix=f"resume a run with the {of} that it was saved from, from a whole run.state",
        )


def _leaf(value: Any, type_: ArrayType, where: str) -> Any:
    """A read-only copy of one array of a state; a scalar as a NumPy scalar."""
    wanted: np.dtype[Any] = np.dtype(DTYPES[type_.dtype])
    try:
        given = np.asarray(value)
        kinds = {"f": "fiu", "b": "b"}.get(wanted.kind, "iu")
        sound = given.dtype.kind in kinds and given.shape == type_.shape
        if sound and wanted.kind in "iu" and given.size:
            limits = np.iinfo(wanted)
            sound = limits.min <= int(given.min()) and int(given.max()) <= limits.max
        got = f"{given.dtype.name} of shape {given.shape}" + (f": {value!r}"[:60] if given.ndim == 0 else "")
    except (ValueError, TypeError, OverflowError) as error:
        sound, got = False, str(error)
    if not sound:
        raise DataError(
            "a part of this state is malformed",
            path=where,
            expected=f"{type_.dtype} of shape {type_.shape}",
            got=got,
            fix="resume from a run.state as it was, or set a value with init=",
        )
    array = np.array(given, dtype=wanted)
    array.flags.writeable = False
    return array[()]


def save_state(tree: Mapping[str, Any], file: str | Path) -> None:
    """Write a state tree to an .npz file, exactly; the one that is there stays until the new one is whole.

    Raises:
        OutputError: where the file cannot be written; DataError: where the tree is no state, which could not
            be read again. What the file held before is then there still.
    """
    flat = flat_state(tree)
    with whole(file) as out:
        np.savez(out, **flat)  # type: ignore[arg-type]


def flat_state(tree: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The arrays of a state tree by a name each, as they are written.

    Raises:
        DataError: where the tree is no state.
    """
    _check_members(tree, ("registers", "sources", "seed"), "save_state", "this is no state", "graph")
    flat: dict[str, np.ndarray] = {}
    for group, members in tree.items():
        if not isinstance(members, Mapping):
            flat[group] = _numbers(members, group)
            continue
        for path, part in members.items():
            leaves = part.items() if isinstance(part, Mapping) else [("", part)]
            flat.update({f"{group}\n{path}\n{leaf}": _numbers(a, f"{group}, {path}") for leaf, a in leaves})
    return flat


def _numbers(value: Any, where: str) -> np.ndarray:
    try:
        array = np.asarray(value)
        got = array.dtype.name
        sound = array.dtype.kind in "biuf"
    except ValueError as error:
        got, sound = str(error), False
    if not sound:
        raise DataError(
            "a part of this state is malformed",
            path=where,
            expected="numbers",
            got=got,
            fix="save a whole run.state as it was",
        )
    return array


def load_state(file: str | Path) -> dict[str, Any]:
    """Read a state tree written by `save_state`.

    Raises:
        DataError: where the file is missing or is no such file.
    """
    try:
        return nested_state(arrays_of(file))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            "this is no saved state",
            path=str(file),
            expected="a file written by save_state",
            got=f"{type(error).__name__}: {error}"[:300],
            fix="write one with save_state(run.state, file)",
        ) from None


def nested_state(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The state tree whose arrays have these names.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: for names that are none of a state.
    """
    tree: dict[str, Any] = {"registers": {}, "sources": {}}
    for name, array in flat.items():
        if name == "seed":
            tree[name] = array
            continue
        group, path, leaf = name.split("\n")
        if leaf:
            tree[group].setdefault(path, {})[leaf] = array
        else:
            tree[group][path] = array
    return tree
