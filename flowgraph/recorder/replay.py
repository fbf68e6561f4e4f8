"""The body of `replay`: what one turn of it does, as a list of instructions within an instruction.

    replay(history, rows, first, count)    history (N, k), rows (N, m)

goes through the places first, first + 1, ... of a ring, `count` of them, and makes each row of the history of
the one before it and of the row of what happened there:

    history[i] = turn(history[i - 1], rows[i])        i modulo N

It is the one loop that a pipeline has: bounded, of one body, and without a branch but one. A body has one
case or several, of which rows[i, 0] names the one for a turn by its number. Each is a list as a pipeline's
own, in single assignment: value 0 is the history before (k), value 1 the row (m), and `result` what comes of
them (k).

A `Body` is plain data, as it stands in a description: {"cases": [{"constants", "instructions", "result"}]}.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from flowgraph.recorder.specs import ShapeError, Spec
from flowgraph.types import DTYPES


class Turn(NamedTuple):
    """One instruction of a turn: `out = op(*args, **attrs)`."""

    op: str
    args: tuple[int, ...]
    attrs: dict[str, Any]
    out: int
    spec: Spec
    line: str


class Case(NamedTuple):
    """One list of instructions, with its constants by number and the number of its result."""

    constants: dict[int, np.ndarray]
    turns: tuple[Turn, ...]
    result: int


class Body(dict[str, Any]):
    """What a turn does, as plain data that is also ready to be played."""

    @cached_property
    def checked(self) -> set[tuple[int, int]]:
        """The sizes of history and rows for which it was found sound."""
        return set()

    @cached_property
    def players(self) -> dict[Any, Any]:
        """By kind of real, what an engine has made of it."""
        return {}

    @cached_property
    def cases(self) -> tuple[Case, ...]:
        """The cases, read.

        Raises:
            ShapeError: where they are malformed.
        """
        try:
            found = tuple(_read(case) for case in self["cases"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ShapeError(f"the body of a replay is malformed: {error!r}") from None
        if not found:
            raise ShapeError("the body of a replay has no case")
        return found


def body_of(given: Mapping[str, Any]) -> Body:
    """The body that plain data describe."""
    if not isinstance(given, Mapping):
        raise ShapeError("the body of a replay is no mapping")
    return given if isinstance(given, Body) else Body(given)


def _read(case: Mapping[str, Any]) -> Case:
    constants = {
        int(c["value"]): np.array(c["data"], dtype=object).astype(DTYPES[c["dtype"]]).reshape(c["shape"])
        for c in case["constants"]
    }
    turns = tuple(
        Turn(
            str(i["op"]),
            tuple(i["args"]),
            dict(i.get("attrs", {})),
            int(i["value"]),
            Spec(tuple(i["shape"]), str(i["dtype"])),
            str(i["line"]),
        )
        for i in case["instructions"]
    )
    return Case(constants, turns, int(case["result"]))


def written(case: Case) -> dict[str, Any]:
    """A case as plain data."""
    return {
        "constants": [
            {"value": n, "shape": list(a.shape), "dtype": _kind(a), "data": _numbers(a)}
            for n, a in case.constants.items()
        ],
        "instructions": [
            {"value": t.out, "op": t.op, "args": list(t.args)}
            | ({"attrs": t.attrs} if t.attrs else {})
            | {"shape": list(t.spec.shape), "dtype": t.spec.dtype, "line": t.line}
            for t in case.turns
        ],
        "result": case.result,
    }


def _kind(array: np.ndarray) -> str:
    return "real" if array.dtype.kind == "f" else array.dtype.name


def _numbers(array: np.ndarray) -> Any:
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        spelled = np.array([x if np.isfinite(x) else str(x) for x in array.ravel().tolist()], dtype=object)
        return spelled.reshape(array.shape).tolist()
    return array.tolist()


Bind = Callable[[Turn, Any], Callable[..., Any]]
"""What a turn's instruction is as a function of arrays, given the kind of real."""


def play(history: Any, rows: Any, first: Any, count: Any, body: Mapping[str, Any], bind: Bind) -> np.ndarray:
    """In NumPy: the history (N, k) after `count` turns from place `first` on."""
    made, found = body_of(body), np.array(history)
    real, places = found.dtype, len(found)
    if real not in made.players:
        made.players[real] = [partial(_turn, *_bound(case, real, bind)) for case in made.cases]
    cases = made.players[real]
    start, turns = int(first), min(max(int(count), 0), places)
    with np.errstate(all="ignore"):
        for k in range(start, start + turns):
            row = rows[k % places]
            which = min(max(int(row[0]), 0), len(cases) - 1) if len(cases) > 1 else 0
            found[k % places] = cases[which](found[(k - 1) % places], row)
    return found


def _bound(case: Case, real: Any, bind: Bind) -> tuple[dict[int, Any], list[Any], int]:
    known = {n: a.astype(real) if a.dtype.kind == "f" else a for n, a in case.constants.items()}
    return known, [(bind(t, real), t.args, t.out) for t in case.turns], case.result


def _turn(known: dict[int, Any], steps: list[Any], result: int, before: Any, row: Any) -> Any:
    values: dict[int, Any] = {**known, 0: before, 1: row}
    for run, args, out in steps:
        values[out] = run(*[values[a] for a in args])
    return values[result]
