"""Verbs: what the object of a lower room can do that only a higher room knows how to.

A graph can be drawn, a result plotted, a pipeline run; but the room that says what a graph is knows nothing
of drawing, nor may it. So the method stands in its class, with its arguments and what they mean, and hands
them to the function that stands under its name in one table. The top, `flowgraph/__init__`, fills the table,
which is therefore also the list of all places where a room speaks of a later one. A function is imported when
its verb is first used: a program that draws nothing imports nothing that draws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from flowgraph.errors import UnknownNameError

_places: dict[str, str] = {}
_functions: dict[str, Callable[..., Any]] = {}


def provide(verbs: Mapping[str, str]) -> None:
    """Say which functions carry out which methods: `{"Graph.draw": "flowgraph.drawing.draw:draw"}`."""
    _places.update(verbs)
    for method in verbs:
        _functions.pop(method, None)


def verb(method: str) -> Callable[..., Any]:
    """The function that carries out a method, imported when it is first asked for.

    Raises:
        UnknownNameError: where no room has said that it can.
    """
    if method not in _functions:
        if method not in _places:
            raise UnknownNameError("verb", method, _places)
        module, _, name = _places[method].partition(":")
        _functions[method] = getattr(import_module(module), name)
    return _functions[method]
