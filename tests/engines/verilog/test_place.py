"""Place and route: a machine becomes a routed FPGA, with figures that are nextpnr's."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
import pytest

from flowgraph import MissingDependencyError, Scalar, Stream, block, delay, graph
from flowgraph.engines.subject import LoweredGraph
from flowgraph.engines.verilog import place
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.text import texts
from flowgraph.pipeline.format_files import with_formats
from tests.engines.fixed.test_fixed import sizes_of


@block
def leak(level: Scalar, inflow: Scalar, *, xp) -> Scalar:
    """A tank that leaks."""
    return 0.9 * level + inflow


@graph
def tank(inflow: Stream[Scalar]):
    """A tank."""
    level = delay(0.0, name="level")
    after = leak(level, inflow)
    level.feed(after)
    return {"level": after}


@pytest.mark.slow
def test_a_machine_is_routed_at_a_hundred_megahertz(tmp_path):
    try:
        place.need_tools()
    except MissingDependencyError as error:
        pytest.skip(str(error.fix))
    built = tank.build()
    inputs = {"inflow": (np.arange(20, dtype=np.int64) * 1_000_000, np.linspace(-1.0, 1.0, 20))}
    pipeline = with_formats(LoweredGraph(built).pipeline, sizes_of(built, inputs).formats(16, 2.0))
    for name, text in texts(Image(pipeline, [1])).items():
        (tmp_path / name).write_text(text)
    found = place.route(tmp_path, "tank")
    assert found.dsp == 4  # the multiplier, and no unit beside
    assert 500 < found.lut < 6000
    assert 500 < found.ff < 4000
    assert 2 <= found.bram < 20
    assert found.fmax_hz is not None
    assert found.fmax_hz > 95e6
    assert (tmp_path / "tank.config").stat().st_size > 1000


@pytest.mark.parametrize(
    ("seeds", "clocks", "tried", "best"),
    [(1, [80.0, 90.0], 1, 80.0), (3, [80.0, 97.0, 90.0], 3, 97.0), (3, [80.0, 101.0, 120.0], 2, 101.0)],
)
def test_the_fastest_of_the_seeds_that_are_tried_is_kept(monkeypatch, tmp_path, seeds, clocks, tried, best):
    """One after the other, until the clock is reached that was asked for."""
    ran = []

    def run(folder, log, arguments):
        if "--seed" not in arguments:
            netlist: dict[str, Any] = {"modules": {"tank": {"cells": {}, "ports": {}}}}
            return (folder / "tank.json").write_text(json.dumps(netlist))
        ran.append(int(arguments[arguments.index("--seed") + 1]))
        clock = clocks[len(ran) - 1]
        report = {"fmax": {"clk": {"achieved": clock}}, "utilization": {}}
        (folder / arguments[arguments.index("--report") + 1]).write_text(json.dumps(report))
        (folder / arguments[arguments.index("--textcfg") + 1]).write_text(f"{clock}")

    monkeypatch.setattr(place, "_run", run)
    monkeypatch.setattr(place, "need_tools", lambda: None)
    assert place.route(tmp_path, "tank", seeds=seeds).fmax_hz == best * 1e6
    assert ran == list(range(1, tried + 1))
    assert (tmp_path / "tank.config").read_text() == f"{best}"
    assert json.loads((tmp_path / "tank_report.json").read_text())["fmax"]["clk"]["achieved"] == best


def block_with(*, outside=(), words=None, first=None, reader=None):
    """A block of which two bits are read at its second port, each with a register behind it, changed."""
    cells: dict[str, Any] = {
        "words": {
            "type": "DP16KD",
            "parameters": {"CLKBMUX": "CLKB", "REGMODE_A": "NOREG", "REGMODE_B": "NOREG"},
            "port_directions": dict.fromkeys(("CLKB", "CEB", "OCEB", "RSTB"), "input")
            | dict.fromkeys(("DOB0", "DOB1", "DOB2"), "output"),
            "connections": {"CLKB": [2], "CEB": ["1"], "OCEB": ["0"], "RSTB": ["0"]}
            | {f"DOB{k}": [10 + k] for k in range(3)},
        }
    }
    for k in range(2):
        cells[f"own{k}"] = {
            "type": "TRELLIS_FF",
            "parameters": {"CEMUX": "1 ", "CLKMUX": "CLK", "LSRMUX": "LSR", "REGSET": "RESET"},
            "port_directions": dict.fromkeys(("CLK", "DI", "M", "LSR", "CE"), "input") | {"Q": "output"},
            "connections": {"CLK": [2], "LSR": ["0"], "DI": [10 + k], "Q": [20 + k]},
        }
    for changed, parts in (("words", words), ("own0", first)):
        for part, values in (parts or {}).items():
            cells[changed][part] |= values
    if reader:
        cells["other"] = {"type": "LUT4", "port_directions": {"A": "input"}, "connections": {"A": [reader]}}
    return {"ports": {"q": {"direction": "output", "bits": [20, 21, *outside]}}, "cells": cells}


def test_registers_behind_a_block_become_its_own():
    module = block_with(reader=20)
    assert place.take_own_registers(module) == 2
    assert sorted(module["cells"]) == ["other", "words"]
    words = module["cells"]["words"]
    assert (words["parameters"]["REGMODE_A"], words["parameters"]["REGMODE_B"]) == ("NOREG", "OUTREG")
    assert words["connections"]["OCEB"] == ["1"]
    assert [words["connections"][f"DOB{k}"] for k in range(3)] == [[20], [21], [12]]


@pytest.mark.parametrize(
    "changes",
    [
        {"outside": [11]},  # a word is seen before its register
        {"reader": 11},
        {"words": {"connections": {"CEB": [7]}}},  # the block does not read in each cycle
        {"words": {"connections": {"RSTB": [7]}}},
        {"words": {"parameters": {"CLKBMUX": "INV"}}},
        {"first": {"connections": {"CLK": [3]}}},  # of another clock
        {"first": {"parameters": {"CLKMUX": "INV"}}},  # or of its other edge
        {"first": {"parameters": {"CEMUX": "CE"}, "connections": {"CE": [4]}}},  # not in each cycle
        {"first": {"parameters": {"REGSET": "SET"}}},  # not 0 at first
        {"first": {"connections": {"LSR": [5]}}},
        {"first": {"parameters": {"LSRMUX": "INV"}}},
        {"first": {"connections": {"M": [10], "DI": [6]}}},
    ],
)
def test_a_register_that_does_more_stays_where_it_is_with_those_beside_it(changes):
    module = block_with(**changes)
    before = copy.deepcopy(module)
    assert place.take_own_registers(module) == 0
    assert module == before


def test_figures_are_those_of_the_report():
    report = {
        "fmax": {"clk": {"achieved": 101.5, "constraint": 100.0}},
        "utilization": {"TRELLIS_COMB": {"used": 7, "available": 9}, "DP16KD": {"used": 3, "available": 9}},
    }
    assert place.figures_of(report) == place.Figures(7, 0, 0, 3, 101.5e6)


def test_without_the_tools_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setattr(place, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match="needs Yosys and nextpnr") as caught:
        place.need_tools()
    assert "hardware" in str(caught.value.fix)
