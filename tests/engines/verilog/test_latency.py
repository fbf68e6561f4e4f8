"""The machine takes as many cycles as its programs are made for: measured in Verilator by programs by hand.

A word, an index or a unit's result is asked for at once when it is there, a cycle earlier, and long after.
What comes long after is right; at once it must be that, and a cycle earlier not. A memory that is read in the
cycle in which it is written gives in Verilator what nobody wrote: no program is right by chance.
"""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from typing import Any

import pytest

from flowgraph import MissingDependencyError
from flowgraph.data.files import put
from flowgraph.engines.verilog import simulate as simulation
from flowgraph.engines.verilog.image import BLOCK, Image
from flowgraph.engines.verilog.latency import AHEAD, DEEP, LATENCY, READ, READ_DEEP, SPARE_DEEP, UNIT_LATENCY
from flowgraph.engines.verilog.nodes import PAIRED, UNITS, Sum, Term
from flowgraph.engines.verilog.order import Lanes, Slot
from flowgraph.engines.verilog.schedule import Word
from flowgraph.engines.verilog.text import texts
from tests.engines.verilog.test_rows import made  # noqa: F401

ONE, X, Y, ROW, FREE = 0, 1, 2, 4, 8
"""Places: of 1, of two numbers, of a row of four, and those that are written from there on."""

HELD = {ONE: 1, X: 1_234_567, Y: 98_765, ROW: 11, ROW + 1: 12, ROW + 2: 13, ROW + 3: 14}

LONG = 300


class Programme:
    """Microwords of the first lane by hand; a word's number is its place."""

    def __init__(self, image: Image) -> None:
        self.image, self.free = image, FREE
        self.code: list[Any] = []

    def step(self, kind, a, b=ONE, *, shift=0, mode="RAW", to=None, unit="divide", last=False) -> None:
        term = Term(kind, a, b, shift)
        node = Sum((term,), mode, unit=UNITS.index(unit))
        slot = Slot(term, True, node, mode, None if mode in ("HOLD", "START") else to, "")
        others = (None,) * (self.image.lanes.count - 1)
        self.code.append(self.image._microword(Word((slot, *others)), lambda n, nth: (n, False), last))

    def wait(self, cycles: int) -> None:
        self.code += [self.image._microword(Word(), lambda n, nth: (n, False), False)] * cycles

    def place(self) -> int:
        self.free += 1
        return self.free - 1


def word(p: Programme, gap: int) -> int:
    """A word is written, and read so many cycles later."""
    there, found = p.place(), p.place()
    p.step("MUL", X, to=there)
    p.wait(gap - 1)
    p.step("MUL", there, to=found)
    return found


def index(p: Programme, gap: int) -> int:
    """An index that was 0 becomes 2, and the element there is read."""
    found = p.place()
    p.step("ZERO", ONE, mode="INDEX", to=0)
    p.wait(LONG)
    p.step("MUL", ONE, shift=-1, mode="INDEX", to=0)
    p.wait(gap - 1)
    p.step("GET", ROW, 0, to=found)
    return found


def asked(unit: str):
    """A unit is started, and asked for its result."""
    given = {
        "divide": (("NORM", X, -62), ("NORM", Y, -31)),
        "root": (("NORM_EVEN", X, -62),),
        "logarithm": (("MUL", X, -11),),  # 31 bits, the highest of them 1
        "angle": (("MUL", X, -38), ("MUL", Y, -38)),
    }[unit]

    def result(p: Programme, gap: int) -> int:
        found = p.place()
        modes = ("HOLD", "START") if unit in PAIRED else ("START",)
        for (kind, a, shift), mode in zip(given, modes, strict=True):
            p.step(kind, a, shift=shift, mode=mode, unit=unit)
        p.wait(gap - 1)
        p.step("TAKE", ONE, UNITS.index(unit), shift={"angle": 21}.get(unit, 0), to=found, unit=unit)
        return found

    return result


@pytest.mark.parametrize("lanes", [Lanes(1, False, (1, 1, 1, 1)), Lanes(2, True, (1, 1, 1, 1))])
def test_each_result_is_there_when_it_is_said_to_be_and_no_cycle_earlier(made, lanes, tmp_path):  # noqa: F811
    try:
        simulation.verilator()
    except MissingDependencyError as error:
        pytest.skip(str(error.fix))
    _, pipeline, tape = made
    image = Image(pipeline, tape.patterns, lanes.count)
    assert image.has_rows
    first = LATENCY + (DEEP - SPARE_DEEP) * lanes.deep
    measured = {"word": (word, first), "index": (index, first + AHEAD)}
    measured |= {unit: (asked(unit), cycles) for unit, cycles in UNIT_LATENCY.items()}
    p = Programme(image)
    p.wait(
        start := 100 * BLOCK if lanes.deep else 0
    )  # behind the hundredth block, whose file has three digits
    places: dict[str, list[int]] = {}
    for name, (make, cycles) in measured.items():
        for gap in (cycles - 1, cycles, LONG):
            places.setdefault(name, []).append(make(p, gap))
            p.wait(LONG)
    end = p.place()
    p.step("MUL", Y, to=end, last=True)  # what the last microword writes is there when the machine is ready
    image.program, image.step_bits = p.code, len(p.code).bit_length()
    image.memory, image.lanes = [0] * 256, lanes
    image.entries = [replace(image.entries[0], start=start)]
    script = [f"put {place} {x}" for place, x in HELD.items()]
    script += [f"put {place} 0" for place in range(FREE, p.free)] + [f"go {image.entries[0].key}"]
    script += [f"get {place}" for row in places.values() for place in row] + [f"get {end}"]
    at_once, earlier = _played(image, script, tmp_path)
    for name, row in places.items():
        early, there, later = (at_once[k] for k in row)
        assert there == later != 0, name
        assert early != later, name
    assert at_once[places["word"][0]] == ~0  # the word was 0, and what it was not is given
    assert at_once[places["word"][2]] == HELD[X]
    assert at_once[places["index"][2]] == HELD[ROW + 2]
    assert at_once[end] == HELD[Y]
    assert earlier != at_once


def _played(image, script, folder):
    """What lies at each place that the script asks for: when the host may read it, and a cycle earlier."""
    for name, text in texts(image).items():
        text = text.replace(f"k < {READ_DEEP};", 'k < atoi(getenv("CYCLES"));')
        put(folder / name, text.replace("<cstdio>", "<cstdio>\n#include <cstdlib>"))
    put(folder / "script", "\n".join(script) + "\n")
    name = image.pipeline.name
    simulation.made(folder, f"obj/V{name}")
    read = READ_DEEP if image.lanes.deep else READ
    found = []
    for cycles in (read, read - 1):
        run, given = [f"obj/V{name}", "script"], os.environ | {"CYCLES": str(cycles)}
        done = subprocess.run(run, cwd=folder, env=given, capture_output=True, text=True, check=True)
        got = [int(line) for line in done.stdout.splitlines() if not line.startswith("cycles")]
        asked_for = [int(line.split()[1]) for line in script if line.startswith("get")]
        found.append(dict(zip(asked_for, got, strict=True)))
    return found
