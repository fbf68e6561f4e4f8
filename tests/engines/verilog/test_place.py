"""Place and route: a machine becomes a routed FPGA, with figures that are nextpnr's."""

from __future__ import annotations

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
