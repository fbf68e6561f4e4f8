"""What the parts of a pipeline are called in C: each an identifier of its own in its scope.

A user's name may be a word of C, of its headers, of Make or of this generator. There are three scopes. The
filter itself names files, and begins every name that a linker or another file sees (`ekf.h`, `ekf_state`,
`EKF_POSE`). Its ports end such names; as parameters they are called `in_...` and `out_...`, as nothing else
is. Fields and register cells stand behind a dot or an arrow, where only keywords and macros can meet them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from flowgraph.engines.c.syntax import identifier, unique
from flowgraph.pipeline.pipeline import Pipeline

_WORDS = """
    alloca assert complex ctype dirent endian errno error fcntl features fenv float glob inttypes iso646
    limits link locale malloc math memory poll pthread regex sched search semaphore setjmp signal stdalign
    stdarg stdatomic stdbool stddef stdint stdio stdlib stdnoreturn string strings tgmath threads time uchar
    unistd utime values version wchar wctype
    main makefile gnumakefile aux con nul prn
    int8 int16 int32 int64 uint8 uint16 uint32 uint64 int_least8 int_least16 int_least32 int_least64
    uint_least8 uint_least16 uint_least32 uint_least64 int_fast8 int_fast16 int_fast32 int_fast64
    uint_fast8 uint_fast16 uint_fast32 uint_fast64 intmax uintmax intptr uintptr ptrdiff sig_atomic size ssize
    wint char schar shrt ushrt uint long ulong llong ullong flt dbl ldbl fp m l lc mb sig seek exit rand tmp
    fopen filename huge path clock clocks lgamma strtok posix aligned quick at max fg flowgraph in out
"""
_MODULES = frozenset(_WORDS.split())
"""What no filter is called: its files, or its name with a port behind it, would be something else."""

PORTS = ("state", "reset", "react", "overflow", "not_finite", "t")
"""What no port is called: the rest of the interface is called this, and `_t` ends types of the headers."""

_CELLS = ("seed",)
_MACROS = (
    "BUFSIZ", "DOMAIN", "EDOM", "EILSEQ", "EOF", "ERANGE", "HUGE", "I", "INFINITY", "NAN", "NULL", "OVERFLOW",
    "PLOSS", "SING", "TLOSS", "UNDERFLOW",
)  # fmt: skip


@dataclass(frozen=True)
class Names:
    """What the parts of a pipeline are called in C."""

    module: str
    inputs: tuple[str, ...]
    input_leaves: tuple[tuple[str, ...], ...]
    outputs: tuple[str, ...]
    output_leaves: tuple[tuple[str, ...], ...]
    registers: tuple[tuple[str, ...], ...]


def names_of(pipeline: Pipeline) -> Names:
    """Identifiers for everything in a pipeline, each once in its scope."""
    module = _module(pipeline.name)
    ports = unique((_port(p.name, module) for p in (*pipeline.inputs, *pipeline.outputs)), PORTS)
    split = len(pipeline.inputs)
    cells = unique((_member(_cell_name(r.path, c.name)) for r in pipeline.registers for c in r.cells), _CELLS)
    places = iter(cells)
    return Names(
        module,
        tuple(ports[:split]),
        tuple(tuple(unique(_member(leaf.name) for leaf in p.leaves)) for p in pipeline.inputs),
        tuple(ports[split:]),
        tuple(tuple(unique(_member(leaf.name) for leaf in p.leaves)) for p in pipeline.outputs),
        tuple(tuple(next(places) for _ in r.cells) for r in pipeline.registers),
    )


def _module(text: str) -> str:
    name = identifier(text)
    return f"g_{name}" if name.lower() in _MODULES else name


def _port(text: str, module: str) -> str:
    name = identifier(text)
    if module.isupper():
        name = name.lower()  # or the struct MODULE_PORT and the bit of the port would be one word
    return f"{name}_2" if name.lower().endswith("_t") else name


def _member(text: str) -> str:
    name = identifier(text)
    macro = name in _MACROS or re.fullmatch(r"[A-Z0-9]+(_[A-Z0-9]+)+", name)
    return f"g_{name}" if macro else name


def _cell_name(path: str, cell: str) -> str:
    return path if cell == "value" else f"{path}_{cell}"


def given(names: Names) -> tuple[str, ...]:
    """What the parameters for the inputs are called."""
    return tuple(f"in_{n}" for n in names.inputs)


def made(names: Names) -> tuple[str, ...]:
    """What the parameters for the outputs are called."""
    return tuple(f"out_{n}" for n in names.outputs)
