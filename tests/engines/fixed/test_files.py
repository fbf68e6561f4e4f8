"""Fixed point as files of C that stand alone, and words that are wider where they are held."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flowgraph import (
    DeclarationError,
    Scalar,
    Series,
    Stream,
    block,
    delay,
    graph,
    lower,
    periodic,
    simulate,
)
from flowgraph.engines.c import write_events
from flowgraph.engines.c.fixed import CompiledIntegers
from flowgraph.engines.c.fixed_replay import write_fixed
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.fixed.files import patterns_with_formats, texts_of
from flowgraph.engines.fixed.places import SharedPlaces
from flowgraph.engines.fixed.source import Source
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.pipeline.format_files import with_formats
from flowgraph.pipeline.formats import Formats
from flowgraph.recorder.random import seed_words
from tests.engines.c.support import STRICT, built, replays
from tests.engines.fixed.test_fixed import formats_of, sizes_of
from tests.graphs.library import library_case
from tests.support import same


def _numbers(result, name):
    series = result[name]
    rows = zip(
        *(np.asarray(x, float).reshape(len(series.time), -1) for x in series.leaves.values()), strict=True
    )
    return [(int(t), np.concatenate(r)) for t, r in zip(series.time, rows, strict=True)]


@pytest.mark.parametrize(("held", "every"), [(0, 0), (30, 0), (44, 0), (44, 4)])
def test_the_written_files_replay_what_the_interpreter_gives(held, every, tmp_path):
    case = library_case("kalman", 0.5)
    formats = formats_of("kalman", 24)
    if held:
        wider = dict.fromkeys(sorted(formats.fractions)[::every] if every else (), 32)
        formats = sizes_of(case.graph, case.inputs).formats(24, 4.0, held, wider)
        assert len(formats.by_width()) == 1 + (every > 0)
    pipeline = with_formats(lower(case.graph, dtype="fixed"), formats)
    files = write_fixed(pipeline, tmp_path)
    assert sorted(files) == ["Makefile", "kalman_fixed.c", "kalman_fixed.h", "main.c"]
    write_events(pipeline, case.inputs, tmp_path / "events.csv")
    done = replays(built(tmp_path, *STRICT, module="kalman_fixed"), (tmp_path / "events.csv").read_bytes())
    assert done.returncode == 0, done.stderr
    result = simulate(case.graph, case.inputs, engine="fixed", formats=formats)
    lines = [line.split(",") for line in done.stdout.splitlines()]
    assert len(lines) > 20
    for port in pipeline.outputs:
        printed = [(int(t), np.array(x, float)) for t, name, *x in lines if name == port.name]
        expected = _numbers(result, port.name)
        assert [t for t, _ in printed] == [t for t, _ in expected]
        for (_, ours), (_, theirs) in zip(printed, expected, strict=True):
            assert (ours == theirs).all()


def test_places_are_used_again_and_no_value_is_overwritten_before_it_was_read():
    """The memory is a small part of what all values take, and at each step every place has one owner."""
    case = library_case("kalman", 0.5)
    pipeline = with_formats(lower(case.graph, dtype="fixed"), formats_of("kalman", 24))
    keys = patterns_with_formats(pipeline)[0]
    all_ = Source(pipeline, keys)
    source, texts = texts_of(pipeline)
    assert 4 * source.sizes["v"] + 8 * source.sizes["w"] < 0.25 * 9 * all_.size
    assert "FX_SMALL" in texts["kalman_fixed.h"]
    player = Integers(
        pipeline, [c.reset for r in pipeline.registers for c in r.cells], np.zeros(2, np.uint32)
    )
    places = SharedPlaces(player, keys)
    for key in keys:
        bound = player.bind(key)
        places.begin(key, bound)
        program = bound.program
        ends = {*program.writes, *(n for flag, leaves in program.outputs if flag is not None for n in leaves)}
        last = {a: k for k, i in enumerate(program.instructions) for a in i.args} | dict.fromkeys(ends, 10**9)
        owner: dict[tuple[str, int], int] = {}
        for k, i in enumerate(program.instructions):
            for n in i.args:
                array, begin = places.at(n, ())
                for at in range(begin, begin + max(math.prod(program.specs[n].shape), 1)):
                    held = owner.get((array, at), n)
                    assert held == n or _shared(places, held, n), (i.op, n, held)
            array, begin = places.at(i.out, ())
            for at in range(begin, begin + max(math.prod(i.spec.shape), 1)):
                before = owner.get((array, at))
                assert before is None or last.get(before, -1) < k or _shared(places, before, i.out)
                owner[array, at] = i.out


def _shared(places, a, b):
    """Whether one of two values is a part of the other, or both are of a third."""
    roots = []
    for n in (a, b):
        while n in places._view:
            n = places._view[n][0]
        roots.append(n)
    return roots[0] == roots[1]


def test_what_cannot_be_read_is_refused_by_the_written_program(tmp_path):
    pipeline = with_formats(lower(library_case("kalman", 0.5).graph, dtype="fixed"), formats_of("kalman", 24))
    write_fixed(pipeline, tmp_path)
    program = built(tmp_path, *STRICT, module="kalman_fixed")
    name = pipeline.inputs[0].name
    for text, said in (
        ("0,nothing,1\n", "no input is called nothing"),
        (f"0,{name},1\n", "too few numbers"),
        (f"x,{name},1\n", "this is no whole number: x"),
        (f"0,{name},1y\n", "this is no number: 1y"),
        (f"0,{name},nan\n", "not finite: nan"),
    ):
        done = replays(program, text)
        assert done.returncode == 1
        assert said in done.stderr


@block
def step(x: Scalar, rate: Scalar) -> Scalar:
    """What adds small parts to a large one."""
    return x + rate * 0.003


@graph
def gathered(rate: Stream[Scalar]):
    """A sum of many small parts."""
    sum_ = delay(0.0, name="sum")
    after = step(sum_, rate)
    sum_.feed(after)
    return {"after": after}


def test_one_text_serves_all_formats_of_a_structure_while_they_are_looked_for():
    built_graph = gathered.build(rate=periodic("10ms"))
    inputs = {"rate": Series(np.arange(40) * 10_000_000, 1.0 + 0.1 * np.arange(40))}
    sizes = sizes_of(built_graph, inputs)
    texts, ends = set(), []
    subject = LoweredGraph(built_graph, dtype="fixed")
    start = subject.start(RunOptions())
    tape = subject.tape(inputs, start.last)
    added = next(i.out for i in sizes.pipeline.instructions if i.op == "multiply")
    for width, held, wider in ((12, 0, {}), (12, 24, {}), (12, 24, {added: 30}), (32, 0, {})):
        pipeline = with_formats(lower(built_graph, dtype="fixed"), sizes.formats(width, 2.0, held, wider))
        players = [CompiledIntegers(pipeline, tape.patterns, tabled=tabled) for tabled in (False, True)]
        ours, theirs = (p.play(tape, start.cells, seed_words(0), None) for p in players)
        np.testing.assert_array_equal(ours.outputs[0][1][0], theirs.outputs[0][1][0])
        texts.add(players[1].source.text)
        ends.append(float(theirs.outputs[0][1][0][-1]))
    assert len(texts) == 1
    assert len(set(ends)) == 3


def test_wider_registers_are_nearer_and_equal_in_c():
    built_graph = gathered.build(rate=periodic("10ms"))
    time = np.arange(300) * 10_000_000
    inputs = {"rate": Series(time, 1.0 + 0.5 * np.sin(0.01 * np.arange(300)))}
    sizes = sizes_of(built_graph, inputs)
    real = simulate(built_graph, inputs, engine="reference").after.value
    apart = {}
    for held in (0, 24, 40):
        formats = sizes.formats(14, 2.0, held)
        ours = simulate(built_graph, inputs, engine="fixed", formats=formats)
        same(ours, simulate(built_graph, inputs, engine="c", dtype="fixed", formats=formats))
        apart[held] = np.abs(ours.after.value - real).max()
        register = next(r for r in lower(built_graph).registers if r.path == "sum")
        assert formats.width_of(register.cells[0].read) == (held or 14)
        assert Formats.from_json(formats.to_json()).to_json() == formats.to_json()
    assert apart[24] < 0.05 * apart[0]
    assert apart[40] <= apart[24]


def test_held_words_are_no_narrower_than_the_others():
    with pytest.raises(DeclarationError, match="no word has this width") as refused:
        Formats(24, {}, wider={1: 20})
    assert refused.value.expected == "24 to 48 bits"
    with pytest.raises(DeclarationError, match="no word has this width"):
        Formats(24, {}, wider={1: 49})
