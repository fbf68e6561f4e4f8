"""C text in the making: lines, loops over shapes, small tables of shifts, and where each value lies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from flowgraph.engines.fixed.engine import Bound, Integers
from flowgraph.engines.fixed.places import KNOWN, WORDS, Places
from flowgraph.engines.fixed.shifts import slim
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction

_WRAP = {"uint32": "(int64_t)(uint32_t)({})", "int32": "(int64_t)(int32_t)({})", "bool": "(({}) != 0)"}


class Text:
    """C text of the ticks of a pipeline in its formats.

    Args:
        player: the interpreter, which knows the formats.
        places: where values lie.
        marks: whether what is cut is marked where it lies, in `off`, and lost words are counted by value.
            Else all of a kind are counted together, in `count`.
        tabled: whether shifts and the largest words are read from `fx_s` and `fx_m` when it runs, so that the
            text is that of a structure, whatever the formats: `shifts` and `mosts` are what goes there.
    """

    def __init__(self, player: Integers, places: Places, *, marks: bool = True, tabled: bool = False) -> None:
        self.player, self.pipeline = player, player.pipeline
        self.places, self.marks, self.tabled = places, marks, tabled
        self.shifts: list[np.ndarray] = []
        self.mosts: list[int] = []
        self._shifts = 0
        self.tables: dict[bytes, str] = {}
        self.lines: list[str] = []
        self.indent = 1
        self.lost: dict[int, int] = {}
        self.bound: Bound
        self.most: int | None = None
        self.drop: dict[int, int] = {}

    # -- text ----------------------------------------------------------------------------------------

    def put(self, line: str) -> None:
        self.lines.append("  " * self.indent + line)

    def table(self, numbers: np.ndarray, name: str = "s", kind: str = "int16_t") -> str:
        row = np.ascontiguousarray(numbers, dtype=np.int64).ravel()
        key = kind.encode() + row.tobytes()
        if key not in self.tables:
            self.tables[key] = (
                f"static const {kind} {name}{len(self.tables)}[] = {{{', '.join(map(str, row))}}};"
            )
        return self.tables[key].split()[3].split("[")[0]

    def row(self, by: np.ndarray, place: str) -> str:
        """The element at a place of a row of shifts."""
        if not self.tabled:
            return f"{self.table(by)}[{place}]"
        base, self._shifts = self._shifts, self._shifts + by.size
        self.shifts.append(np.ravel(by))
        return f"fx_s[{plus(base, place)}]"

    def shift(self, by: np.ndarray, index: Sequence[str]) -> str:
        """A shift at an index of the loops around: a number, or an element of a table."""
        if self.tabled:
            by = np.asarray(by)
            return self.row(by, flat(by.shape, index) if by.size != 1 else "0")
        by = slim(np.asarray(by))
        if by.size == 1:
            return str(int(by.ravel()[0]))
        return self.row(by, flat(by.shape, index))

    @contextmanager
    def loops(self, shape: Sequence[int]) -> Iterator[list[str]]:
        """Nested loops over a shape; gives the names of their indices."""
        names = [f"i{self.indent}_{n}" for n in range(len(shape))]
        opened = 0
        for name, size in zip(names, shape, strict=True):
            if size != 1:
                self.put(f"for (int {name} = 0; {name} < {size}; ++{name}) {{")
                self.indent += 1
                opened += 1
        yield [n if size != 1 else "0" for n, size in zip(names, shape, strict=True)]
        for _ in range(opened):
            self.indent -= 1
            self.put("}")

    def word(self, value: int, index: Sequence[str]) -> str:
        """The element of a value at an index of a shape that it broadcasts to: 64 bits that are read."""
        found = wide(self.to(value, index))
        return f"fx_upper({found}, {self.drop[value]})" if value in self.drop else found

    def to(self, value: int, index: Sequence[str]) -> str:
        """The same, as what is written."""
        shape = self.shape(value)
        return self.element(value, shape, flat(shape, index[len(index) - len(shape) :]))

    def element(self, value: int, shape: Sequence[int], place: str) -> str:
        """The element of a value at a place in it."""
        array, base = self.places.at(value, shape)
        return f"{array}[{plus(base, place)}]"

    def said(self, i: Instruction) -> None:
        """What a reader is told of an instruction, ahead of it."""
        self.put(f"/* v{i.out} = {i.op} {list(i.spec.shape)}  {i.line} */")

    def product(self, a: str, b: str) -> str:
        """Two words multiplied."""
        return f"{a} * {b}"

    def put_to(self, to: str, text: str) -> None:
        """The statement that puts words that fit into their place."""
        self.put(f"{to} = {narrow(to, text)};")

    def shape(self, value: int) -> tuple[int, ...]:
        return self.bound.program.specs[value].shape

    def fitted(self, place: str, text: str) -> str:
        """The statement that puts a result into its place, cut to a word where it does not fit."""
        if not self.marks:
            most = int(self.player.most) if self.most is None else self.most
            return f"{place} = {narrow(place, f'fx_fit({text}, count, INT64_C({most}))')};"
        if self.tabled:
            self.mosts.append(int(self.player.most) if self.most is None else self.most)
            return f"{place} = fx_fit({text}, off, {place[2:-1]}, fx_m[{len(self.mosts) - 1}]);"
        if self.most is None or self.most == int(self.player.most):
            return f"{place} = FX_FIT({text}, {place[2:-1]});"
        return f"{place} = fx_fit({text}, off, {place[2:-1]}, INT64_C({self.most}));"

    def by_zero(self, place: str) -> str:
        """The statement that notes a quotient by zero."""
        return f"FX_MARK({place[2:-1]}, 2);" if self.marks else "++count[1];"

    def counter(self, value: int) -> str:
        """The counter of a value's lost words."""
        if not self.marks:
            return "count[2]"
        return f"lost[{self.lost.setdefault(value, len(self.lost))}]"

    def wrapped(self, text: str, spec: Spec) -> str:
        return _WRAP.get(spec.dtype, "(int64_t)({})").format(text)


def wide(element: str) -> str:
    """An element as 64 bits."""
    return element if element[0] in (WORDS, KNOWN) else f"(int64_t){element}"


def never_none(text: str) -> bool:
    """Whether a word that `wide` gave has no room for a reading that is not there."""
    return text.startswith("(int64_t)")


def unless_none(word: str, text: str) -> str:
    """What is made of a word, or none where it is none."""
    return text if never_none(word) else f"({word} == FX_NAN ? FX_NAN : {text})"


def narrow(element: str, text: str) -> str:
    """64 bits as an element has them."""
    return text if element[0] in (WORDS, KNOWN) else f"(int32_t)({text})"


def plus(base: int, rest: str) -> str:
    return str(base) if rest == "0" else rest if base == 0 else f"{base} + {rest}"


def flat(shape: Sequence[int], index: Sequence[str]) -> str:
    """The place of an element in an array laid out row by row; axes of one stay at 0."""
    parts = []
    stride = 1
    for size, x in zip(reversed(shape), reversed(index), strict=True):
        if size != 1 and x != "0":
            parts.append(x if stride == 1 else f"{stride} * ({x})" if "+" in x else f"{stride} * {x}")
        stride *= size
    return " + ".join(reversed(parts)) or "0"
