"""Particles in hardware: loops over rows, sums and places in them, are the interpreter's, word for word."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Array, MissingDependencyError, Scalar, Signal, Stream, block, delay, graph, real
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.engines.verilog import simulate as simulation
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.latency import FETCH
from flowgraph.engines.verilog.nodes import Sum
from flowgraph.engines.verilog.plan import Plan
from flowgraph.engines.verilog.schedule import Lanes, Loop, schedule
from flowgraph.engines.verilog.simulate import Simulated
from flowgraph.engines.verilog.tick import Tick
from flowgraph.pipeline.format_files import with_formats
from flowgraph.recorder.random import seed_words
from tests.engines.fixed.test_fixed import sizes_of

MS = 1_000_000
N = 24


class Cloud(Signal):
    """A weight and a place in the plane of each particle."""

    weight: Array = real("particles")
    place: Array = real(2, "particles")


class Kept(Signal):
    """What is read of a cloud."""

    mean: Array = real(2)
    spread: Array = real(2, 2)
    ends: Array = real(6)


@block
def moved(cloud: Cloud, z: Scalar, *, draw, xp) -> Cloud:
    """Each particle goes on by its own draw, and is weighed."""
    place = 0.9 * cloud.place + 0.3 * draw.normal("step", (2, N))
    far = xp.sum(place * place, axis=0)
    weight = cloud.weight * xp.exp(-0.5 * (far - z) * (far - z)) + 1e-3
    return Cloud(weight=weight / xp.sum(weight), place=place)


@block
def drawn(cloud: Cloud, *, draw, xp) -> Cloud:
    """A copy of each particle in proportion to its weight."""
    parts = xp.astype(xp.floor(cloud.weight * 2.0**38 + 0.5), xp.int64)
    total = xp.sum(parts)
    first = xp.astype(xp.floor(draw.uniform("place", (1,)) * xp.astype(total, xp.float64)), xp.int64)
    places = (xp.arange(N, dtype=xp.int64) * total + xp.minimum(first, total - 1)) // N
    index = xp.minimum(xp.searchsorted(xp.cumulative_sum(parts), places, side="right"), N - 1)
    place = xp.take(cloud.place, xp.astype(index, xp.int32), axis=-1)
    return Cloud(weight=xp.full((N,), 1.0 / N), place=place)


@block
def read(cloud: Cloud, *, xp) -> Kept:
    """Sums, extremes and places of a cloud."""
    mean = cloud.place @ cloud.weight
    off = cloud.place - xp.reshape(mean, (2, 1))
    sums = xp.cumulative_sum(cloud.weight)
    left = xp.searchsorted(sums, 1.0 - sums)  # of what falls as well: not one pace for all
    ends = [
        xp.max(cloud.place),
        xp.min(off),
        xp.max(xp.sum(xp.abs(off), axis=0)),
        xp.asarray(xp.any(off > 0.8), dtype=mean.dtype),
        xp.asarray(xp.all(off < 1.2), dtype=mean.dtype),
        xp.sum(xp.asarray(left, dtype=mean.dtype) * sums) + xp.sqrt(xp.max(sums)),
    ]
    spread = (off * cloud.weight) @ xp.matrix_transpose(off)
    return Kept(mean=mean, spread=spread, ends=xp.stack(ends))


def start():
    place = np.random.default_rng(3).normal(size=(2, N))
    return Cloud(weight=np.full(N, 1.0 / N), place=place)


@graph
def particles(z: Stream[Scalar]):
    """A cloud that is drawn anew in each tick."""
    cloud = delay(start(), name="cloud")
    now = moved(cloud, z, at=z)
    cloud.feed(drawn(now))
    return {"kept": read(now)}


@pytest.fixture(scope="module")
def made():
    built = particles.build()
    inputs = {"z": (np.arange(25, dtype=np.int64) * MS, np.linspace(0.2, 1.4, 25))}
    formats = sizes_of(built, inputs).formats(28, 2.0)
    subject = LoweredGraph(built)
    return built, with_formats(subject.pipeline, formats), subject.tape(inputs)


@pytest.mark.parametrize("lanes", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_particle_filter_is_equal_to_the_interpreter_in_every_register_and_output(made, lanes):
    try:
        simulation.verilator()
    except MissingDependencyError as error:
        pytest.skip(str(error.fix))
    built, pipeline, tape = made
    player = Simulated(pipeline, tape.patterns, check=True, lanes=lanes)
    player.play(tape, LoweredGraph(built).start(RunOptions()).cells, seed_words(7), None)
    assert player.compared > 25 * 3 * N
    assert player.differing == 0


def plan_of(made):
    _, pipeline, tape = made
    cells = [c.reset for r in pipeline.registers for c in r.cells]
    return Plan(Tick(Integers(pipeline, cells, np.zeros(2, np.uint32)), tape.patterns[-1]))


def test_the_program_does_not_grow_with_the_particles(made):
    plan = plan_of(made)
    found = schedule(plan, rows=True)
    assert {stage.row for stage in plan.stages} == {0, N // 2, N, 2 * N}  # counters, particles and draws
    terms = dict.fromkeys((0, N // 2, N, 2 * N), 0)
    for n in plan.order:
        terms[plan.class_of(n)] += len(plan.tick.made(n).terms)
    assert terms[0] < 500
    rounds = [w.does for w in found.words if isinstance(w.does, Loop) and w.does.step > 1]
    assert rounds  # loops that would wait make more elements at a time
    assert found.cycles > len(found.words) > 0


@pytest.mark.parametrize("lanes", [Lanes(), Lanes(2, True, (2, 1, 1, 1)), Lanes(4, True, (4, 2, 4, 2))])
def test_a_row_is_read_after_its_last_element_is_written_and_its_place_is_kept_until_then(made, lanes):
    """Played step by step as the machine does: which word lies at each place when it is read."""
    plan = plan_of(made)
    found = schedule(plan, rows=True, lanes=lanes)
    made_ = plan.tick.made
    ends = dict(found.loops)
    lies: dict[tuple[bool, int], tuple[int, int]] = {}
    due: list[tuple[int, tuple[bool, int], tuple[int, int]]] = []
    now = 0

    def place_of(n, nth, lane):
        if n in plan.fixed:
            return None
        index = made_(n).mode == "INDEX"
        if n in plan.rows:
            return (index, found.place[(n, 0)] + nth + lane), (n, nth + lane)
        return (index, found.place[(n, nth)]), (n, nth if made_(n).row else -1)

    def look(n, nth, lane, every):
        node = plan.tick.nodes[n]
        if not isinstance(node, Sum) or node.mode == "START":
            return
        k = nth if (n, nth) in found.place or n in plan.rows else 0
        for x in range(node.row) if every else (lane,):
            place, word = place_of(n, k, x)
            assert lies[place] == word, (n, nth, x)

    def arrive():
        nonlocal due
        for _, place, word in [d for d in due if d[0] <= now]:
            lies[place] = word
        due = [d for d in due if d[0] > now]

    def step(slot, lane):
        arrive()
        t = slot.term
        if t.kind != "TAKE":
            for n in (t.a, t.b):
                if plan.base(n) == n:
                    every = t.kind == "GET" and n == t.a
                    look(n, 0 if every else slot.nth, lane, every)
        if slot.writes is not None and slot.writes not in plan.fixed:
            place, word = place_of(slot.writes, slot.nth, lane)
            due.append((now + lanes.latency(slot.node), place, word))

    k = 0
    head = Loop(0)
    while k < len(found.words):
        word = found.words[k]
        if isinstance(word.does, Loop):
            head = word.does
            now += 1
            k += 1
            if k in ends:
                body = found.words[k : ends[k] + 1]
                assert [w.back for w in body].index(True) == len(body) - FETCH - 1
                for lane in range(0, head.last + 1, head.step):
                    for w in body:
                        assert not isinstance(w.does, Loop)
                        for slot in w.does:
                            if slot is not None:
                                step(slot, lane)
                        now += 1
                k += len(body)
            continue
        repeated = any(slot is not None and slot.term.times for slot in word.does)
        assert not repeated or sum(slot is not None for slot in word.does) == 1
        times = head.last + 1 if word.repeat or repeated else 1
        assert not repeated or {times} == {slot.term.times for slot in word.does if slot is not None}
        for lane in range(times):
            for slot in word.does:
                if slot is None:
                    continue
                last = lane == times - 1 or slot.node.gather == "running"
                if last or slot.writes is None:
                    step(slot, 0 if times == 1 else lane)
                else:
                    arrive()
                    for n in (slot.term.a, slot.term.b):
                        if plan.base(n) == n:
                            look(n, 0, lane, False)
            now += 1
        k += 1
    assert now == found.cycles
    steps = [w.does for w in found.words if not isinstance(w.does, Loop)]
    indexed = [[s is not None and s.mode == "INDEX" for s in lanes_] for lanes_ in steps]
    assert max(map(sum, indexed)) == 1  # one index is written in a cycle
    if lanes.count > 1:  # in whichever lane, and asked for in any
        assert any(any(row[1:]) for row in indexed)
        assert any(s is not None and s.term.kind == "GET" for lanes_ in steps for s in lanes_[1:])


@block
def twice_read(cloud: Cloud, z: Scalar, *, xp) -> Scalar:
    """A sum along a row that waits for another of as many terms, and for nothing else."""
    first = cloud.place[0] @ cloud.weight
    return z + cloud.weight @ xp.broadcast_to(first, (N,))


@graph
def waits(z: Stream[Scalar]):
    cloud = delay(start(), name="cloud")
    cloud.feed(moved(cloud, z, at=z))
    return {"sum": twice_read(cloud, z)}


def test_a_term_is_repeated_as_often_as_it_says_behind_a_wait_that_is_repeated():
    built = waits.build()
    inputs = {"z": (np.arange(9, dtype=np.int64) * MS, np.linspace(0.2, 1.4, 9))}
    subject = LoweredGraph(built)
    pipeline = with_formats(subject.pipeline, sizes_of(built, inputs).formats(28, 2.0))
    found = schedule(plan_of((built, pipeline, subject.tape(inputs))), rows=True)
    terms, waiting = 0, False
    head = Loop(-1)
    for word in found.words:
        if isinstance(word.does, Loop):
            head = word.does
            continue
        for slot in word.does:
            if slot is not None and slot.term.times:
                assert slot.term.times == head.last + 1
                terms += 1
        waiting |= word.repeat and not word.does
    assert terms > 2
    assert waiting


def test_where_nothing_is_a_row_the_machine_has_none():
    @block
    def twice(x: Scalar) -> Scalar:
        """Twice as much."""
        return 2.0 * x

    @graph
    def double(x: Stream[Scalar]):
        """One block."""
        return {"y": twice(x)}

    built = double.build()
    inputs = {"x": (np.arange(3, dtype=np.int64), np.arange(3.0))}
    image = Image(with_formats(LoweredGraph(built).pipeline, sizes_of(built, inputs).formats(24, 2.0)), [1])
    assert not image.has_rows
    assert image.tables == {}
