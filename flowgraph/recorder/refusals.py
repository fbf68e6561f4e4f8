"""Refusing a step by its line: the error names the place in the user's code that asked for what cannot be."""

from __future__ import annotations

import sys
from functools import partialmethod
from typing import Any, NoReturn

from flowgraph.errors import LoweringError, place


def caller() -> str:
    """module:line of the nearest frame outside the recording machinery."""
    frame = sys._getframe(1)
    while frame.f_back and is_machinery(frame.f_globals.get("__name__", "?")):
        frame = frame.f_back
    return place(frame.f_globals, frame.f_lineno)


_MODULES = """loop namespaces ops ranges replay specs refusals symbolic symbolic_namespace trace
tangents dual dual_rules dual_elements dual_moves dual_products derivatives"""

MACHINERY = tuple(f"{__package__}.{name}" for name in _MODULES.split())
"""Modules whose frames are not the user's code."""


def is_machinery(module: str) -> bool:
    """Whether a module records steps, and has no lines of the user's."""
    return module in MACHINERY or module.partition(".")[0] == "numpy"


def refuse(what: str, expected: str, got: str, fix: str, *, in_every_engine: bool = False) -> NoReturn:
    """Raise the error that names the block's source line."""
    error = LoweringError(what, path=caller(), expected=expected, got=got, fix=fix)
    error.in_every_engine = in_every_engine
    raise error


_IN_PLACE = {
    "add": "+", "sub": "-", "mul": "*", "truediv": "/", "floordiv": "//", "mod": "%", "pow": "**",
    "matmul": "@", "and": "&", "or": "|", "xor": "^", "lshift": "<<", "rshift": ">>",
}  # fmt: skip


def refuse_in_place(kind: type) -> None:
    """Let a class of arrays refuse `x += y` and its like, which change x itself in NumPy alone."""
    for name, sign in _IN_PLACE.items():
        setattr(kind, f"__i{name}__", partialmethod(_written, sign))


def _written(array: Any, sign: str, other: Any) -> NoReturn:
    refuse(
        "in-place write",
        "a new array",
        f"x {sign}= y",
        f"write x = x {sign} y: NumPy would change x itself",
        in_every_engine=True,
    )
