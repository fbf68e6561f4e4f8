"""C++ for high-level synthesis: every output and register is the integer interpreter's, word for word."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from flowgraph import (
    LoweringError,
    MissingDependencyError,
    Scalar,
    Stream,
    block,
    graph,
    latest,
    simulate,
)
from flowgraph.engines.fixed.files import patterns_with_formats
from flowgraph.engines.hls import play
from flowgraph.engines.hls.arrays import Array
from flowgraph.engines.hls.engine import ENGINE
from flowgraph.engines.hls.play import PlayedHls
from flowgraph.engines.hls.source import HlsSource, _pipelined, _wider, declared
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.graphs.benches.fixed import flown
from flowgraph.graphs.benches.hardware import GRAPHS
from flowgraph.pipeline.format_files import with_formats
from flowgraph.recorder.random import seed_words
from flowgraph.study.differences import RELATIVE
from flowgraph.study.quantise import quantise
from tests.engines.fixed.test_fixed import sizes_of
from tests.engines.verilog.test_verilog import Three, everything, flight


def need_compiler():
    try:
        ENGINE.need()
    except MissingDependencyError as error:
        pytest.skip(str(error.fix))


@pytest.fixture(scope="module")
def made():
    built = everything.build()
    formats = sizes_of(built, flight()).formats(26, 2.0, 30)
    subject = LoweredGraph(built)
    return built, formats, with_formats(subject.pipeline, formats), subject.tape(flight())


def test_operations_are_equal_to_the_interpreter_in_every_register_and_output(made, tmp_path):
    need_compiler()
    built, formats, pipeline, tape = made
    player = PlayedHls(pipeline, tape.patterns, check=True)
    outcome = player.play(tape, LoweredGraph(built).start(RunOptions()).cells, seed_words(0), None)
    assert player.compared > 400
    assert player.differing == 0
    ours = simulate(built, flight(), engine="fixed", formats=formats)
    for (times, leaves), series in zip(outcome.outputs, ours.series.values(), strict=True):
        np.testing.assert_array_equal(times, series.time)
        np.testing.assert_array_equal(leaves[0], series.value)
    # what is written is what was played: the bench compares by itself, and sees a single wrong word
    assert ENGINE.write_events(pipeline, flight(), tmp_path / "script") == len(tape.time)
    ENGINE.write(pipeline, tmp_path, "fixed", ())
    lines = (tmp_path / "script").read_text().splitlines()
    make = ["make", "-s", f"AP_TYPES={play.headers()}", f"CXX={play.compiler()}"]
    subprocess.run(make, cwd=tmp_path, check=True)
    assert _bench(tmp_path) == (0, player.compared, 0)
    (tmp_path / "script").write_text("\n".join([*lines[:-1], f"{lines[-1]}1"]))
    assert _bench(tmp_path) == (1, player.compared, 1)


@pytest.mark.parametrize("every", [0, 3])
def test_held_words_of_more_than_32_bits_are_those_of_the_interpreter(every):
    need_compiler()
    built = everything.build()
    subject = LoweredGraph(built)
    sizes = sizes_of(built, flight())
    wider = dict.fromkeys(sorted(sizes.formats(26).fractions)[::every] if every else (), 31)
    formats = sizes.formats(26, 2.0, 44, wider)
    assert len(formats.by_width()) == 1 + (every > 0)
    pipeline, tape = with_formats(subject.pipeline, formats), subject.tape(flight())
    player = PlayedHls(pipeline, tape.patterns, check=True)
    player.play(tape, LoweredGraph(built).start(RunOptions()).cells, seed_words(0), None)
    assert player.compared > 400
    assert player.differing == 0


def _bench(folder):
    done = subprocess.run(["./replay", "script"], cwd=folder, capture_output=True, text=True, check=False)
    said = dict(line.split() for line in done.stderr.splitlines() if line.startswith("values_"))
    return done.returncode, int(said["values_compared"]), int(said["values_differing"])


def test_the_text_names_values_formats_and_pragmas(made):
    _, _, pipeline, tape = made
    source = HlsSource(pipeline, tape.patterns)
    assert re.search(r"/\* v\d+ = multiply \[3\], fraction [-\d ]+  tests\.engines\.verilog", source.text)
    assert re.search(
        r"ap_int<26> v\d+\[3\];\n#pragma HLS ARRAY_PARTITION variable=v\d+ complete", source.text
    )
    assert "#pragma HLS INTERFACE s_axilite port=present" in source.text
    assert source.text.count("#pragma HLS PIPELINE II=1") > 20
    assert re.search(r"fx_times\(v\d+\w*\[i\d_0\], v\d+\w*\[i\d_0\]\)", source.text)
    assert "// input 0 v" in source.header
    assert source.keys == patterns_with_formats(pipeline)[0]


def test_a_pragma_stands_in_loops_that_have_no_other():
    outer = [
        "  for (int i = 0; i < 3; ++i) {",
        "    for (int j = 0; j < 2; ++j) {",
        "      a;",
        "    }",
        "  }",
    ]
    assert _pipelined(outer).index("#pragma HLS PIPELINE II=1") == 2
    searching = ["  for (int i = 0; i < 3; ++i) {", "    while (low < high) {}", "  }"]
    assert _pipelined(searching) == searching


def test_an_output_has_the_type_that_holds_its_words_in_every_pattern():
    assert _wider(None, "ap_int<24>") == "ap_int<24>"
    assert _wider("ap_int<24>", "ap_int<30>") == "ap_int<30>"
    assert _wider("ap_int<24>", "int64_t") == "int64_t"


@block
def summed(x: Three, *, xp) -> Scalar:
    """Of any three."""
    return xp.sum(x)


@graph
def alike(double: Stream[Three], there: Stream[Scalar]):
    """Names that are words of C++, that are one identifier, and that the text itself has."""
    return {"a.b": summed(double), "a_b": there, "count": latest(there, init=0.0, at=double), "switch": there}


def test_names_of_a_user_are_no_names_of_the_text():
    need_compiler()
    built = alike.build()
    inputs = {"double": flight()["x"], "there": flight()["y"]}
    subject = LoweredGraph(built)
    pipeline = with_formats(subject.pipeline, sizes_of(built, inputs).formats(24, 2.0))
    pipeline = replace(pipeline, name="switch")
    tape = subject.tape(inputs)
    player = PlayedHls(pipeline, tape.patterns, check=True)
    player.play(tape, subject.start(RunOptions()).cells, seed_words(0), None)
    assert player.compared > 100
    assert player.differing == 0


def test_a_large_array_is_a_memory():
    assert declared(Array("v1", "ap_int<24>", 65), "") == ["static ap_int<24> v1[65];"]
    assert declared(Array("v1", "ap_int<24>", 1), "") == ["ap_int<24> v1[1];"]


@block
def turned_(x: Scalar, *, xp) -> Scalar:
    """An operation that fixed point does not have."""
    return xp.tan(x)


@graph
def turning(x: Stream[Scalar]):
    """One block."""
    return {"y": turned_(x)}


def test_an_operation_that_is_not_there_is_named_with_its_line():
    built = turning.build()
    inputs = {"x": (np.arange(5, dtype=np.int64), np.linspace(0.0, 0.5, 5))}
    pipeline = with_formats(LoweredGraph(built).pipeline, sizes_of(built, inputs).formats(24, 2.0))
    with pytest.raises(LoweringError, match="tan has no form in fixed point") as caught:
        HlsSource(pipeline, [1])
    assert str(caught.value.path).startswith("tests.engines.hls.test_hls:")


def test_without_the_headers_or_a_compiler_the_engine_says_what_to_install(made, monkeypatch):
    built, formats, _, _ = made
    monkeypatch.setattr(play, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match="headers of ap_int") as caught:
        simulate(built, flight(), engine="hls", formats=formats)
    assert "flowgraph-filters[hardware]" in str(caught.value.fix)
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "make" else f"/usr/bin/{name}")
    with pytest.raises(MissingDependencyError, match="is compiled here") as caught:
        simulate(built, flight(), engine="hls", formats=formats)
    assert "make none" in str(caught.value.got)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(MissingDependencyError, match="is compiled here") as caught:
        simulate(built, flight(), engine="hls", formats=formats)
    assert "g++" in str(caught.value.expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*GRAPHS.split(","), "rbpf_indoor", "ukf", "async_kalman"])
def test_filters_are_equal_to_the_interpreter(name):
    need_compiler()
    some = [flown(name, k, 1.5, 0) for k in range(2)]
    found = quantise(some[:1], some[1:], width=28, least=28, bounds={RELATIVE: 1.0})
    subject = LoweredGraph(some[1].graph)
    start = subject.start(RunOptions(seed=some[1].seed))
    tape = subject.tape(some[1].inputs, start.last).first(60)
    player = PlayedHls(replace(found.pipeline, formats=found.formats), tape.patterns, check=True)
    player.play(tape, start.cells, seed_words(some[1].seed), None)
    assert player.compared > 1000
    assert player.differing == 0
