"""The pipeline: a fixed-size description of a graph that runs without the Python that made it.

Values are numbered and assigned once. Inputs, registers and constants give the first values, stages of
typed instructions the rest; outputs name values, and each register names the value written back at the end
of a tick. Whether a source is present in a tick is a Boolean input like any other, and every stage names
the value that enables it. The JSON form (`description`) holds the same, whole, with a version and a schema.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph.data.files import content_of, put_new, text_of
from flowgraph.errors import LoweringError, PipelineError, UnknownNameError
from flowgraph.language.block import NUMBERS, Limit
from flowgraph.language.clock import Timing
from flowgraph.pipeline.formats import Formats
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.replay import body_of
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES, ArrayType, StructType, Type
from flowgraph.verbs import verb

if TYPE_CHECKING:
    from flowgraph.data.flight import Flight
    from flowgraph.data.result import Result

FORMAT, VERSION = "flowgraph-pipeline", 2
READ = (1, 2)
"""The versions that are read: 1 has no formats."""
_FILE = "pipeline.json"
_SCHEMA = Path(__file__).with_name("pipeline.schema.json")


@dataclass(frozen=True)
class Leaf:
    """One array of a port: its value number, shape, dtype, unit, frame, and names of parallel axes."""

    name: str
    value: int
    shape: tuple[int, ...]
    dtype: str
    unit: str | None = None
    frame: str | None = None
    axes: tuple[str | None, ...] = ()


@dataclass(frozen=True)
class Port:
    """An input or output: `present` is the number of a Boolean value; an input's stamps keep `timing`."""

    name: str
    type: str
    clock: str
    present: int
    leaves: tuple[Leaf, ...]
    timing: Timing | None = None


@dataclass(frozen=True)
class Cell:
    """One array of a register: `read` is its value in a tick, `write` what it becomes at the end of it."""

    name: str
    read: int
    write: int
    shape: tuple[int, ...]
    dtype: str
    reset: Any
    unit: str | None = None
    frame: str | None = None
    axes: tuple[str | None, ...] = ()


@dataclass(frozen=True)
class Register:
    """Memory between ticks: `role` is "latest", "delay", "state", "join" (the state of one) or "stamp"."""

    path: str
    role: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Stage:
    """What one block does in a tick, when the value `enable` is true.

    Args:
        path, block: of the call in the graph.
        enable: number of a Boolean value.
        reads, writes: paths of registers.
        axis: name of the axis along which its work is parallel, such as "particles", or None.
        instructions: in order.
    """

    path: str
    block: str
    enable: int
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    instructions: tuple[Instruction, ...]
    axis: str | None = None


@dataclass(frozen=True)
class Fault:
    """A register cell that holds the time (ns) at which a bound was exceeded, or the smallest int64."""

    path: str
    register: str
    cell: str
    message: str
    bound: int


@dataclass(frozen=True)
class RandomSite:
    """Random numbers of one name: `value` is their number, `hash` the word that stands for the name."""

    name: str
    kind: str
    shape: tuple[int, ...]
    hash: int
    value: int


@dataclass(frozen=True)
class HostStage:
    """A block that stays in Python, on one side of the pipeline.

    Args:
        path, block: of the call in the graph, and `line`, module:line, of the block's function.
        side: "before" the pipeline, or "after" it.
        reads: after it, the streams that the block reads, by label.
        feeds: before it, the names of the pipeline's inputs that the block gives.
    """

    path: str
    block: str
    side: str
    line: str
    reads: tuple[str, ...] = ()
    feeds: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Pipeline:
    """A lowered graph. `run` plays it, `save` and `load` keep it.

    Args:
        name, doc: of the graph.
        time: number of the value that holds the tick's time (int64, ns).
        seed: number of the value that holds the run's seed (two uint32 words, low first).
        inputs, outputs, registers, constants, stages, faults, random, limits: see their classes.
        host: what the graph does outside the pipeline, in firing order; a pipeline alone does not run it.
        formats: how real values are kept as whole numbers, where that was decided.
    """

    name: str
    doc: str
    time: int
    seed: int
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    registers: tuple[Register, ...]
    constants: Mapping[int, np.ndarray]
    stages: tuple[Stage, ...]
    faults: tuple[Fault, ...] = ()
    random: tuple[RandomSite, ...] = ()
    limits: tuple[Limit, ...] = ()
    host: tuple[HostStage, ...] = ()
    formats: Formats | None = None

    def need_numbers(self, kind: str) -> None:
        """Refuse a kind of number, "float64", "float32" or "fixed", in which a block must not be computed.

        Raises:
            LoweringError: naming the block and why; UnknownNameError: for another kind.
        """
        if kind not in NUMBERS:
            raise UnknownNameError("dtype", kind, NUMBERS, path=self.name)
        for limit in self.limits:
            if kind in limit.numbers:
                raise LoweringError(
                    limit.message, path=limit.path, expected=limit.expected, got=limit.got, fix=limit.fix
                )

    @cached_property
    def instructions(self) -> tuple[Instruction, ...]:
        """All instructions in order."""
        return tuple(i for stage in self.stages for i in stage.instructions)

    def run(self, inputs: Flight | Mapping[str, Any], **options: Any) -> Result:
        """Play the pipeline over recorded events.

        Args:
            inputs: a `Flight`, or for each input a `Series`, `(times, {leaf: array})` with int64 ns and a
                leading axis, or an iterable of `(time, value)`.
            **options: `engine` ("reference" or "xla"), `dtype`, `init`, `state`, `progress`, `passes` and
                `diverged` as in `simulate`.
        """
        result: Result = verb("Pipeline.run")(self, inputs, **options)
        return result

    def totals(self) -> dict[str, int]:
        """Scalar operations of a tick in which everything fires, bytes of memory, and the longest chain."""
        depth: dict[int, int] = {}
        for i in self.instructions:
            depth[i.out] = 1 + max((depth.get(a, 0) for a in i.args), default=0)
        cells = [c for r in self.registers for c in r.cells]
        return {
            "stages": len(self.stages),
            "instructions": len(self.instructions),
            "operations": sum(work(i, self.specs) for i in self.instructions),
            "register_bytes": sum(math.prod(c.shape) * np.dtype(DTYPES[c.dtype]).itemsize for c in cells),
            "constant_bytes": sum(int(a.nbytes) for a in self.constants.values()),
            "critical_path": max(depth.values(), default=0),
        }

    def latency(self) -> dict[str, int]:
        """For each input, the longest chain of instructions from it to an output."""
        found = {}
        for port in self.inputs:
            depth = {leaf.value: 0 for leaf in port.leaves} | {port.present: 0}
            for i in self.instructions:
                reached = [depth[a] for a in i.args if a in depth]
                if reached:
                    depth[i.out] = 1 + max(reached)
            found[port.name] = max(
                (depth.get(leaf.value, 0) for o in self.outputs for leaf in o.leaves), default=0
            )
        return found

    @cached_property
    def specs(self) -> dict[int, Spec]:
        """Shape and dtype of every value."""
        return dict(self.given()) | {i.out: i.spec for i in self.instructions}

    def given(self) -> list[tuple[int, Spec]]:
        """The values that no instruction makes."""
        found = [(self.time, Spec((), "int64")), (self.seed, Spec((2,), "uint32"))]
        for port in self.inputs:
            found += [
                (port.present, Spec((), "bool")),
                *((leaf.value, spec_of(leaf)) for leaf in port.leaves),
            ]
        found += [(c.read, spec_of(c)) for r in self.registers for c in r.cells]
        return found + [(n, Spec(a.shape, kind_of(a))) for n, a in self.constants.items()]

    # -- JSON ----------------------------------------------------------------------------------------

    def to_json(self) -> dict[str, Any]:
        """The whole description as plain JSON values."""
        data: dict[str, Any] = verb("Pipeline.to_json")(self)
        return data

    @classmethod
    def from_json(cls, data: Any, *, path: str = "pipeline") -> Pipeline:
        """A pipeline from `to_json`'s form, checked against the schema and, value by value, for sense.

        Raises:
            PipelineError: saying where it is malformed.
        """
        made: Pipeline = verb("Pipeline.from_json")(data, path=path)
        return made

    def save(self, folder: str | Path) -> Path:
        """Write `pipeline.json` and a listing `pipeline.txt` into a folder, made if missing; returns it.

        Raises:
            PipelineError: where the folder holds another pipeline; nothing is overwritten in silence.
            OutputError: where it holds another `pipeline.txt`, or the folder or its files cannot be made.
        """
        target = Path(folder)
        text = json.dumps(self.to_json(), indent=1, allow_nan=False)
        file = target / _FILE
        if file.is_file() and content_of(file) != text.encode():
            raise PipelineError(
                "another pipeline is already here",
                path=str(file),
                expected="an empty folder, or the same pipeline",
                got=f"a different {_FILE}",
                fix="choose another folder, or remove the old one first",
            )
        put_new(target, {_FILE: text, "pipeline.txt": self.listing()}, what="pipeline")
        return target

    @classmethod
    def load(cls, folder: str | Path) -> Pipeline:
        """Read a pipeline that `save` wrote.

        Raises:
            PipelineError: where it is missing, malformed or of another version.
        """
        file = Path(folder)
        file = file / _FILE if file.is_dir() else file
        try:
            data = json.loads(text_of(file), parse_constant=_no_number)
        except (OSError, ValueError, RecursionError) as error:
            raise PipelineError(
                "no pipeline can be read here",
                path=str(file),
                expected=f"a {_FILE} written by Pipeline.save",
                got=f"{type(error).__name__}: {error}",
                fix="lower the graph: lower(graph).save(folder)",
            ) from None
        return cls.from_json(data, path=str(file))

    def listing(self) -> str:
        """The pipeline as text for a person: registers, then stages with one instruction a line."""
        return str(verb("Pipeline.listing")(self))

    def _repr_html_(self) -> str:
        from flowgraph.drawing.notebook import pipeline_cell  # only who shows it needs what draws

        return pipeline_cell(self.name, self.totals(), self.listing())

    def __repr__(self) -> str:
        t = self.totals()
        size = f"{t['stages']} stages, {t['instructions']} instructions, {t['register_bytes']} B of registers"
        return f"<Pipeline {self.name}: {size}>"


def work(i: Instruction, specs: Mapping[int, Spec]) -> int:
    """About how many scalar operations an instruction takes."""
    size = math.prod(i.spec.shape)
    if i.op == "matmul":
        return size * specs[i.args[0]].shape[-1]
    if i.op == "cholesky":
        return math.ceil(size * i.spec.shape[-1] / 3)
    if i.op == "solve":
        n = specs[i.args[0]].shape[-1]
        return size * n + math.ceil(math.prod(specs[i.args[0]].shape) * n / 3)
    if i.op == "replay":
        turns = ({t.out: t.spec for t in case.turns} for case in body_of(i.attrs["body"]).cases)
        return i.spec.shape[0] * max(sum(math.prod(s.shape) for s in turn.values()) for turn in turns)
    if i.op in ("sum", "prod", "max", "min", "mean", "any", "all", "argmax", "argmin"):
        return math.prod(specs[i.args[0]].shape)
    return (
        0
        if i.op
        in ("getitem", "reshape", "broadcast_to", "concat", "stack", "matrix_transpose", "permute_dims")
        else size
    )


def type_of_leaves(name: str, leaves: tuple[Leaf, ...] | tuple[Cell, ...]) -> Type:
    """A type whose values are nested dicts (or one array), from dotted leaf names."""
    if len(leaves) == 1 and leaves[0].name == "value":
        one = leaves[0]
        return ArrayType(one.shape, one.dtype, one.unit, one.frame)
    groups: dict[str, list[Any]] = {}
    for leaf in leaves:
        head, _, rest = leaf.name.partition(".")
        groups.setdefault(head, []).append((rest, leaf))
    fields = []
    for head, members in groups.items():
        if members[0][0] == "":
            leaf = members[0][1]
            fields.append((head, ArrayType(leaf.shape, leaf.dtype, leaf.unit, leaf.frame)))
        else:
            inner = tuple(
                Leaf(rest, m.value if isinstance(m, Leaf) else m.read, m.shape, m.dtype, m.unit, m.frame)
                for rest, m in members
            )
            fields.append((head, type_of_leaves(head, inner)))  # type: ignore[arg-type]
    return StructType(name, tuple(fields), dict)


def spec_of(part: Leaf | Cell) -> Spec:
    """Shape and dtype of a leaf or cell."""
    return Spec(part.shape, part.dtype)


def kind_of(array: np.ndarray) -> str:
    """The kind of number of a constant: "real", "bool", or an integer's name."""
    return "real" if array.dtype.kind == "f" else "bool" if array.dtype.kind == "b" else array.dtype.name


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not JSON")


@lru_cache(maxsize=1)
def schema() -> dict[str, Any]:
    """The JSON Schema of the description."""
    found: dict[str, Any] = json.loads(_SCHEMA.read_text())
    return found
