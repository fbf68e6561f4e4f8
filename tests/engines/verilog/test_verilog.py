"""Verilog: lints clean, and every register and output is the integer interpreter's, word for word."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace
from typing import Annotated, Any, cast

import numpy as np
import pytest

from flowgraph import (
    DeclarationError,
    LoweringError,
    MissingDependencyError,
    Scalar,
    Stream,
    block,
    graph,
    latest,
    real,
    simulate,
)
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.engines.verilog import ENGINE as VERILOG
from flowgraph.engines.verilog import simulate as simulation
from flowgraph.engines.verilog.bounds import most_of, need_room
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.latency import UNIT_LATENCY
from flowgraph.engines.verilog.nodes import Constant, Held, Nodes, Sum, Term, shifted
from flowgraph.engines.verilog.schedule import Lanes, Plan, schedule
from flowgraph.engines.verilog.simulate import Simulated
from flowgraph.engines.verilog.text import texts
from flowgraph.engines.verilog.tick import Tick
from flowgraph.pipeline.format_files import with_formats
from flowgraph.recorder.random import seed_words
from tests.engines.fixed.test_fixed import formats_of, sizes_of
from tests.graphs.library import library_case
from tests.support import same_state

MS = 1_000_000
Three = Annotated[Any, real(3)]
Nine = Annotated[Any, real(9, 9)]


def need_verilator():
    try:
        simulation.verilator()
    except MissingDependencyError as error:
        pytest.skip(str(error.fix))


@block
def mixed(x: Three, y: Scalar, *, dt: float, xp) -> Three:
    """Something of everything that the machine has."""
    up = xp.where(x > 0.5, xp.sqrt(xp.abs(x)), -xp.exp(x))
    turned = xp.sin(x) * xp.cos(up) + xp.atan2(up, x + 2.0) / (1.5 + y)
    count = xp.astype(xp.floor(4.0 * x), xp.int32) - 3
    some = xp.asarray(xp.any(x > 0.9), dtype=x.dtype) - xp.asarray(xp.all(x < 0.9), dtype=x.dtype)
    most = xp.max(turned) - xp.min(x) + xp.log(xp.abs(y) + 0.25) + dt
    most = most - xp.max(xp.unnormalized_sinc(3.0 * x))
    kept = xp.minimum(x, y) @ xp.stack([x, up, turned])
    ends = xp.ceil(3.0 * x) + xp.trunc(5.0 * up) - xp.round(2.0 * x) + xp.sign(x)
    return (
        kept * most
        + xp.remainder(4.0 * x + y, 1.5)
        + xp.copysign(up, x)
        + some * xp.asarray(count, dtype=x.dtype)
        - ends
    )


@graph
def everything(x: Stream[Three], y: Stream[Scalar]):
    """One block, and a held value: three patterns of present inputs."""
    return {"z": mixed(x, latest(y, init=0.5)), "y": y}


def flight(seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (60, 3))
    x[7], x[11] = 0.0, [0.0, -0.5, 1.0]
    return {
        "x": (np.arange(60, dtype=np.int64) * MS, x),
        "y": (np.arange(40, dtype=np.int64) * MS * 3 // 2, rng.uniform(-0.2, 0.9, 40)),
    }


@pytest.fixture(scope="module")
def made():
    built = everything.build()
    formats = sizes_of(built, flight()).formats(26, 2.0, 30)
    subject = LoweredGraph(built)
    return built, formats, with_formats(subject.pipeline, formats), subject.tape(flight())


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [2, 3])
def test_several_lanes_are_equal_and_take_fewer_cycles(made, lanes):
    need_verilator()
    built, _, pipeline, tape = made
    player = Simulated(pipeline, tape.patterns, check=True, lanes=lanes)
    player.play(tape, LoweredGraph(built).start(RunOptions()).cells, seed_words(0), None)
    assert player.compared > 400
    assert player.differing == 0


def test_operations_are_equal_to_the_interpreter_in_every_register_and_output(made, tmp_path):
    need_verilator()
    built, formats, pipeline, tape = made
    assert len(tape.patterns) == 3
    player = Simulated(pipeline, tape.patterns, check=True)  # its build lints with -Wall first
    cells = LoweredGraph(built).start(RunOptions()).cells
    outcome = player.play(tape, cells, seed_words(0), None)
    assert player.compared > 400
    assert player.differing == 0
    ours = simulate(built, flight(), engine="fixed", formats=formats)
    for (times, leaves), series in zip(outcome.outputs, ours.series.values(), strict=True):
        np.testing.assert_array_equal(times, series.time)
        np.testing.assert_array_equal(leaves[0], series.value)
    again = Simulated.__new__(
        Simulated
    )  # the same machine as an engine plays it, without the interpreter beside
    vars(again).update(vars(player), check=False)
    played = again.play(tape, cells, seed_words(0), None)
    for a, b in zip(played.cells, outcome.cells, strict=True):
        np.testing.assert_array_equal(a, b)
    assert max(again.cycles) == max(player.cycles) > 100

    # the script that is written for the bench compares by itself, and sees a single wrong word
    file = tmp_path / "script"
    assert VERILOG.write_events(pipeline, flight(), file) == len(tape.time)
    lines = file.read_text().splitlines()
    compared = sum(line.startswith("is") for line in lines)
    assert compared == player.compared
    assert _bench(player, file) == (0, compared, 0)
    last = max(k for k, line in enumerate(lines) if line.startswith("is"))
    lines[last] = f"{lines[last]}1"
    file.write_text("\n".join(lines))
    assert _bench(player, file) == (1, compared, 1)


def test_the_makefile_takes_the_verilator_there_is(made, tmp_path):
    """The package `verilator` brings a command of another name than Verilator itself has."""
    _, _, pipeline, _ = made
    VERILOG.write(pipeline, tmp_path / "machine", "fixed", ())
    make = shutil.which("make")
    assert make is not None
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "sh").symlink_to("/bin/sh")
    for name in ("verilator-cli", "verilator"):
        (tools / name).write_text("")
        (tools / name).chmod(0o755)
        said = subprocess.run(
            [make, "-n", "lint"], cwd=tmp_path / "machine", env={"PATH": str(tools)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert said.stdout.startswith(f"{name if name != 'verilator' else str(tools / name)} --lint-only")


@block
def in_order(x: Three, y: Scalar, *, xp) -> Three:
    """Lengths, and small sorts: of equal numbers, and of very different ones."""
    some = xp.stack([x[0], 1e3 * x[1], x[0], xp.hypot(x[1], 1e-3 * x[2])])
    low, order = xp.sort(some), xp.argsort(some)
    return xp.stack(
        [xp.hypot(x[0] + 0.0 * y, 3.0 * x[1]), low[0] - low[2], 1e-3 * low[3] + low[1]]
    ) + xp.asarray(order[0] + 2 * order[3] - order[1], dtype=x.dtype)


@graph
def lengths(x: Stream[Three], y: Stream[Scalar]):
    return {"z": in_order(x, latest(y, init=0.5))}


@pytest.mark.parametrize("every", [0, 2])
def test_lengths_and_small_sorts_are_equal_with_some_wider_words_too(every):
    need_verilator()
    built = lengths.build()
    subject = LoweredGraph(built)
    sizes = sizes_of(built, flight())
    wider = dict.fromkeys(sorted(sizes.formats(26).fractions)[::every] if every else (), 31)
    pipeline = with_formats(subject.pipeline, sizes.formats(26, 2.0, wider=wider))
    tape = subject.tape(flight())
    player = Simulated(pipeline, tape.patterns, check=True)
    player.play(tape, subject.start(RunOptions()).cells, seed_words(0), None)
    assert player.compared > 180
    assert player.differing == 0


@block
def apart(x: Three, *, xp) -> Three:
    """Extremes of numbers so different that at the fraction of the finest the largest fits no word."""
    sizes = xp.stack([1e-6 * x[0], x[1], 1e3 * x[2], 1e-6 * x[1]])
    place = xp.argmax(xp.abs(sizes))
    return xp.stack([xp.max(sizes), xp.min(sizes), xp.asarray(place, dtype=x.dtype)])


@graph
def extremes(x: Stream[Three], y: Stream[Scalar]):
    return {"z": apart(x), "y": y}


def test_extremes_of_numbers_of_very_different_sizes():
    need_verilator()
    built = extremes.build()
    subject = LoweredGraph(built)
    pipeline = with_formats(subject.pipeline, sizes_of(built, flight()).formats(28, 2.0))
    tape = subject.tape(flight())
    player = Simulated(pipeline, tape.patterns, check=True)
    player.play(tape, subject.start(RunOptions()).cells, seed_words(0), None)
    assert player.compared > 200
    assert player.differing == 0


def _bench(player, file):
    run = [str(player.built.program), str(file)]
    done = subprocess.run(
        run, cwd=player.built.program.parent.parent, capture_output=True, text=True, check=False
    )
    said = dict(line.split() for line in done.stderr.splitlines() if line.startswith("values_"))
    return done.returncode, int(said["values_compared"]), int(said["values_differing"])


@pytest.mark.slow
def test_a_filter_with_readings_that_are_not_there_is_equal():
    need_verilator()
    case = library_case("kalman", 0.5)
    formats = formats_of("kalman", 24)
    ours = simulate(case.graph, case.inputs, engine="fixed", formats=formats)
    theirs = simulate(case.graph, case.inputs, engine="verilog", formats=formats)
    same_state(ours.state, theirs.state)
    for name, series in ours.series.items():
        np.testing.assert_array_equal(series.time, theirs[name].time)
        for leaf, x in series.leaves.items():
            np.testing.assert_array_equal(x, theirs[name].leaves[leaf])
    assert theirs.stats["cycles"] < 3000


@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_word_is_read_after_it_is_written_and_its_place_is_kept_until_then(made, count):
    _, _, pipeline, tape = made
    player = Integers(
        pipeline, [c.reset for r in pipeline.registers for c in r.cells], np.zeros(2, np.uint32)
    )
    plan = Plan(Tick(player, tape.patterns[-1]))
    lanes = Lanes(count, count > 1, (2, 1, 1, 1))
    found = schedule(plan, lanes=lanes)
    nodes = plan.tick.nodes
    at = {s.writes: t for t, s in found.slots if s.writes is not None}
    started: dict[tuple[int, int], tuple[Sum, int]] = {}
    lies: dict[int, int] = {}
    due: list[tuple[int, int]] = []
    banks: dict[int, list[int]] = {}
    for t, slot in found.slots:
        for when, n in [d for d in due if d[0] <= t]:
            lies[found.place.get((n, 0), -1 - n)] = n
            due.remove((when, n))
        for r in (slot.term.a, *([] if slot.term.kind == "TAKE" else [slot.term.b])):
            node = nodes[r]
            if isinstance(node, Sum) and node.mode != "START":
                assert t >= at[r] + lanes.latency(node)
                assert lies[found.place.get((r, 0), -1 - r)] == r
        unit = slot.node.unit, slot.copy
        if slot.term.kind == "TAKE":
            names = ("divide", "root", "logarithm", "angle")
            assert t >= started[unit][1] + UNIT_LATENCY[names[slot.node.unit]]
            assert started[unit][0] == nodes[slot.term.a]
        if slot.mode == "START":
            started[unit] = (slot.node, t)
        if slot.writes is not None:
            due.append((t + lanes.latency(slot.node), slot.writes))
            place = found.place.get((slot.writes, 0))
            banks.setdefault(t, []).append(slot.bank)
            assert place is None or place % lanes.banks == slot.bank
    assert all(len(set(b)) == len(b) <= lanes.banks for b in banks.values())  # a bank takes a word a cycle
    assert sum(1 for _ in found.slots) == sum(len(plan.tick.made(n).terms) for n in plan.order)
    assert found.size < len(plan.order)  # places are used again
    assert len(found.words) == found.cycles


@block
def squared(x: Nine, *, xp) -> Nine:
    """Many sums that do not wait for each other."""
    return x @ x


@graph
def wide(x: Stream[Nine]):
    return {"y": squared(x)}


def test_more_lanes_give_their_share():
    built = wide.build()
    inputs = {"x": (np.arange(2, dtype=np.int64), np.linspace(-1.0, 1.0, 162).reshape(2, 9, 9))}
    pipeline = with_formats(LoweredGraph(built).pipeline, sizes_of(built, inputs).formats(24, 2.0))
    one, two, four = (Image(pipeline, [1], lanes).entries[0].cycles for lanes in (1, 2, 4))
    assert one == 729
    assert two < 0.52 * one
    assert four < 0.28 * one


def test_a_machine_without_lanes_is_refused(made):
    _, _, pipeline, tape = made
    with pytest.raises(DeclarationError, match="a machine has some lanes"):
        Image(pipeline, tape.patterns, 0)


def test_what_is_known_costs_nothing():
    nodes = Nodes(24)
    a, b = (nodes.add(Held(0, k, False, 24)) for k in range(2))
    zero, half = nodes.constant(0), nodes.constant(1 << 20)
    assert nodes.sum([Term("MUL", a, zero, 3), Term("MUL", b, half, 20)]) == b
    assert nodes.sum([Term("MUL", a, half, 0)], end=20) == a
    first = nodes.sum([Term("MUL", a, b, 20), Term("MUL", b, half, 19)])
    assert nodes.sum([Term("MUL", half, b, 19), Term("MUL", b, a, 20)]) == first
    assert nodes.nodes[nodes.sum([Term("MUL", half, half, 19)])] == Constant(1 << 21)
    assert nodes.sum([Term("SEL", a, nodes.one), Term("SELN", b, nodes.one)]) == a
    assert nodes.sum([Term("MUL", half, half)]) == nodes.constant((1 << 23) - 1)  # cut to a word


@pytest.mark.parametrize(
    ("x", "by", "made"), [(5, 1, 3), (-5, 1, -2), (-6, 2, -1), (3, -62, 1 << 62), (1, 63, 0)]
)
def test_shifts_round_halves_upwards_and_keep_to_62_bits(x, by, made):
    assert shifted(x, by) == made


@block
def sorted_(x: Nine, *, xp) -> Nine:
    """More than the machine sorts."""
    return xp.reshape(xp.sort(xp.reshape(x, (81,))), (9, 9))


@graph
def sorting(x: Stream[Nine]):
    """One block."""
    return {"y": sorted_(x)}


def test_an_operation_that_is_not_there_is_named_with_its_line():
    built = sorting.build()
    inputs = {"x": (np.arange(2, dtype=np.int64), np.linspace(-1.0, 1.0, 162).reshape(2, 9, 9))}
    pipeline = with_formats(LoweredGraph(built).pipeline, sizes_of(built, inputs).formats(24, 2.0))
    with pytest.raises(LoweringError, match="sort of real has no form in hardware yet") as caught:
        Image(pipeline, [1])
    assert str(caught.value.path).startswith("tests.engines.verilog.test_verilog:")


def test_held_words_that_are_wider_than_those_of_the_machine_are_refused():
    pipeline = LoweredGraph(everything.build()).pipeline
    formats = sizes_of(everything.build(), flight()).formats(24, 2.0, 44)
    with pytest.raises(LoweringError, match="(?s)held words are wider.*32 bits or fewer.*44.*held-width"):
        Image(with_formats(pipeline, formats), [1])


def test_words_of_more_than_two_widths_are_refused_with_the_place():
    pipeline = LoweredGraph(everything.build()).pipeline
    sizes = sizes_of(everything.build(), flight())
    some = [i.out for i in pipeline.instructions if i.op == "multiply"][:1]
    Image(with_formats(pipeline, sizes.formats(24, 2.0, 30, dict.fromkeys(some, 30))), [1])
    with pytest.raises(LoweringError, match="(?s)words of two widths.*24 or 30 bits.*got: +28") as refused:
        Image(with_formats(pipeline, sizes.formats(24, 2.0, 30, dict.fromkeys(some, 28))), [1])
    assert str(refused.value.path).startswith(f"v{some[0]} multiply, ")


def test_the_files_name_places_and_lines(made, tmp_path):
    _, _, pipeline, tape = made
    found = texts(Image(pipeline, tape.patterns))
    assert "module everything (" in found["everything.v"]
    assert "input 0 x.value: [" in found["everything.v"]
    assert "tests.engines.verilog.test_verilog" in found["everything.lst"]
    program = [line for name, text in found.items() if "program" in name for line in text.split()]
    assert len(program) == len(found["everything.lst"].splitlines())


def test_without_verilator_the_engine_says_what_to_install(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(simulation, "find_spec", lambda name: None)
    built = everything.build()
    with pytest.raises(MissingDependencyError, match="needs Verilator") as caught:
        simulate(built, flight(), engine="verilog", formats=sizes_of(built, flight()).formats(26, 2.0))
    assert "hardware" in str(caught.value.fix)


def test_numbers_that_may_not_be_there_are_refused_where_the_machine_has_no_word_for_them(made):
    _, formats, pipeline, tape = made
    x = next(p for p in pipeline.inputs if p.name == "x").leaves[0].value
    doubtful = replace(pipeline, formats=replace(formats, absent=frozenset([x])))
    with pytest.raises(LoweringError, match="may meet a reading that is not there"):
        Image(doubtful, tape.patterns)


def test_whole_numbers_have_as_many_words_as_they_need_and_what_may_not_fit_is_refused(made):
    _, _, pipeline, tape = made
    cells = [c.reset for r in pipeline.registers for c in r.cells]
    tick = Tick(Integers(pipeline, cells, np.zeros(2, np.uint32)), tape.patterns[-1])
    large, small = (tick.sum([Term("MUL", 1, 2, -k)], mode="U32") for k in (3, 4))
    above = tick.sum([tick.plain(1)], mode="LT")
    assert len(tick.wrapped([tick.plain(large), tick.plain(above)], "int64")) == 1
    assert len(tick.wrapped([tick.plain(large), tick.plain(small)], "int64")) == 2  # 2^33 fits no word
    fits = tick.sum([Term("SEL", large, above), Term("SELN", small, above)], mode="RAW")
    assert most_of(tick, fits) == 2**32
    tick.here = "a line"
    over = tick.sum([tick.plain(large), tick.plain(fits)], mode="RAW")
    planned = lambda *order: cast("Plan", SimpleNamespace(tick=tick, order=[*order]))
    need_room(planned(fits))
    with pytest.raises(LoweringError, match="may not fit a word of the machine") as caught:
        need_room(planned(fits, over))
    assert caught.value.path == "a line"
