"""The cost report counts what it says: by hand where a hand can, and against itself elsewhere."""

from __future__ import annotations

import html.parser
from dataclasses import replace

import numpy as np
import pytest

from flowgraph import (
    DeclarationError,
    Scalar,
    Stream,
    UnknownNameError,
    aperiodic,
    block,
    delay,
    every,
    find_graph,
    graph,
    latest,
    load_flight,
    lower,
    match,
    periodic,
    zip,
)
from flowgraph.graphs.benches.cost import cost
from flowgraph.pipeline.costs import Costs, Machine, cost_report
from flowgraph.pipeline.costs.energy import access_pj, arithmetic_pj
from flowgraph.pipeline.costs.operations import depth, operations
from flowgraph.pipeline.costs.timing import critical_path, interval, reach
from flowgraph.pipeline.optimise import without
from flowgraph.pipeline.program import specialise
from flowgraph.recorder.ops import Spec
from flowgraph.types import dtype_name
from tests.pipeline.optimise.programs import record
from tests.recorder.test_symbolic import CASES
from tests.recorder.test_symbolic import record as record_case


def only(step, *shapes):
    """The operations, and their depth, of the one instruction of a step that computes anything."""
    program = record(step, *shapes)
    (found,) = [i for i in program.instructions if operations(i, program.specs)]
    return dict(+operations(found, program.specs)), depth(found, program.specs)


@pytest.mark.parametrize(
    ("step", "shapes", "expected", "levels"),
    [
        (lambda xp, x: x * 2.0, [(3, 4)], {"multiply": 12}, 1),
        (lambda xp, x, y: x @ y, [(3, 4), (4, 5)], {"multiply": 60, "add": 45}, 3),
        (lambda xp, x, y: x @ y, [(4,), (4,)], {"multiply": 4, "add": 3}, 3),
        (lambda xp, x: xp.sum(x, axis=0), [(8, 2)], {"add": 14}, 3),
        (lambda xp, x: xp.mean(x), [(8,)], {"add": 7, "divide": 1}, 4),
        (lambda xp, x: xp.max(x, axis=-1), [(2, 5)], {"compare": 8}, 3),
        (lambda xp, x, y: xp.linalg.cross(x, y), [(3,), (3,)], {"multiply": 6, "add": 3}, 2),
        (lambda xp, x, y: xp.linalg.outer(x, y), [(3,), (2,)], {"multiply": 6}, 1),
        (lambda xp, x: xp.linalg.cholesky(x), [(2, 2)], {"multiply": 1, "add": 1, "divide": 1, "root": 2}, 6),
        (
            lambda xp, x, y: xp.linalg.solve(x, y),
            [(2, 2), (2,)],
            {"multiply": 3, "add": 3, "divide": 3, "compare": 1},
            12,
        ),
        (lambda xp, x: xp.exp(x), [()], {"function": 1}, 1),
        (lambda xp, x: xp.cumulative_sum(x), [(8,)], {"add": 8}, 3),
        (lambda xp, x, y: xp.searchsorted(x, y), [(7,), (10,)], {"compare": 30}, 3),
    ],
)
def test_operations_as_counted_by_hand(step, shapes, expected, levels):
    assert only(step, *shapes) == (expected, levels)


def test_moves_cost_nothing():
    program = record(lambda xp, x: xp.reshape(xp.concat([x[1:], x[:1]]).mT, (12,)), (3, 4))
    assert all(not operations(i, program.specs) for i in program.instructions)


@pytest.mark.parametrize("name", CASES)
def test_every_operation_can_be_counted(name):
    for function, arrays in CASES[name]:
        trace, numbers, _ = record_case(function, arrays)
        known = {**trace.constants, **{n: arrays[k] for k, n in enumerate(numbers)}}
        specs = {n: Spec(np.shape(a), dtype_name(a)) for n, a in known.items()}
        for i in trace.instructions:
            specs[i.out] = i.spec
            assert depth(i, specs) >= 0
            assert min(operations(i, specs).values(), default=0) >= 0


def test_longest_chains():
    def step(xp, x, y):
        memory = x + 1.0
        return xp.exp(xp.exp(y)), memory * 2.0

    program = record(step, (), (), memory=(0,))
    assert critical_path(program) == 2
    assert reach(program, {1})[program.outputs[0][1][0]] == 2
    found = interval(program, Machine(multipliers=4))
    assert found.feedback == 2  # x + 1, times 2
    assert found.multipliers == 5  # two functions of 9 products each, and one product, on 4 multipliers


def test_lanes_share_the_work_along_their_axis():
    program = record(lambda xp, x, y: (x * x, y * y), (100,), (8,), lanes=(100,))
    assert interval(program, Machine(multipliers=1)).multipliers == 108
    assert interval(program, Machine(multipliers=1, lanes=10)).multipliers == 18
    assert interval(program, Machine(multipliers=2, lanes=10)).multipliers == 9


def test_energy_is_of_the_table():
    assert arithmetic_pj({"multiply": 10, "add": 10}) == pytest.approx(46.0)
    assert arithmetic_pj({"divide": 1}) == pytest.approx(5 * 3.7 + 4 * 0.9)
    assert access_pj(2, 8192) == 10.0
    assert access_pj(2, 8193) == 20.0
    assert access_pj(2, 2**30) == 100.0


@block
def leak(level: Scalar, inflow: Scalar) -> Scalar:
    return level * 0.9 + inflow


@graph
def joined(x: Stream[Scalar], y: Stream[Scalar]):
    level = delay(0.0, name="level")
    after = leak(level, latest(x, init=0.0), at=x | y)
    level.feed(after)
    return {
        "level": after,
        "pairs": match(x, y, tolerance=5, size=7).map(lambda p: p[0] + p[1]),
        "turns": zip(every(2, x), every(2, x, phase=1)).map(lambda p: p[0] - p[1]),
    }


def fifos(**clocks):
    report = cost_report(lower(joined.build(**clocks)), multipliers=1, clock=1e6)
    return {row["fifo"]: row for row in report["FIFOs"]}


def test_queues_of_joins_with_the_reason_for_their_size():
    found = fifos(x=periodic("10ms"), y=periodic("10ms"))
    assert found["match, queue a"]["depth"] == 8
    assert found["match, queue a"]["width"] == 64 + 32  # a stamp and a real
    assert "size=7 was declared" in found["match, queue b"]["why"]
    assert found["zip, queue a"]["depth"] == 2
    assert "the clocks let 1 wait" in found["zip, queue a"]["why"]


def test_inputs_wait_while_a_tick_is_under_way():
    assert fifos(x=periodic("10ms"), y=periodic("10ms"))["input x"]["depth"] == 1
    unbounded = fifos(x=periodic("10ms"), y=aperiodic())["input y"]
    assert unbounded["depth"] == "none"
    assert "max_rate" in unbounded["why"]
    crowded = fifos(x=periodic("1us"), y=periodic("10ms"))["input x"]
    assert crowded["depth"] == "none"
    assert "% of the time" in crowded["why"]
    rare = fifos(x=aperiodic(max_rate=60_000.0), y=aperiodic(max_rate=1_000.0))["input x"]
    assert rare["depth"] >= 2  # a tick of the other, and its own, take longer than two of its events


@pytest.fixture(scope="module")
def eskf():
    case = find_graph("ins_eskf").case(load_flight("sim", settings={"duration": "1"}))
    return lower(case.graph)


@pytest.fixture(scope="module")
def report(eskf):
    return cost_report(eskf)


def test_the_sums_are_those_of_the_parts(report):
    stages, operations_ = report["Stages"], report["Operations"]
    for row in operations_[:-1]:
        assert sum(s[row["kind"]] for s in stages[:-1]) == row["optimised"] == stages[-1][row["kind"]]
    assert report["Ticks"][-1]["operations"] == operations_[-1]["optimised"]
    assert len(report["Ticks"]) == 7
    energy = report["Energy"]
    assert energy[-1]["nJ"] == pytest.approx(sum(r["nJ"] for r in energy[:-1]), abs=0.01)


def test_registers_hold_the_state(report):
    rows = {r["name"]: r for r in report["Memory"]}
    assert rows["belief.covariance"] == {
        "name": "belief.covariance", "for": "delay", "kind": "memory", "bits": 225 * 32
    }  # fmt: skip
    assert rows["belief.attitude"]["kind"] == "register"


def test_passes_show_in_the_report(eskf):
    full, plain = (Costs(eskf, 7, p).operations for p in (without(), ()))
    assert full["multiply"] < 0.35 * plain["multiply"]
    assert plain == Costs(eskf, 7, ("drop",)).operations
    with pytest.raises(UnknownNameError, match="pass"):
        cost_report(eskf, passes=["all"])


@pytest.mark.parametrize("setting", ["multipliers", "lanes", "clock"])
def test_a_machine_of_nothing_is_refused(eskf, setting):
    with pytest.raises(DeclarationError, match=f"a machine needs {setting}"):
        cost_report(eskf, **{setting: 0})  # type: ignore[arg-type]


def test_stages_start_when_those_before_are_done(eskf):
    costs = Costs(eskf, 7)
    slots = costs.slots
    assert slots["predict"].end <= slots["aid_position"].start
    assert slots["aid_position"].end <= slots["aid_attitude"].start


class Page(html.parser.HTMLParser):
    """Checks that tags close in order, and keeps what is in cells."""

    def __init__(self):
        super().__init__()
        self.open, self.cells = [], []

    def handle_starttag(self, tag, attrs):
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "td":
            self.cells.append(data)


def test_text_and_page_show_all_tables(report):
    page = Page()
    page.feed(report.html())
    page.close()
    assert page.open == []
    for section in report.sections:
        assert f"\n{section.title}\n---" in report.text()
    assert "belief.covariance" in page.cells
    assert "7,200" in page.cells


def test_names_cannot_inject_markup(report):
    page = replace(report, name="<script>alert(1)</script>").html()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


def test_the_bench_of_particles_shows_what_they_cost():
    report = cost(particles="4,40", flights=1, duration=2.0, engine="reference")
    few, many = report.rows
    assert [few["particles"], many["particles"]] == [4, 40]
    for name in ("kept_kbit", "memory_kbit", "products", "operations", "cycles", "energy_uJ"):
        assert few[name] < many[name]
    assert np.isfinite([few["position_mm"], many["heading_deg"]]).all()
    assert all(len(note) < 250 for note in report.notes)


@pytest.mark.parametrize("bad", [{"particles": "10;20"}, {"particles": "0"}, {"flights": 0}])
def test_the_bench_refuses_what_is_no_size(bad):
    with pytest.raises(
        DeclarationError, match=r"cost\.particles: these are no whole|cost needs a whole number as 'flights'"
    ):
        cost(**bad)


def test_lanes_and_specialised_patterns_agree():
    """What an absent source costs is not counted."""
    case = find_graph("rbpf_indoor").case(load_flight("sim", settings={"duration": "1"}), particles=50)
    pipeline = lower(case.graph)
    imu, both = (Costs(pipeline, key) for key in (1, 3))
    assert sum(imu.operations.values()) < sum(both.operations.values())
    assert specialise(pipeline, 1).lanes == {50}
