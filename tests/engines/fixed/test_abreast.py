"""Flights that are looked at together have the values, and the formats, that they have one by one."""

from __future__ import annotations

from time import process_time

import numpy as np
import pytest

from flowgraph.engines.fixed import ranges
from flowgraph.engines.fixed.abreast import Recorded, abreast, varying
from flowgraph.engines.fixed.ranges import Sizes
from flowgraph.engines.options import RunOptions
from flowgraph.engines.reference import Interpreter
from flowgraph.engines.subject import LoweredGraph
from flowgraph.graphs.benches.fixed import flown
from flowgraph.pipeline.plain import plain
from flowgraph.pipeline.program import needed
from flowgraph.recorder.random import seed_words


def recorded(name, seed, duration, *, first=0, last=10**9):
    flight = flown(name, seed, duration, particles=12)
    subject = LoweredGraph(flight.graph)
    start = subject.start(RunOptions(seed=seed))
    events = subject.tape(flight.inputs, start.last)
    return Recorded(plain(subject.pipeline), events.part(first, last), start.cells, seed_words(seed))


def one_by_one(flight):
    """Each tick of a flight by the reference interpreter: its program and values."""
    player = Interpreter(flight.pipeline, list(flight.cells), np.dtype(np.float64), flight.seed)
    rows = [zip(*s.leaves.values(), strict=True) for s in flight.tape.series]
    for time, key in zip(flight.tape.time.tolist(), flight.tape.key.tolist(), strict=True):
        with np.errstate(all="ignore"):
            program, env = player.values(time, key, [next(row) for k, row in enumerate(rows) if key >> k & 1])
        player.cells = [env[n] for n in program.writes]
        yield program, env


@pytest.mark.parametrize("name", ["kalman", "ins_eskf", "rbpf_indoor", "marg", "particle"])
def test_values_and_what_is_taken_of_them_are_those_of_each_flight(name):
    parts: tuple[dict[str, int], ...] = ({}, {"last": 25}, {"first": 3, "last": 40})
    flights = [recorded(name, seed, 0.3, **part) for seed, part in enumerate(parts)]
    alone = [one_by_one(f) for f in flights]
    compared = partly = 0
    with np.errstate(all="ignore"):
        for step in abreast(flights):
            taken = needed(step.program, step.values, (len(step.flights),))
            for lane, flight in enumerate(step.flights):
                program, env = next(alone[flight])
                masks = needed(program, env)
                for i in program.instructions:
                    here = step.values[i.out]
                    mine = here[..., min(lane, here.shape[-1] - 1)]
                    np.testing.assert_allclose(mine, env[i.out], rtol=1e-7, atol=1e-9, err_msg=i.line)
                    whole = np.broadcast_to(taken.get(i.out, False), (*i.spec.shape, len(step.flights)))
                    wanted = np.broadcast_to(masks.get(i.out, False), i.spec.shape)
                    assert (whole[..., lane] == wanted).all(), i.line
                    compared += 1
                    partly += not wanted.all()
    assert all(next(rest, None) is None for rest in alone)
    assert compared > 100
    assert partly or name == "kalman"


@pytest.mark.parametrize("name", ["ins_eskf", "rbpf_indoor", "particle"])
def test_formats_are_those_of_the_sizes_of_each_flight_by_itself(name):
    flights = [recorded(name, seed, 0.4) for seed in range(3)]
    together, alone = Sizes(flights[0].pipeline), Sizes(flights[0].pipeline)
    together.play(flights)
    alone.play(flights)  # for the constants that vary, and what is absent
    alone.largest.clear()
    alone.untaken.clear()

    def see(sizes, n, x):
        x = np.abs(np.where(np.isfinite(x), x, 0.0))
        axes = tuple(a for a, size in enumerate(x.shape) if size == 12)  # the particles share a format
        sizes[n] = np.maximum(sizes.get(n, 0.0), x.max(axis=axes, keepdims=True, initial=0.0))

    for flight in flights:
        cells = [c for r in flight.pipeline.registers for c in r.cells]
        held = [k for k, c in enumerate(cells) if c.dtype == "real"]
        for k in held:
            see(alone.largest, cells[k].read, flight.cells[k])
        for program, env in one_by_one(flight):
            masks = needed(program, env)
            given = {x.value for port in flight.pipeline.inputs for x in port.leaves} & env.keys()
            made = {i.out for i in program.instructions if i.spec.dtype == "real"}
            for n in made | {n for n in given if n in masks and flight.pipeline.specs[n].dtype == "real"}:
                mask = masks.get(n, False)
                see(alone.largest, n, np.where(mask, env[n], 0.0))
                if mask is not True:
                    see(alone.untaken, n, env[n])
            for k in held:
                see(alone.largest, cells[k].read, env[program.writes[k]])
    for widths in ((24, 2.0, 0), (28, 8.0, 40)):
        assert together.formats(*widths).to_json() == alone.formats(*widths).to_json()


def test_memory_bounds_how_many_go_at_once(monkeypatch):
    flights = [recorded("kalman", seed, 0.2) for seed in range(3)]
    together, apart = Sizes(flights[0].pipeline), Sizes(flights[0].pipeline)
    together.play(flights)
    played = []

    def counted(some):
        played.append(len(some))
        return abreast(some)

    monkeypatch.setattr(ranges, "_AT_ONCE", 1)
    monkeypatch.setattr(ranges, "abreast", counted)
    apart.play(flights)
    assert played == [1, 1, 1]
    assert apart.ticks == together.ticks
    assert apart.formats(24).to_json() == together.formats(24).to_json()


def test_ten_flights_cost_about_what_one_does():
    flights = [recorded("ins_eskf", seed, 0.5) for seed in range(10)]

    def cost(some):
        start = process_time()
        Sizes(some[0].pipeline).play(some)
        return process_time() - start

    cost(flights[:1])
    ratio = min(cost(flights) / cost(flights[:1]) for _ in range(3))
    assert ratio < 5.0


def test_constants_that_differ_are_those_that_vary():
    flights = [recorded("ins_eskf", seed, 0.1) for seed in range(2)]
    found = varying([f.pipeline for f in flights])
    first, second = (f.pipeline.constants for f in flights)
    assert found == {n for n, a in first.items() if not np.array_equal(a, second[n])}
    assert not varying([flights[0].pipeline])
