"""One file of C in the making: a reaction for each pattern of present inputs, and what they need.

Each pattern of present inputs has a reaction of its own, in which everything that depends on presence is
folded away; or there is one reaction in which presence is data.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from flowgraph.engines.c.constants import start_lines, table_text, without_repeats
from flowgraph.engines.c.entry import entry_text, parameters, reaction_name
from flowgraph.engines.c.expand import Expander
from flowgraph.engines.c.expressions import Expressions
from flowgraph.engines.c.header import header
from flowgraph.engines.c.helpers import helper_text, own_text
from flowgraph.engines.c.memory import Memory
from flowgraph.engines.c.names import Names, given, made, names_of
from flowgraph.engines.c.nodes import Buffer, Node, Store, Tape, View
from flowgraph.engines.c.patterns import Pattern, shared
from flowgraph.engines.c.preamble import MACROS, PACK, REFUSED
from flowgraph.engines.c.schedule import schedule
from flowgraph.engines.c.statements import Writer
from flowgraph.engines.c.syntax import comment
from flowgraph.engines.c.tables import join_tables
from flowgraph.engines.c.values import Value, row_major
from flowgraph.pipeline.optimise.aside import CHOOSE, Choice, put_aside
from flowgraph.pipeline.pipeline import Cell, Leaf, Pipeline, kind_of
from flowgraph.pipeline.program import Program, specialise
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.replay import Case
from flowgraph.recorder.trace import Instruction


@dataclass(frozen=True)
class Source:
    """Generated C.

    Args:
        names: of everything in it.
        real: "double" or "float".
        header, source: the texts of the two files.
        patterns: the keys that have a reaction, or None where one serves all.
        reactions: the names of their functions.
        presence: by key, or None for all, the outputs that are present for certain and those that can be, a
            bit each.
        longest: turns of the longest loop.
    """

    names: Names
    real: str
    header: str
    source: str
    patterns: tuple[int, ...] | None
    reactions: tuple[str, ...]
    presence: Mapping[int | None, tuple[int, int]]
    longest: int

    def presence_of(self, key: int) -> tuple[int, int]:
        """The outputs that are present for certain in a tick of this pattern, and those that can be."""
        return self.presence.get(None if self.patterns is None else key, (0, 0))


class File:
    """One file of C: reactions, and what they need.

    Args:
        pipeline, real, patterns, tidy, alone: as for `generate`.
    """

    writer: type[Writer] = Writer

    def __init__(
        self, pipeline: Pipeline, real: str, patterns: list[int] | None, tidy: Any, alone: bool
    ) -> None:
        self.pipeline, self.real, self.patterns, self.tidy = pipeline, real, patterns, tidy
        self.alone = alone
        self.names = names_of(pipeline)
        self.expressions = Expressions(real, self.turn, self.choice)
        self.constants: dict[Any, tuple[str, Buffer]] = {}
        self.memory = Memory(real, lambda dtype: self.expressions.ctype(dtype))
        self.presence: dict[int | None, tuple[int, int]] = {}
        self.longest = 0

    def source(self) -> Source:
        m = self.names.module
        whole = self.patterns is None
        patterns = [Pattern.all(self.pipeline)] if whole else shared(self.pipeline, self.patterns or ())
        reactions = [self.reaction(pattern) for pattern in patterns]
        reset = self._reset() if self.alone else None
        parts = [
            f'#include "{m}.h"',
            "",
            "#include <math.h>",
            "#include <stddef.h>",
            "",
            REFUSED,
            MACROS,
            PACK.replace("REAL", self.real) if self.expressions.packs else None,
            helper_text(self.expressions.helpers, self.real),
            own_text(self.expressions.called, self.expressions.helpers, self.real),
            *(self._constant(name, b) for name, b in self.constants.values()),
            *(text for _, text in self.expressions.functions.values()),
            *reactions,
            reset,
            entry_text(self.pipeline, self.names, self.real, patterns, checked=self.alone),
        ]
        text = "\n".join(p for p in parts if p is not None).rstrip() + "\n"
        head = partial(header, self.pipeline, self.names, self.real, self.patterns, self.memory.members())
        said = hashlib.sha256(f"{head('')}{text}".encode()).hexdigest()[:8]
        return Source(
            self.names,
            self.real,
            head(said),
            text,
            None if self.patterns is None else tuple(self.patterns),
            tuple(map(reaction_name, patterns)),
            self.presence,
            self.longest,
        )

    # -- one reaction --------------------------------------------------------------------------------

    def tidied(self, program: Program) -> Program:
        """The program made shorter, and its tables joined where numbers are as wide as what comes of that."""
        program = self.tidy(program)
        return join_tables(program) if self.real == "double" else program

    def reaction(self, pattern: Pattern) -> str:
        """The function of these patterns of present inputs."""
        pipeline, tape = self.pipeline, Tape()
        sites = {site.value: site for site in pipeline.random}
        program, choices = put_aside(specialise(pipeline, pattern.inputs, pattern.open), sites)
        program = self.tidied(program)
        values = self._given(tape, program, pattern)
        expander = Expander(tape, values)
        places = self._in_place(program)
        for i in program.instructions:
            if i.out in sites:
                values[i.out] = self._drawn(tape, sites[i.out], values[pipeline.seed])
            elif i.out in places:
                values[i.out] = expander.replayed(i, places[i.out])
            elif i.op == CHOOSE:
                values[i.out] = expander.chosen(i, choices[i.attrs["choice"]])
            else:
                expander.tell(program.elements, i)
                expander.play(i)
        roots: list[Any] = []
        flags: list[tuple[int, Node]] = []
        for k, ((flag, leaves), port) in enumerate(zip(program.outputs, pipeline.outputs, strict=True)):
            if flag is None:
                continue
            for name, leaf, n in zip(self.names.output_leaves[k], port.leaves, leaves, strict=True):
                buffer = self._place(f"{made(self.names)[k]}->{name}", "output", leaf)
                roots += self._write(expander, buffer, values[n])
            present = expander.form.elements(values[flag]).item()
            flags.append((k, present))
            roots.append(present)
        cells = [c for r in pipeline.registers for c in r.cells]
        for cell, n, name in zip(cells, program.writes, self._cell_names(), strict=True):
            if n in places and places[n].name == f"s->{name}":
                roots += places[n].writers
            elif n != cell.read:
                roots += self._write(expander, self.state[name], values[n])
        plan = schedule(tape, roots, blocks=self.writer.blocks)
        work, local = self.memory.placed(plan.span)
        writer = self.writer(plan, self.expressions, lambda b: work.get(b) or self._name(b))
        body = writer.body()
        self.longest = max(self.longest, *(math.prod(space) for _, space in writer.groups), 0)
        must = may = 0
        for k, present in flags:
            must, may = must | (writer.ref(present) == "true") << k, may | 1 << k
        self.presence.update({key: (must, may) for key in pattern.keys or (None,)})
        body += self.told(writer, flags)
        all_text = re.sub(r"/\*.*?\*/", "", "\n".join(body))
        unused = [n for _, n in parameters(self.names, pattern) if not _names_it(all_text, n)]
        head = [f"    (void){n};" for n in unused]
        return "\n".join([self.signature(pattern), "{", *head, *local, *body, "}", ""])

    def told(self, writer: Writer, flags: list[tuple[int, Node]]) -> list[str]:
        """The end of a reaction: which outputs are there."""
        lines = ["    uint64_t made = 0;"]
        for k, present in flags:
            bit = f"made |= UINT64_C({1 << k}); /* {comment(self.pipeline.outputs[k].name)} */"
            text = writer.ref(present)
            lines.append(f"    {bit}" if text == "true" else f"    if ({text}) {bit}")
        return [*lines, "    return made;"]

    def _in_place(self, program: Program) -> dict[int, Buffer]:
        """The replays that can make a register anew where it lies, with its memory: nobody else reads it."""
        readers = Counter(a for i in program.instructions for a in i.args)
        readers.update(n for _, leaves in program.outputs for n in leaves)
        readers.update(program.writes)
        cells = (c for r in self.pipeline.registers for c in r.cells)
        made = {i.out: i.args[0] for i in program.instructions if i.op == "replay"}
        return {
            n: replace(self._place(f"s->{name}", "work", cell), writers=[])
            for cell, n, name in zip(cells, program.writes, self._cell_names(), strict=True)
            if made.get(n) == cell.read and readers[cell.read] == 1 and program.writes.count(n) == 1
        }

    def turn(self, name: str, case: Case, sizes: tuple[int, int]) -> str:
        """The function of one case of a replay: what comes of the history before and of a row."""
        before, row = (Spec((n,), "real") for n in sizes)
        specs = {0: before, 1: row, **{n: Spec(a.shape, kind_of(a)) for n, a in case.constants.items()}}
        specs |= {t.out: t.spec for t in case.turns}
        steps = tuple(Instruction(t.op, t.args, t.attrs, t.out, t.spec, t.line) for t in case.turns)
        program = Program(case.constants, steps, ((None, ()),), (case.result,), specs, (0,))
        real, state = self.real, f"{self.names.module}_state"
        head = (
            f"static FG_APART void {name}({state} *s, const {real} *before, const {real} *row, {real} *after)"
        )
        program, choices = put_aside(program)
        return self._apart(head, program, choices, {0: "before", 1: "row"}, "after", "turn_")

    def choice(self, name: str, choice: Choice) -> str:
        """The function of what is rarely taken."""
        real = self.expressions.ctype("real")
        inputs = {n: f"from{k}" for k, n in enumerate(choice.inputs)}
        given = [f"const {real} *restrict {text}" for text in inputs.values()]
        given = [f"{self.names.module}_state *s", *given, f"{real} *restrict made"]
        head = f"static FG_APART void {name}({', '.join(given)})"
        return self._apart(head, choice.program, [], inputs, "made", "choice_")

    def _apart(
        self,
        head: str,
        program: Program,
        choices: list[Choice],
        inputs: dict[int, str],
        result: str,
        whose: str,
    ) -> str:
        """A function of arrays of reals beside the reactions.

        Args:
            head: how it begins.
            program: its one register is the result.
            choices: that it names.
            inputs: what it is given, by number.
            result: where its result belongs.
            whose: its large buffers are.
        """
        program = self.tidied(program)
        tape, values = Tape(), {}
        for n, text in inputs.items():
            spec = program.specs[n]
            values[n] = _whole(Buffer(text, "real", math.prod(spec.shape), "input"), spec.shape)
        for n, array in program.constants.items():
            values[n] = self._known(np.asarray(array), program.specs[n].dtype)
        expander = Expander(tape, values)
        for i in program.instructions:
            if i.op == CHOOSE:
                values[i.out] = expander.chosen(i, choices[i.attrs["choice"]])
            else:
                expander.tell(program.elements, i)
                expander.play(i)
        after = values[program.writes[0]]
        place = Buffer(result, "real", math.prod(after.shape), "output")
        plan = schedule(tape, self._write(expander, place, after), blocks=self.writer.blocks)
        work, local = self.memory.placed(plan.span, whose)
        body = self.writer(plan, self.expressions, lambda b: work.get(b) or self._name(b)).body()
        unused = [n for n in ("s", *inputs.values()) if not _names_it("\n".join(body), n)]
        return "\n".join([head, "{", *(f"    (void){n};" for n in unused), *local, *body, "}", ""])

    def signature(self, pattern: Pattern) -> str:
        return f"static uint64_t {self.called(pattern)}"

    def called(self, pattern: Pattern) -> str:
        """The name of a reaction with its parameters."""
        typed = (
            f"{type_}{'' if type_[-1] == '*' else ' '}{n}" for type_, n in parameters(self.names, pattern)
        )
        return f"{reaction_name(pattern)}({', '.join(typed)})"

    def _cell_names(self) -> list[str]:
        return [n for names in self.names.registers for n in names]

    def _place(self, name: str, kind: str, leaf: Leaf | Cell) -> Buffer:
        return Buffer(name, leaf.dtype, math.prod(leaf.shape), kind, bare=leaf.shape == ())

    def _given(self, tape: Tape, program: Program, pattern: Pattern) -> dict[int, Value]:
        """The values that no instruction makes."""
        pipeline = self.pipeline
        values: dict[int, Value] = {}

        def scalar(n: int, node: Node) -> None:
            values[n] = Value(Spec((), node.dtype), np.array(node, object).reshape(()))

        scalar(pipeline.time, tape.given("time", "int64"))
        seed = Buffer("s->seed", "uint32", 2, "state")
        values[pipeline.seed] = Value(Spec((2,), "uint32"), view=View(seed, (2,), 0, (1,)))
        self.state: dict[str, Buffer] = {}
        for cell, name in zip(
            (c for r in pipeline.registers for c in r.cells), self._cell_names(), strict=True
        ):
            self.state[name] = self._place(f"s->{name}", "state", cell)
            values[cell.read] = _whole(self.state[name], cell.shape)
        for k, port in enumerate(pipeline.inputs):
            here = pattern.inputs >> k & 1
            if pattern.open >> k & 1:
                scalar(port.present, tape.given(f"((present >> {k}) & 1u)", "bool"))
            for name, leaf in zip(self.names.input_leaves[k], port.leaves, strict=True):
                if here:
                    values[leaf.value] = _whole(
                        self._place(f"{given(self.names)[k]}->{name}", "input", leaf), leaf.shape
                    )
                else:
                    zeros = np.zeros(leaf.shape, _HOST.get(leaf.dtype, leaf.dtype))
                    values[leaf.value] = self._known(zeros, leaf.dtype)
        for n, array in program.constants.items():
            if n not in values:
                values[n] = self._known(np.asarray(array), program.specs[n].dtype)
        return values

    def _known(self, array: np.ndarray, dtype: str) -> Value:
        kept, steps = without_repeats(array)
        view = View(self._kept(kept, dtype), array.shape, 0, steps)
        return Value(Spec(array.shape, dtype), view=view)

    def _kept(self, array: np.ndarray, dtype: str) -> Buffer:
        key = (array.tobytes(), array.shape, dtype)
        if key not in self.constants:
            name = f"k{len(self.constants)}"
            self.constants[key] = name, Buffer(name, dtype, array.size, "const", data=array)
        return self.constants[key][1]

    def _drawn(self, tape: Tape, site: Any, seed: Value) -> Value:
        blocks = -(-math.prod(site.shape) // 4)
        assert seed.view is not None
        view = View(tape.work("real", 4 * blocks), site.shape, 0, row_major(site.shape))
        if blocks:
            tape.origin = f"random numbers {site.name}"
            tape.macro("random", [seed.view], view, draws=site.kind, hash=site.hash)
        return Value(Spec(site.shape, "real"), view=view)

    def _write(self, expander: Expander, buffer: Buffer, value: Value) -> list[Store]:
        before = len(buffer.writers)
        view = View(buffer, value.shape, 0, row_major(value.shape))
        expander.form.write(view, expander.form.elements(value))
        return [
            w
            for w in buffer.writers[before:]
            if isinstance(w, Store)
            and not (w.node.op == "load" and w.node.extra == (buffer, w.offset, w.strides))
        ]

    # -- memory --------------------------------------------------------------------------------------

    def _name(self, buffer: Buffer) -> str:
        if buffer.kind == "const" and not buffer.name:
            assert buffer.data is not None
            buffer.name = self._kept(buffer.data, buffer.dtype).name
        if buffer.kind == "const":
            self.used_constants.add(buffer.name)
        return buffer.name

    @property
    def used_constants(self) -> set[str]:
        used: set[str] = self.__dict__.setdefault("_used", set())
        return used

    # -- the rest of the file ------------------------------------------------------------------------

    def _constant(self, name: str, buffer: Buffer) -> str | None:
        if name not in self.used_constants or buffer.data is None:
            return None
        return table_text(name, buffer.data, Spec(buffer.data.shape, buffer.dtype), self.real)

    def _table(self, array: np.ndarray, dtype: str) -> str:
        return self._name(self._kept(array, dtype))

    def _reset(self) -> str:
        m = self.names.module
        lines = [f"void {m}_reset({m}_state *s, uint64_t seed)", "{"]
        cells = (c for r in self.pipeline.registers for c in r.cells)
        for name, cell in zip(self._cell_names(), cells, strict=True):
            start, spec = np.asarray(cell.reset), Spec(cell.shape, cell.dtype)
            table = partial(self._table, dtype=cell.dtype)
            lines += [f"    {line}" for line in start_lines(f"s->{name}", start, spec, self.real, table)]
        lines += ["    s->seed[0] = (uint32_t)seed;", "    s->seed[1] = (uint32_t)(seed >> 32);", "}", ""]
        return "\n".join(lines)


def _names_it(text: str, name: str) -> bool:
    return re.search(rf"(?<![A-Za-z0-9_>.]){re.escape(name)}\b", text) is not None


def _whole(buffer: Buffer, shape: tuple[int, ...]) -> Value:
    return Value(Spec(shape, buffer.dtype), view=View(buffer, shape, 0, row_major(shape)))


_HOST = {"real": np.float64, "bool": np.bool_}
