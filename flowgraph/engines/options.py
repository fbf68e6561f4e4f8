"""What is asked of a run, as one frozen object that is checked once and travels whole."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.pipeline.formats import Formats
from flowgraph.pipeline.optimise import check_passes
from flowgraph.recorder.random import seed_words

DTYPES = ("float64", "float32")
KINDS = (*DTYPES, "fixed")
RUNS_AT_ONCE = 64
DIVERGED = ("raise", "count")

PerSeed = Callable[[int], Any]


class Meter(Protocol):
    """Something that is told how far a run has come."""

    def update(self, ticks: int, time: int) -> None:
        """`ticks` done so far, and the time of the last in ns."""


@dataclass(frozen=True)
class Checkpoint:
    """How a run over recorded events is kept, so that another process can go on with it.

    Args:
        file: replaced now and then by one that holds the run so far; None: nothing is written.
        every: seconds of the flight between two of them.
        resume: the file of a run that was broken off, from which this one goes on.
        about: plain values to keep in the file, such as the command.

    Raises:
        DeclarationError: for an `every` that is no positive number.
    """

    file: str | Path | None = None
    every: float = 60.0
    resume: str | Path | None = None
    about: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 1e-9 <= self.every <= 9e9:
            raise DeclarationError(
                "checkpoints are some time of the flight apart",
                path="every",
                expected="seconds, more than 0",
                got=str(self.every),
                fix="write --every 10",
            )


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What is asked of a run. The engine is a name; `registry.find_engine` knows what it stands for.

    Args:
        engine: its name.
        dtype: what `real` is, "float64", "float32" or "fixed".
        init: other initial values, by register path; for many runs also a function of the seed or a list.
        state: a `run.state` or `result.state` to go on from.
        seed: of the random numbers, 0 .. 2^64 - 1; a `state` brings its own.
        progress: told how far a run has come; of many runs, the number of those that have ended.
        passes: of the optimiser; None: those that suit the engine.
        keep: of many runs, what to keep of the outputs; None: everything.
        runs_at_once: of many runs, how many go in one call where the engine does them in chunks.
        diverged: what an output or register that is no longer finite does: "raise", or "count" it and go on.
        checkpoint: how the run is kept, and from where it goes on.
        formats: number formats for fixed point, or the folder that `quantise` wrote them to.
        shard: among how many devices the work along an axis is shared out: "runs", or an axis that the types
            of the graph name, such as "particles".

    Raises:
        UnknownNameError: for another dtype, pass or way of `diverged`.
        DeclarationError: for a seed that is none, or a number of devices.
    """

    engine: str = "python"
    dtype: str = "float64"
    init: Mapping[str, Any] | PerSeed | Sequence[Mapping[str, Any]] | None = None
    state: Mapping[str, Any] | None = None
    seed: int = 0
    progress: Meter | None = None
    passes: Collection[str] | None = None
    keep: Sequence[str] | None = None
    runs_at_once: int = RUNS_AT_ONCE
    diverged: str = "raise"
    checkpoint: Checkpoint | None = None
    formats: Formats | str | Path | None = None
    shard: Mapping[str, int] | None = None

    def __post_init__(self) -> None:
        if self.dtype not in KINDS:
            raise UnknownNameError("dtype", self.dtype, KINDS)
        if self.formats is not None and self.checkpoint is not None:
            raise DeclarationError(
                "a run in fixed point keeps no checkpoints",
                path="checkpoint",
                expected="formats or a checkpoint",
                got="both",
                fix="leave the checkpoint out",
            )
        if self.diverged not in DIVERGED:
            raise UnknownNameError("way of diverged", self.diverged, DIVERGED)
        if self.passes is not None:
            check_passes(self.passes)
        seed_words(self.seed)
        _check_shard(self.shard)

    def but(self, **changes: Any) -> RunOptions:
        """The same with some changed."""
        return replace(self, **changes)


def _check_shard(shard: Any) -> None:
    if shard is None:
        return
    named = isinstance(shard, Mapping) and all(isinstance(name, str) for name in shard)
    if not named or any(type(devices) is not int or devices < 1 for devices in shard.values()):
        raise DeclarationError(
            "a share is a number of devices for each axis",
            path="shard",
            expected='a mapping such as {"runs": 4} or {"runs": 2, "particles": 4}',
            got=repr(shard),
            fix="leave it out for one device",
        )
