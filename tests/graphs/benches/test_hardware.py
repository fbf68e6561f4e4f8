"""The bench of hardware: what it compares, what it weighs, and the front of its machines."""

from __future__ import annotations

from typing import Any

import pytest

from flowgraph import DeclarationError, MissingDependencyError, UnknownNameError
from flowgraph.engines.hls.engine import ENGINE as HLS
from flowgraph.engines.verilog import place
from flowgraph.engines.verilog.image import memories
from flowgraph.engines.verilog.toggles import counted
from flowgraph.graphs.benches.hardware import hardware
from flowgraph.graphs.benches.hardware_space import draw, fronted
from flowgraph.study.differences import RELATIVE
from tests.engines.verilog.test_verilog import need_verilator


def row(width, error, time, lut, lanes=1):
    return {
        "graph": "kalman", "width": width, "lanes": lanes, RELATIVE: error, "us_per_tick": time, "lut": lut,
        "area": "synthesised", "front": False,
    }  # fmt: skip


def test_the_front_is_what_no_other_betters(tmp_path):
    rows = [
        row(16, 1e-2, 20.0, 3000),
        row(24, 1e-4, 20.0, 3900),
        row(20, 1e-2, 21.0, 3100),  # less exact than none, slower and larger than the first
        row(24, 1e-4, 11.0, 5000, lanes=2),
        row(28, None, None, None),  # no machine
    ]
    fronted(rows)
    assert [r["front"] for r in rows] == [True, True, False, True, False]
    draw(rows, tmp_path / "space.png")
    assert (tmp_path / "space.png").stat().st_size > 10_000
    draw(rows[-1:], tmp_path / "none.png")  # a graph without any machine
    assert (tmp_path / "none.png").exists()


def test_settings_that_fit_nothing_are_refused():
    with pytest.raises(DeclarationError, match="the machines of one graph are compared"):
        hardware(space="16,24")
    with pytest.raises(UnknownNameError, match="text to play"):
        hardware(played="vhdl")
    for given in ({"compared": -1.0}, {"compared": 0.0, "energy": True}, {"compared": 0.0, "played": "hls"}):
        with pytest.raises(DeclarationError, match="this plays a part of a flight"):
            hardware(**given)  # type: ignore[arg-type]
    with pytest.raises(DeclarationError, match="needs a whole number as 'seeds'"):
        hardware(seeds=0, routed=True)


def test_a_machine_that_is_not_played_has_its_size():
    (found,) = hardware(graphs="gyro_integration", flights=1, duration=1.0, compared=0.0, bound=1.0).rows
    assert found["values_compared"] is None
    assert found["steps"] >= found["cycles"] > 100
    assert 100 < found["steps_different"] < found["steps"]
    assert found["memories"] == 2 + memories(found["steps"], 31 + 3 * 7 + 1)  # two copies of few words
    assert found["lut"] is None


def test_memories_are_of_three_shapes():
    assert memories(0, 36) == 0
    assert [memories(n, 36) for n in (1, 512, 513, 1024, 1025, 2048, 2049)] == [1, 1, 2, 2, 4, 4, 5]
    assert memories(2048, 56) == 7


def test_toggles_are_the_sum_of_what_verilator_counted():
    lines = [
        "# SystemC::Coverage-3",
        "C 'page\x02v_toggle/a' 12",
        "C 'page\x02v_line/a' 5",
        "C 'v_toggle b' 3",
    ]
    assert counted("\n".join(lines)) == 15


@pytest.mark.slow
def test_a_filter_is_compared_and_weighed():
    need_verilator()
    given: dict[str, Any] = dict(graphs="gyro_integration", flights=1, duration=1.0, compared=0.1, bound=1.0)
    (found,) = hardware(**given, energy=True).rows
    assert found["values_compared"] > 100
    assert found["values_differing"] == 0
    assert 100 < found["energy_estimate_operations"] < found["cycles_all_aids"]
    assert found["energy_estimate_toggles"] > 100_000
    try:
        HLS.need()
    except MissingDependencyError as error:
        pytest.skip(str(error.fix))
    (found,) = hardware(**given, played="hls").rows
    assert found["values_compared"] > 100
    assert found["values_differing"] == 0
    assert found["cycles"] is None


@pytest.mark.slow
def test_a_row_for_each_width_with_what_it_takes():
    try:
        place.need_tools()
    except MissingDependencyError as error:
        pytest.skip(str(error.fix))
    report = hardware(graphs="gyro_integration", flights=1, duration=1.0, space="16,24")
    narrow, wide = report.rows
    assert (narrow["width"], wide["width"]) == (16, 24)
    assert narrow[RELATIVE] > 10 * wide[RELATIVE]
    assert abs(narrow["lut"] - wide["lut"]) < 0.1 * wide["lut"]  # the memory has 36 bits in either
    assert narrow["area"] == "synthesised"
    assert wide["front"]
    assert "space.png" in report.figures
