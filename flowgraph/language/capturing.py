"""What a function reads from around it: globals, and through them attributes of modules and classes.

It is read off the function's code. Functions of the user's own modules are looked into; those of flowgraph,
of Python and of installed packages are taken as they are.
"""

from __future__ import annotations

import dis
import functools
import sys
from collections.abc import Mapping
from types import CodeType, FunctionType, ModuleType
from typing import Any

Chains = frozenset[tuple[str, ...]]
"""How a name is used: the attributes read from it in turn, `("GAINS", "yaw")`; () where it is used itself."""

_FOREIGN = ("site-packages", "dist-packages")


@functools.lru_cache(maxsize=1024)
def is_own(module: str) -> bool:
    """Whether a module is the user's: neither flowgraph's, nor Python's, nor an installed package's."""
    top = module.partition(".")[0]
    if top in ("flowgraph", "builtins") or (top in sys.stdlib_module_names and top != "__main__"):
        return False
    file = getattr(sys.modules.get(module), "__file__", None) or ""
    return not any(f"/{part}/" in file.replace("\\", "/") for part in _FOREIGN)


def is_own_function(function: FunctionType) -> bool:
    """Whether a function was written by the user."""
    return is_own(str(function.__globals__.get("__name__", "__main__")))


def is_own_namespace(value: Any) -> bool:
    """Whether a value is a module or class of the user's."""
    if isinstance(value, ModuleType):
        return is_own(value.__name__)
    return isinstance(value, type) and is_own(value.__module__)


@functools.lru_cache(maxsize=4096)
def names_read(code: CodeType) -> Mapping[str, Chains]:
    """The names of other scopes that a function's code reads, functions inside it included, and how."""
    found: dict[str, set[tuple[str, ...]]] = {}
    instructions = list(dis.get_instructions(code))
    for at, instruction in enumerate(instructions):
        if instruction.opname not in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_DEREF", "LOAD_CLASSDEREF"):
            continue
        chain: list[str] = []
        for following in instructions[at + 1 :]:
            if following.opname not in ("LOAD_ATTR", "LOAD_METHOD"):
                break
            chain.append(str(following.argval))
        found.setdefault(str(instruction.argval), set()).add(tuple(chain))
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            for name, chains in names_read(inner).items():
                found.setdefault(name, set()).update(chains)
    return {name: frozenset(chains) for name, chains in found.items()}
