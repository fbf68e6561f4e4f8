"""The XLA engine: a pipeline's instructions played in `jax.numpy` inside one compiled scan over the ticks.

Few source patterns: each has its own specialised program, chosen by a switch. Many patterns, or programs so
small that the switch would cost more than it saves: one program in which presence is data. Ticks go in
chunks of a fixed size, so that one compilation serves recordings of any length and memory stays bounded;
the last chunk is filled up with ticks in which nothing is present. Where most of a small program needs
nothing of the tick before, that is computed for all ticks of a chunk at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flowgraph.data.tape import Rows, bits
from flowgraph.engines.xla.buffers import Buffers
from flowgraph.engines.xla.devices import RUNS, Devices, import_jax, on_processor
from flowgraph.engines.xla.namespace import JaxNamespace
from flowgraph.engines.xla.turns import in_turns
from flowgraph.pipeline.optimise import ARRAYS, optimise
from flowgraph.pipeline.optimise.rows import take_rows
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, specialise
from flowgraph.pipeline.recurrence import Parts, parts
from flowgraph.recorder.ops import OPS, bound_attrs
from flowgraph.recorder.trace import Instruction

_MOST_PATTERNS = 8
_SMALL_WORK = 64  # scalar operations below which selecting is cheaper than branching
_UNROLLED = 4
_SMALL_TICK = 64  # bytes that a tick moves, below which XLA still writes a loop over several as plain code
_WIDE_TICK = 2**16  # bytes that a tick moves, above which a switch's copies cost more than a loop
_CHUNK_BYTES = 64 * 2**20
_LARGEST_CHUNK = 131072
_LARGEST_OF_SMALL, _WASTE = 2**18, 0.1  # of ticks that take less than a call of many
_SMALL_TICKS, _TICK_BY_TICK = 128, 0.5  # numbers that a tick makes, and the share that needs the tick before
_KEPT_BYTES = 32 * 2**20  # of buffers that wait for the next run


@dataclass(frozen=True)
class Chunk:
    """Outputs of consecutive ticks: for each output port a mask and its leaves, first axis ticks.

    Without a mask it is known to be there at every tick. With a leading axis of runs, a mask that is the same
    in all runs has no such axis.
    """

    ticks: int
    outputs: list[tuple[np.ndarray | None, list[np.ndarray]]]


class Scan:
    """A compiled scan for one pipeline, dtype, set of patterns and chunk size.

    Args:
        pipeline: what to play.
        keys: the source patterns that occur, in order.
        dtype: what `real` is.
        chunk: ticks a call.
        runs: how many runs go at once, under `vmap`; None for one, without a leading axis.
        shared: with `runs`, whether all runs have the same inputs.
        passes: of the optimiser.
        devices: among which runs or lanes are shared out; None for the one that is chosen.
    """

    def __init__(
        self, pipeline: Pipeline, keys: tuple[int, ...], dtype: Any, chunk: int, *,
        runs: int | None = None, shared: bool = True, passes: Collection[str] = ARRAYS,
        devices: Devices | None = None,
    ) -> None:  # fmt: skip
        self.jax = import_jax()
        self.pipeline, self.keys, self.dtype, self.chunk = pipeline, keys, dtype, chunk
        self.passes = passes
        shared_program = self._program(None)
        programs = [self._program(key) for key in keys]
        saved = shared_program.work - min((p.work for p in programs), default=0)
        self.branches = None if len(keys) > _MOST_PATTERNS or saved < _SMALL_WORK else programs
        self.shared = shared_program
        self.follows = [_known_presence(programs, k) for k in range(len(pipeline.outputs))]
        played = [shared_program] if self.branches is None else self.branches
        self._timed = any(_reads(program, pipeline.time) for program in played)
        self._parts = self._apart() if self.branches is None else None
        self._unroll = _UNROLLED if self.branches is None and _moved(pipeline) <= _SMALL_TICK else 1
        self._wide = _moved(pipeline) >= _WIDE_TICK and on_processor()
        self._input_axis = 0 if shared or runs is None else 1
        self._output_axis = 0 if runs is None else 1
        leads = () if runs is None else (RUNS,)
        placed = {} if devices is None else self._placed(devices, leads, () if shared else leads)
        play = self._chunk
        if runs is not None:
            play = self.jax.vmap(play, in_axes=(0, 0, (None, None, None if shared else 0, None)))
        self._compiled: Any = None
        self._free: list[Buffers] = []
        self._play_chunk = self.jax.jit(play, **placed)

    def _program(self, key: int | None) -> Program:
        return optimise(specialise(self.pipeline, key), self.passes)

    def _placed(
        self, devices: Devices, leads: tuple[str, ...], inputs_lead: tuple[str, ...]
    ) -> dict[str, Any]:
        """Where the arguments of a chunk and its results lie, for `jit`."""
        cells = devices.placed([c for r in self.pipeline.registers for c in r.cells], *leads)
        ticks = (*leads, None)
        every = devices.at()
        given = tuple(devices.placed(p.leaves, *inputs_lead, None) for p in self.pipeline.inputs)
        made = [
            (None if known is not None else devices.at(*leads), devices.placed(port.leaves, *ticks))
            for port, known in zip(self.pipeline.outputs, self.follows, strict=True)
        ]
        time = every if self._timed else None
        since = every if self._parts is not None else None
        return {
            "in_shardings": (cells, devices.at(*leads), (every, time, given, since)),
            "out_shardings": (cells, made),
        }

    def compile(self, cells: list[Any], seed: np.ndarray, inputs: list[list[np.ndarray]]) -> None:
        """Compile for these shapes, once."""
        if self._compiled is None:
            # A GPU would multiply float32 matrices with ten bits unless told otherwise.
            with self.jax.enable_x64(True), self.jax.default_matmul_precision("highest"):
                now = tuple(_as(c, self.dtype) for c in cells)
                self._compiled = self._play_chunk.lower(now, seed, self._buffers(inputs).arrays).compile()

    def _buffers(self, inputs: list[list[np.ndarray]]) -> Buffers:
        """Those of an earlier run, or new ones."""
        with suppress(IndexError):  # another thread may take them
            free = self._free.pop()
            if free.fits(inputs):
                return free
        ports = len(self.pipeline.inputs)
        kind, idle = (np.int32, len(self.keys)) if self.branches is not None else (bits(ports), 0)
        held = None if self._parts is None else self._parts.seen.keys()
        return Buffers(self.chunk, kind, self._timed, inputs, self._input_axis, self.dtype, idle, held)

    def _apart(self) -> Parts | None:
        """The program in parts, where that is small and most of it needs nothing of the tick before."""
        found = parts(self.shared, self.pipeline)
        return found if found.numbers <= _SMALL_TICKS and found.share <= _TICK_BY_TICK else None

    def _chunk(self, cells: tuple[Any, ...], seed: Any, xs: Any) -> Any:
        if self._parts is not None:
            return self._in_parts(self._parts, cells, seed, xs)
        if self.branches is not None and self._wide:
            steps = [partial(self._tick, take_rows(program), seed) for program in self.branches]
            return in_turns(self.jax, steps, cells, *xs[:3])
        step = self._switched if self.branches is not None else self._flagged
        return self.jax.lax.scan(partial(step, seed), cells, xs, unroll=self._unroll)

    def _start(
        self, program: Program, cells: tuple[Any, ...], seed: Any, time: Any, inputs: Any
    ) -> dict[int, Any]:
        env = self._known(program, seed) | dict(zip(program.reads, cells, strict=True))
        return env | self._given(time, inputs)

    def _known(self, program: Program, seed: Any) -> dict[int, Any]:
        """What is the same at every tick."""
        jnp = self.jax.numpy
        env: dict[int, Any] = {n: jnp.asarray(_as(a, self.dtype)) for n, a in program.constants.items()}
        return env | {self.pipeline.seed: seed}

    def _given(self, time: Any, inputs: Any) -> dict[int, Any]:
        """The time and the inputs, of a tick or of several."""
        env: dict[int, Any] = {self.pipeline.time: time} if self._timed else {}
        for port, leaves in zip(self.pipeline.inputs, inputs, strict=True):
            env.update(zip((leaf.value for leaf in port.leaves), leaves, strict=True))
        return env

    def _present(self, key: Any) -> dict[int, Any]:
        return {port.present: (key >> k) & 1 == 1 for k, port in enumerate(self.pipeline.inputs)}

    def _run(
        self, instructions: Sequence[Instruction], env: dict[int, Any], true: Any = None
    ) -> dict[int, Any]:
        xp = JaxNamespace(self.jax, true)
        for i in instructions:
            env[i.out] = OPS[i.op].run(
                xp, *(env[a] for a in i.args), **bound_attrs(i.op, i.attrs, self.dtype)
            )
        return env

    def _outputs(self, program: Program, value: Callable[[int], Any], *lead: int) -> list[Any]:
        """Mask and leaves of each output; `lead` is an axis before those of a value."""
        jnp = self.jax.numpy
        outputs = []
        ports = zip(program.outputs, self.pipeline.outputs, self.follows, strict=True)
        for (flag, leaves), port, follows in ports:
            mask = None
            if follows is None:
                mask = jnp.zeros(lead, bool) if flag is None else jnp.asarray(value(flag))
            if flag is None:
                blank = (jnp.zeros((*lead, *x.shape), _dtype(x.dtype, self.dtype)) for x in port.leaves)
                outputs.append((mask, tuple(blank)))
            else:
                outputs.append((mask, tuple(value(n) for n in leaves)))
        return outputs

    def _play(self, program: Program, env: dict[int, Any], true: Any = None) -> tuple[tuple[Any, ...], Any]:
        self._run(program.instructions, env, true)
        value = lambda n: env[n]
        return tuple(env[n] for n in program.writes), self._outputs(program, value)

    def _tick(
        self, program: Program, seed: Any, cells: tuple[Any, ...], time: Any, inputs: Any, true: Any
    ) -> Any:
        return self._play(program, self._start(program, cells, seed, time, inputs), true)

    def _switched(self, seed: Any, cells: tuple[Any, ...], x: Any) -> Any:
        key, time, inputs, _ = x
        assert self.branches is not None

        def branch(program: Program) -> Callable[..., Any]:
            return lambda cells, time, inputs: self._play(
                program, self._start(program, cells, seed, time, inputs)
            )

        nothing = self._program(0)
        return self.jax.lax.switch(key, [branch(p) for p in [*self.branches, nothing]], cells, time, inputs)

    def _flagged(self, seed: Any, cells: tuple[Any, ...], x: Any) -> Any:
        key, time, inputs, _ = x
        env = self._start(self.shared, cells, seed, time, inputs) | self._present(key)
        return self._play(self.shared, env)

    def _in_parts(self, found: Parts, cells: tuple[Any, ...], seed: Any, xs: Any) -> Any:
        """All ticks of a chunk: at once what is before and after the registers that are carried."""
        jnp, program = self.jax.numpy, self.shared
        key, time, inputs, since = xs
        known = self._known(program, seed)
        known |= {program.reads[place]: cells[place] for place in found.held}
        ticks = self._given(time, inputs) | self._present(key)
        ticks |= {n: jnp.arange(len(key)) >= since[port] for port, n in found.seen.items()}

        def at_once(instructions: Sequence[Instruction]) -> dict[int, Any]:
            def of_one(values: dict[int, Any]) -> dict[int, Any]:
                env = self._run(instructions, known | values)
                return {i.out: env[i.out] for i in instructions}

            return dict(self.jax.vmap(of_one)(ticks))

        def step(now: tuple[Any, ...], values: dict[int, Any]) -> Any:
            env = known | values | {program.reads[p]: c for p, c in zip(found.carried, now, strict=True)}
            self._run(found.around, env)
            return tuple(env[program.writes[p]] for p in found.carried), {n: env[n] for n in found.made}

        def each(n: int) -> Any:
            return ticks[n] if n in ticks else jnp.broadcast_to(known[n], (len(key), *known[n].shape))

        ticks |= at_once(found.before)
        after = list(cells)
        if found.carried:
            now = tuple(cells[p] for p in found.carried)
            into = {n: ticks[n] for n in found.into}
            last, made = self.jax.lax.scan(step, now, into, length=len(key), unroll=self._unroll)
            ticks |= made
            for p, cell in zip(found.carried, last, strict=True):
                after[p] = cell
        ticks |= at_once(found.after)
        for p in found.held:
            after[p] = ticks[program.writes[p]][-1]
        return tuple(after), self._outputs(program, each, len(key))

    def __call__(
        self,
        cells: list[Any],
        seed: np.ndarray,
        time: np.ndarray,
        key: np.ndarray,
        inputs: list[list[np.ndarray]],
        rows: Sequence[Rows],
    ) -> Iterator[tuple[Chunk, list[Any]]]:
        """Play all ticks; yields each chunk of outputs with the register cells after it.

        Args:
            cells: register cells before the first tick.
            seed: (2,) uint32.
            time: (T,) int64 ns.
            key: (T,), bit k set where input k is present.
            inputs: for each input port its leaves, (n, ...).
            rows: for each input port at which ticks it has its rows.

        With `runs`, cells, seed, outputs, and inputs that are not shared have a leading axis of runs. Outputs
        may be views of what XLA has made.
        """
        varies = any(known is not None and not known.all() for known in self.follows)
        pattern = _places(self.keys, key) if varies or self.branches is not None else key
        choice = key if self.branches is None else pattern
        self.compile(cells, seed, inputs)
        now: Any = tuple(_as(c, self.dtype) for c in cells)
        starts = range(0, len(time), self.chunk)
        turns = [self._buffers(inputs) for _ in starts[:2]]
        played: tuple[slice, Any, Any, Buffers] | None = None
        for n, start in enumerate(starts):
            here, buffers = slice(start, min(start + self.chunk, len(time))), turns[n % 2]
            buffers.fill(choice, time, rows, inputs, here)
            with self.jax.enable_x64(True):
                now, ys = self._compiled(now, seed, buffers.arrays)
            # While XLA plays these ticks, those before are handed out and the next are filled in.
            if played is not None:
                yield self._handed(pattern, *played)
            played = here, now, ys, buffers
        if played is not None:
            yield self._handed(pattern, *played)
        if sum(b.bytes for b in turns) <= _KEPT_BYTES:
            self._free = turns

    def _handed(
        self, pattern: np.ndarray, here: slice, now: Any, ys: Any, buffers: Buffers
    ) -> tuple[Chunk, list[Any]]:
        """What a call has made of the ticks `here`, and the cells after them, once it is done."""
        count = here.stop - here.start
        kept = (slice(None),) * self._output_axis + (slice(count),)
        with self.jax.enable_x64(True):
            outputs = [
                (
                    np.asarray(mask)[kept] if known is None else _picked(known, pattern[here]),
                    [_held(np.asarray(leaf), buffers)[kept] for leaf in leaves],
                )
                for (mask, leaves), known in zip(ys, self.follows, strict=True)
            ]
            now = self.jax.block_until_ready(now)  # the buffers are read until then
        return Chunk(count, outputs), [np.asarray(c) for c in now]


def _held(array: np.ndarray, buffers: Buffers) -> np.ndarray:
    """An output, copied where XLA has handed an input through."""
    return array.copy() if buffers.holds(array) else array


def _reads(program: Program, number: int) -> bool:
    """Whether a program needs a value."""
    ends = (*program.writes, *(n for flag, leaves in program.outputs for n in (flag, *leaves)))
    return number in ends or any(number in i.args for i in program.instructions)


def _moved(pipeline: Pipeline) -> int:
    """What a tick reads and writes, in bytes: inputs, outputs, and registers both ways."""
    cells = (c for r in pipeline.registers for c in r.cells)
    return bytes_per_tick(pipeline) + 2 * 8 * sum(math.prod(c.shape) for c in cells)


def _places(keys: tuple[int, ...], key: np.ndarray) -> np.ndarray:
    """For each of `key` its place in `keys`, which are in order."""
    if max(keys, default=0) >= 2**16:
        return np.asarray(np.searchsorted(keys, key))
    table = np.zeros(max(keys, default=0) + 1, np.int32)
    table[list(keys)] = range(len(keys))
    return np.asarray(table[key])


def _picked(known: np.ndarray, places: np.ndarray) -> np.ndarray | None:
    return None if known.all() else np.asarray(known[places])


def _known_presence(programs: list[Program], k: int) -> np.ndarray | None:
    """Whether output k is present, for each source pattern, where that is known beforehand."""
    facts = []
    for program in programs:
        flag = program.outputs[k][0]
        if flag is not None and flag not in program.constants:
            return None
        facts.append(flag is not None and bool(program.constants[flag]))
    return np.array(facts, dtype=bool)


def bytes_per_tick(pipeline: Pipeline) -> int:
    """What the inputs and outputs of one tick take, at 8 bytes a number."""
    ports = (*pipeline.outputs, *pipeline.inputs)
    return sum(math.prod(leaf.shape) * 8 for port in ports for leaf in port.leaves)


def chunk_size(pipeline: Pipeline, ticks: int) -> int:
    """A power of two that holds all ticks, or as many as keep the outputs of a chunk in bounds."""
    largest = _LARGEST_OF_SMALL if _moved(pipeline) <= _SMALL_TICK else _LARGEST_CHUNK
    most = min(largest, max(256, _CHUNK_BYTES // max(bytes_per_tick(pipeline), 1)))
    chunk = int(min(2 ** math.ceil(math.log2(max(ticks, 64))), 2 ** math.floor(math.log2(most))))
    while chunk > _LARGEST_CHUNK and -ticks % chunk > _WASTE * ticks:
        chunk //= 2
    return chunk


def _dtype(kind: str, real: Any) -> Any:
    return real if kind == "real" else kind


def _as(array: Any, real: Any) -> Any:
    found = np.asarray(array)
    return found.astype(real) if found.dtype.kind == "f" else found
