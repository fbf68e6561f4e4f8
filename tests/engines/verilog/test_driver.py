"""The driver on the simulated machine: numbers go in, and numbers come out that are the interpreter's."""

from __future__ import annotations

import math
import os
import shutil
import subprocess

import numpy as np
import pytest

from flowgraph import Scalar, Stream, block, graph, lower, simulate
from flowgraph.engines.subject import LoweredGraph
from flowgraph.engines.verilog.driver import Driver
from flowgraph.engines.verilog.engine import ENGINE
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.simulate import verilator
from flowgraph.pipeline.format_files import with_formats
from tests.engines.fixed.test_fixed import formats_of, sizes_of
from tests.engines.verilog.test_verilog import everything, flight, need_verilator
from tests.graphs.library import library_case


def built(pipeline, inputs, folder):
    """The driver's program, in a folder with a flight."""
    ENGINE.write(pipeline, folder, "fixed", ())
    ENGINE.write_events(pipeline, inputs, folder / "flight")
    environment = {k: v for k, v in os.environ.items() if k not in ("VERILATOR_ROOT", "MAKEFLAGS", "MFLAGS")}
    for target in ("lint_stream", "host"):
        make = ["make", "-s", target, f"VERILATOR={verilator()}"]
        done = subprocess.run(make, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "warning" not in done.stderr


def played(folder):
    """What the program prints, rows of (time, output, numbers), and what it says."""
    done = subprocess.run(
        ["obj_host/host", "flight.host"], cwd=folder, capture_output=True, text=True, check=True
    )
    rows = [line.split() for line in done.stdout.splitlines()]
    return [(int(t), name, [number(x) for x in row]) for t, name, *row in rows], done.stderr


def number(text):
    return float.fromhex(text) if "x" in text or "n" in text else float(text)


def rows_of(result):
    return {
        name: [
            (int(t), np.concatenate([np.ravel(x[k]).astype(float) for x in series.leaves.values()]).tolist())
            for k, t in enumerate(series.time)
        ]
        for name, series in result.series.items()
    }


def equal(found, result):
    wanted = rows_of(result)
    for name, rows in wanted.items():
        mine = [(t, x) for t, n, x in found if n == name]
        assert [t for t, _ in mine] == [t for t, _ in rows]
        for (_, a), (_, b) in zip(mine, rows, strict=True):
            np.testing.assert_array_equal(a, b)
    return sum(map(len, wanted.values()))


def need():
    need_verilator()
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")


def test_numbers_through_the_driver_are_the_interpreters(tmp_path):
    need()
    graph_ = everything.build()
    formats = sizes_of(graph_, flight()).formats(26, 2.0, 30)
    pipeline = with_formats(LoweredGraph(graph_).pipeline, formats)
    given = flight()
    given["y"] = (given["y"][0], given["y"][1].copy())
    given["y"][1][3] = 1e6  # fits no word: cut, and counted
    built(pipeline, given, tmp_path)
    found, said = played(tmp_path)
    result = simulate(graph_, given, engine="fixed", formats=formats)
    assert equal(found, result) > 80
    counts = dict(line.split() for line in said.splitlines())
    assert int(counts["saturations"]) >= 1
    assert int(counts["cycles"]) > 1000
    # what the machine cannot take is said, and nothing is done
    (tmp_path / "flight.host").write_text("5 2 nan\n6 2 0.25\n7 8\n")
    found, said = played(tmp_path)
    assert [(t, name) for t, name, _ in found] == [(6, "y")]
    assert "at 5 nothing was done: 4000000000000000" in said
    assert "at 7 nothing was done: 8000000000000000" in said


@block(host=True)
def looked_up(x: Scalar) -> Scalar:
    return 2.0 * float(x)


@graph
def calibrated(raw: Stream[Scalar]):
    """A host block before the machine, and one behind it."""
    return (looked_up(raw, name="table") * 0.5).tap(lambda v: None)


def test_the_header_says_what_the_host_part_feeds():
    built = calibrated.build()
    pipeline = lower(built)
    inputs = {"table": (np.arange(5, dtype=np.int64), np.linspace(0.0, 0.5, 5))}
    fixed = with_formats(pipeline, sizes_of(built, {"raw": inputs["table"]}).formats(24, 2.0))
    texts = Driver(Image(fixed, [1])).texts()
    header = texts[f"{fixed.name}_device.h"]
    assert "The input table comes from the host block table (tests.engines.verilog.test_driver:" in header
    assert f"uint64_t {fixed.name}_device_react(" in header


@pytest.mark.slow
def test_a_filter_with_absent_readings_and_covariances_goes_through_the_driver(tmp_path):
    need()
    case = library_case("kalman", 0.5)
    formats = formats_of("kalman", 24)
    built(with_formats(lower(case.graph, dtype="fixed"), formats), case.inputs, tmp_path)
    found, _ = played(tmp_path)
    assert equal(found, simulate(case.graph, case.inputs, engine="fixed", formats=formats)) > 100
    assert any(math.isnan(float(x)) for x in (tmp_path / "flight.host").read_text().split())
