"""The contract of an engine: what runs a graph, behind one face.

Most engines play a pipeline. Such a `PipelineEngine` *prepares* a pipeline for the patterns of present inputs
that will come, and what it prepared *plays* a tape of ticks from register cells and a seed. One that takes
many runs at once plays those in one call; the others are called run by run. An engine of the other kind, a
`BlockEngine`, runs the blocks of a graph themselves, as Python's does: it is given the graph, sees no
pipeline, and so has no passes to choose from and cannot play a pipeline that was read from a file.

A package offers an engine under the entry-point group `flowgraph.engines`, an object of one of these two
classes; ours are found the same way. Everything else, from checking events to the types of the outputs, is
done for it.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.batch import Runs
from flowgraph.data.inputs import Inputs
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape
from flowgraph.engines.entrance import Admitted
from flowgraph.engines.options import DTYPES, Meter, RunOptions
from flowgraph.errors import DeclarationError, FifoOverflowError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.pipeline import Pipeline


@dataclass(frozen=True)
class Outcome:
    """What a run of a pipeline gave.

    Args:
        cells: the register cells after the last tick, in order.
        outputs: for each output port its times (n,) int64 ns, and its leaves (n, ...).
        wall_s: seconds spent in the engine's loop, without set-up.
        stats, notes: what the engine has counted, and has to say, for the result.
    """

    cells: list[Any]
    outputs: list[tuple[np.ndarray, list[np.ndarray]]]
    wall_s: float
    stats: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ManyRuns:
    """Runs of one pipeline that go together: with other seeds, and maybe other events and initial values.

    Args:
        name: of the graph, for messages.
        pipeline: what to play.
        seeds: one a run.
        keep: by output, the names of the leaves that are wanted; an output that is not there is not wanted.
        first: the ticks of the first run.
        shared: whether all runs have the events of the first.
        started: the register cells from which all runs start; None where each has its own.
        tape: the ticks of the n-th run, checked.
        cells: the register cells from which the n-th run starts.
        finish: to be called with the place of a run that has ended and its cells, for what lies in them;
            but where the pipeline has no faults and all reals in the cells are finite, nothing does.
    """

    name: str
    pipeline: Pipeline
    seeds: tuple[int, ...]
    keep: Mapping[str, list[str]]
    first: Tape
    shared: bool
    started: list[np.ndarray] | None
    tape: Callable[[int], Tape]
    cells: Callable[[int], list[np.ndarray]]
    finish: Callable[[int, list[Any]], None]


@dataclass(frozen=True)
class ManyOutcome:
    """What many runs gave: the streams that were wanted, by name, the ticks of one run, and the time."""

    series: Mapping[str, Runs]
    ticks: int
    wall_s: float


class Engine(abc.ABC):
    """What runs a graph.

    Attributes:
        name: by which users ask for it.
        dtypes: the kinds of number that it offers.
        takes_many: whether many runs go together in one call.
        shards: whether its work can be shared out among devices.
    """

    name: str
    dtypes: tuple[str, ...] = DTYPES
    takes_many: bool = False
    shards: bool = False

    def need(self) -> None:  # noqa: B027  most need nothing
        """Refuse where something is not installed that this engine needs.

        Raises:
            MissingDependencyError: saying what to install.
        """

    def check(self, options: RunOptions) -> None:
        """Refuse options that this engine does not have.

        Raises:
            DeclarationError: naming the option.
        """
        if options.dtype not in self.dtypes:
            raise DeclarationError(
                f"the {self.name} engine computes in {' and '.join(self.dtypes)}",
                path=f"engine={self.name!r}",
                expected=" or ".join(self.dtypes),
                got=options.dtype,
                fix="leave dtype out, or choose another engine",
            )
        if options.shard and not self.shards:
            raise DeclarationError(
                f"the {self.name} engine shares nothing out among devices",
                path=f"engine={self.name!r}",
                expected="no shard",
                got=str(dict(options.shard)),
                fix='leave shard out, or choose engine="xla"',
            )

    def need_devices(self, shard: Mapping[str, int]) -> None:  # noqa: B027  most share nothing
        """Refuse a share among more devices than this process has; for an engine that `shards`.

        Raises:
            DeclarationError: with how many there are.
        """


class Stepper(abc.ABC):
    """A run that takes one tick after the other.

    Attributes:
        ticks: how many were made.
        time: of the last, in ns.
    """

    ticks: int
    time: int

    @abc.abstractmethod
    def step(self, admitted: Admitted) -> list[tuple[Any, ...] | None]:
        """Make a tick; gives for each collected output its leaves, copies, or None where it is absent."""

    @abc.abstractmethod
    def overflows(self) -> list[FifoOverflowError]:
        """The errors of queues that were full for the first time since the last call; the run goes on."""

    @property
    @abc.abstractmethod
    def state(self) -> dict[str, Any]:
        """The registers after the last tick, as `run.state`."""


class BlockEngine(Engine):
    """An engine that runs the blocks of a graph themselves."""

    def stepper(self, graph: Graph, options: RunOptions) -> Stepper | None:
        """A run that takes one tick after the other; None where the engine has none."""
        return None

    @abc.abstractmethod
    def run(self, graph: Graph, inputs: Inputs, options: RunOptions) -> Result:
        """Run a graph over its inputs to their end."""


class Player(abc.ABC):
    """A pipeline made ready by an engine."""

    @abc.abstractmethod
    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        """Play all ticks.

        Args:
            tape: ticks, and the events of each input.
            cells: register cells before the first tick, in order.
            seed: (2,) uint32.
            progress: told now and then how many ticks are done, and the time of the last.
        """


class CellStepper(abc.ABC):
    """A pipeline made ready by an engine for single ticks; it holds the register cells."""

    @abc.abstractmethod
    def react(
        self, time: int, key: int, leaves: Sequence[tuple[int, Sequence[Any]]]
    ) -> list[tuple[Any, ...] | None]:
        """Make a tick of these inputs, by place; gives for each output its leaves, or None."""

    @abc.abstractmethod
    def cells(self) -> list[Any]:
        """Copies of the register cells, in order."""

    @abc.abstractmethod
    def full(self) -> Sequence[int]:
        """The places of the pipeline's faults that have occurred."""


class PipelineEngine(Engine):
    """An engine that plays a pipeline's instructions.

    Attributes:
        passes: of the optimiser, those that suit it.
        writes: whether it can write the pipeline as source text (`write`, `write_events`).
    """

    passes: tuple[str, ...] = ()
    writes: bool = False

    @abc.abstractmethod
    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        """Make a pipeline ready; what takes long should be kept with the pipeline for the next run.

        Args:
            pipeline: what to play.
            patterns: of present inputs, those that occur, in order: bit k is input k.
            ticks: how many there will be.
            dtype: what `real` is.
            passes: of the optimiser, in order.
        """

    def stepper(
        self, pipeline: Pipeline, cells: list[Any], seed: int, dtype: str, passes: tuple[str, ...]
    ) -> CellStepper | None:
        """What makes single ticks of a pipeline; None where the engine has none."""
        return None

    def play_many(self, runs: ManyRuns, passes: tuple[str, ...], options: RunOptions) -> ManyOutcome:
        """Play many runs in one call; only asked of an engine that `takes_many`."""
        raise NotImplementedError(f"engine {self.name!r} says that it takes many runs, and has no play_many")

    def with_shard(self, shard: Mapping[str, int] | None) -> PipelineEngine:
        """The engine that shares each run out so among devices; itself where it does not."""
        return self

    def with_lanes(self, lanes: int) -> PipelineEngine:
        """The engine that writes a machine of so many lanes; itself where what it writes has none."""
        return self

    def write(
        self, pipeline: Pipeline, folder: Path, dtype: str, passes: Collection[str]
    ) -> Mapping[str, Path]:
        """Write the pipeline as source text into a folder; only asked of an engine that `writes`."""
        raise NotImplementedError(f"engine {self.name!r} says that it writes, and has no write")

    def write_events(self, pipeline: Pipeline, inputs: Inputs | Mapping[str, Any], file: Path) -> int:
        """Write recorded events as what was written reads them; returns the number of ticks."""
        raise NotImplementedError(f"engine {self.name!r} says that it writes, and has no write_events")


def real_leaves(series: Series, real: Any) -> list[np.ndarray]:
    """The leaves of a series, with its real numbers in the dtype of a run."""
    return [a.astype(real, copy=False) if a.dtype.kind == "f" else a for a in series.leaves.values()]
