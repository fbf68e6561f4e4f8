"""The state of a run as a tree of arrays: made, loaded, saved to a file and read back to the same bits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from flowgraph.errors import DataError, UnknownNameError, writes
from flowgraph.graph import Graph
from flowgraph.types import ArrayType, Type, as_value, flatten, leaves_of, unflatten


def initial_registers(graph: Graph, init: Mapping[str, Any] | None) -> list[Any]:
    """One slot a node: the initial value of each register, None elsewhere.

    Raises:
        UnknownNameError: where `init` names no register.
    """
    slots: list[Any] = [None] * len(graph.nodes)
    paths = {}
    for index, node in graph.registers:
        slots[index] = int(node.initial) if node.role == "stamp" else node.initial
        paths[node.path] = (index, node.type)
    for path, value in (init or {}).items():
        if path not in paths:
            raise UnknownNameError("register", path, paths, path=graph.name)
        index, type_ = paths[path]
        slots[index] = as_value(value, type_, path=path)
    return slots


def to_tree(value: Any, type_: Type) -> Any:
    """A value as nested dicts of arrays."""
    if isinstance(type_, ArrayType):
        return np.asarray(value)
    return {
        name: np.asarray(leaf)
        for (name, _), leaf in zip(leaves_of(type_), flatten(value, type_), strict=True)
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
        DataError: where the tree is of another graph.
    """
    saved = tree.get("registers", {})
    wanted = {node.path for _, node in graph.registers}
    if set(saved) != wanted or set(tree.get("sources", {})) != set(graph.sources):
        differ = sorted(set(saved) ^ wanted) or sorted(set(tree.get("sources", {})) ^ set(graph.sources))
        raise DataError(
            "this state is of another graph",
            path=graph.name,
            expected=f"registers {sorted(wanted)}",
            got=f"differs in {differ}",
            fix="resume a run with the graph that it was saved from",
        )
    slots: list[Any] = [None] * len(graph.nodes)
    for index, node in graph.registers:
        part = saved[node.path]
        leaves = (
            [part] if isinstance(node.type, ArrayType) else [part[name] for name, _ in leaves_of(node.type)]
        )
        value = unflatten(node.type, iter(np.asarray(leaf)[()] for leaf in leaves))
        slots[index] = int(value) if node.role == "stamp" else as_value(value, node.type, path=node.path)
    return slots, {name: int(tree["sources"][name]) for name in graph.sources}, int(tree.get("seed", 0))


def save_state(tree: Mapping[str, Any], file: str | Path) -> None:
    """Write a state tree to an .npz file, exactly.

    Raises:
        OutputError: where the file cannot be written.
    """
    flat: dict[str, np.ndarray] = {}
    for group, members in tree.items():
        if not isinstance(members, Mapping):
            flat[group] = np.asarray(members)
            continue
        for path, part in members.items():
            leaves = part.items() if isinstance(part, Mapping) else [("", part)]
            flat.update({f"{group}\n{path}\n{leaf}": np.asarray(a) for leaf, a in leaves})
    with writes(file), open(file, "wb") as out:
        np.savez(out, **flat)  # type: ignore[arg-type]


def load_state(file: str | Path) -> dict[str, Any]:
    """Read a state tree written by `save_state`.

    Raises:
        DataError: where the file is missing or is no such file.
    """
    try:
        with np.load(file, allow_pickle=False) as archive:
            flat = {name: archive[name] for name in archive.files}
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
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, BadZipFile) as error:
        raise DataError(
            "this is no saved state",
            path=str(file),
            expected="a file written by save_state",
            got=f"{type(error).__name__}: {error}",
            fix="write one with save_state(run.state, file)",
        ) from None
