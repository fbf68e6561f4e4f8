"""A pipeline that also computes how its outputs change with some numbers that it starts from.

The instructions are played once on dual arrays over symbolic ones, so that what is recorded computes both
every value and its change along p directions: forward derivatives of the whole run, as a pipeline of its own
that any engine plays. Changes live in registers beside those of the values and start from what the caller
says: that of a register's initial value with a parameter. With real constants lifted into registers, this is
the derivative by whatever settings of a graph those come from.

What does not depend on any direction stays as it was. A register's change is carried where its value is found
to change, which is asked again until nothing is added.

Source: A. Griewank and A. Walther, "Evaluating Derivatives", 2nd ed., SIAM 2008, sec. 3.1 (forward mode).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.pipeline.pipeline import Cell, Leaf, Pipeline, Port, Register, Stage
from flowgraph.recorder.derivatives import Duals
from flowgraph.recorder.dual import Dual
from flowgraph.recorder.dual_rules import RULES
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.recorder.symbolic_namespace import namespace as symbolic
from flowgraph.recorder.tangents import spread
from flowgraph.recorder.trace import Instruction, Trace
from flowgraph.types import DTYPES

__all__ = ["CHANGE", "sensitivity"]

CHANGE = "_change"
"""Behind the name of a register's cell, or of a leaf of a port: its change (p, *shape)."""

Place = tuple[str, str]
"""A register by its path and a cell of it by name; or an input and a leaf of it."""


def sensitivity(
    pipeline: Pipeline,
    p: int,
    starts: Collection[Place],
    outputs: Collection[str],
    inputs: Collection[Place] = (),
) -> Pipeline:
    """The pipeline with changes along p directions.

    Args:
        pipeline: without host blocks.
        p: how many directions.
        starts: the register cells whose initial values change.
        outputs: the ports that are wanted; each real leaf NAME has NAME_change (p, *shape) beside it.
        inputs: the leaves of inputs that change; each has NAME_change (p, *shape) beside it.

    Returns:
        A pipeline in which a register with a change has a cell NAME_change (p, *shape), zero at reset.
    """
    active = set(starts)
    while True:
        made = _Differentiated(pipeline, p, active, outputs, set(inputs))
        if made.found <= active:
            return made.pipeline()
        active |= made.found


class _Differentiated:
    """One pass over the instructions, with changes in the registers that are said to have them."""

    def __init__(
        self, pipeline: Pipeline, p: int, active: set[Place], outputs: Collection[str], inputs: set[Place]
    ) -> None:
        self._of, self._p, self._active, self._wanted, self._inputs = pipeline, p, active, outputs, inputs
        self._trace = Trace()
        self._duals = Duals(symbolic)
        self._key = tuple(range(p))
        self._env: dict[int, Any] = {}
        self._changes: dict[Place, int] = {}
        self._stages: list[Stage] = []
        self._play()
        self.found = {
            (r.path, c.name)
            for r in pipeline.registers
            for c in r.cells
            if isinstance(self._env[c.write], Dual)
        }

    def _play(self) -> None:
        of, trace = self._of, self._trace
        self._env[of.time] = trace.input(Spec((), "int64"))
        self._env[of.seed] = trace.input(Spec((2,), "uint32"))
        for port in of.inputs:
            self._env[port.present] = trace.input(Spec((), "bool"))
            for leaf in port.leaves:
                self._env[leaf.value] = self._value(leaf, (port.name, leaf.name), self._inputs)
        for register in of.registers:
            for cell in register.cells:
                self._env[cell.read] = self._value(cell, (register.path, cell.name), self._active)
        self._env |= {n: trace.constant(a) for n, a in of.constants.items() if n not in self._env}
        for stage in of.stages:
            begin = len(trace.instructions)
            for i in stage.instructions:
                with _at(trace, i.line):
                    self._env[i.out] = self._applied(i)
            recorded = tuple(trace.instructions[begin:])
            self._stages.append(replace(stage, enable=-1, instructions=recorded))

    def _value(self, part: Leaf | Cell, place: Place, changing: set[Place]) -> Any:
        value = self._trace.input(Spec(part.shape, part.dtype))
        if place not in changing or part.dtype != "real":
            return value
        change = self._trace.input(Spec((self._p, *part.shape), "real"))
        self._changes[place] = change.number
        return Dual(self._duals, value, {self._key: change})

    def _applied(self, i: Instruction) -> Any:
        args = [self._env[a] for a in i.args]
        if not any(isinstance(a, Dual) for a in args) or i.op not in RULES:
            return self._trace.apply(i.op, *(a.value if isinstance(a, Dual) else a for a in args), **i.attrs)
        values = [a.value if isinstance(a, Dual) else a for a in args]
        tangents = [a.tangent if isinstance(a, Dual) else {} for a in args]
        made = self._duals.made(*RULES[i.op](symbolic, values, tangents, **_attributes(i)))
        return made if isinstance(made, Dual | Symbolic) else self._trace.constant(made)

    # -- what comes of it ------------------------------------------------------------------------------

    def pipeline(self) -> Pipeline:
        of = self._of
        begin = len(self._trace.instructions)
        inputs = tuple(self._port(port, self._inputs, None) for port in of.inputs)
        outputs = tuple(self._port(port, None, port.name in self._wanted) for port in of.outputs)
        registers = tuple(self._register(r) for r in of.registers)
        stages = [
            replace(new, enable=self._plain(old.enable))
            for new, old in zip(self._stages, of.stages, strict=True)
        ]
        late = tuple(self._trace.instructions[begin:])
        if late:
            always = self._trace.constant(np.True_).number
            stages.append(Stage("changes", "changes", always, (), (), late))
        return Pipeline(
            of.name,
            of.doc,
            self._env[of.time].number,
            self._env[of.seed].number,
            inputs,
            outputs,
            registers,
            dict(self._trace.constants),
            tuple(stages),
            of.faults,
            tuple(replace(site, value=self._plain(site.value)) for site in of.random),
            of.limits,
        )

    def _plain(self, number: int) -> int:
        value = self._env[number]
        found: int = (value.value if isinstance(value, Dual) else value).number
        return found

    def _change(self, number: int, shape: tuple[int, ...]) -> int:
        """The number of a change (p, *shape) of a value; zeros where it has none."""
        value = self._env[number]
        full = (self._p, *shape)
        if not isinstance(value, Dual):
            return self._trace.constant(np.zeros(full)).number
        rows: list[Any] = [np.zeros((1, *shape))] * self._p
        for key, d in value.tangent.items():
            whole = spread(symbolic, d, shape, range(len(shape)))
            if key == self._key:
                return self._number(whole, full)
            for row, direction in enumerate(key):
                rows[direction] = whole[row : row + 1, ...]
        return self._number(symbolic.concat(rows, axis=0), full)

    def _number(self, value: Any, shape: tuple[int, ...]) -> int:
        if not isinstance(value, Symbolic):
            value = self._trace.constant(np.broadcast_to(value, shape))
        found: int = value.number
        return found

    def _port(self, port: Port, places: set[Place] | None, wanted: bool | None) -> Port:
        leaves = []
        for leaf in port.leaves:
            leaves.append(replace(leaf, value=self._plain(leaf.value)))
            change = None
            if places is not None:
                change = (
                    self._changes.get((port.name, leaf.name)) if (port.name, leaf.name) in places else None
                )
            elif wanted and leaf.dtype == "real":
                change = self._change(leaf.value, leaf.shape)
            if change is not None:
                leaves.append(Leaf(f"{leaf.name}{CHANGE}", change, (self._p, *leaf.shape), "real"))
        return replace(port, present=self._plain(port.present), leaves=tuple(leaves))

    def _register(self, register: Register) -> Register:
        cells = []
        for cell in register.cells:
            cells.append(replace(cell, read=self._plain(cell.read), write=self._plain(cell.write)))
            place = (register.path, cell.name)
            if place in self._changes:
                shape = (self._p, *cell.shape)
                write = self._change(cell.write, cell.shape)
                zero = np.zeros(shape, DTYPES["real"])
                cells.append(Cell(f"{cell.name}{CHANGE}", self._changes[place], write, shape, "real", zero))
        return replace(register, cells=tuple(cells))


def _attributes(i: Instruction) -> dict[str, Any]:
    """The attributes of an instruction as functions of the array API take them."""
    found: dict[str, Any] = dict(i.attrs)
    if "dtype" in found:
        found["dtype"] = DTYPES[found["dtype"]]
    if "index" in found:
        found["index"] = tuple(slice(*e) if isinstance(e, list | tuple) else e for e in found["index"])
    for name in ("shape", "axes", "axis"):
        if isinstance(found.get(name), list):
            found[name] = tuple(found[name])
    return found


@contextmanager
def _at(trace: Trace, line: str) -> Iterator[None]:
    """What is recorded inside has this line."""
    begin = len(trace.instructions)
    yield
    for k in range(begin, len(trace.instructions)):
        trace.instructions[k] = replace(trace.instructions[k], line=line)
