"""The files that `lower --target c` writes: strict flags, sanitizers, hostile names, replay, a small
processor.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import (
    MissingDependencyError,
    OutputError,
    Scalar,
    Stream,
    delay,
    graph,
    lower,
    merge,
    simulate,
)
from flowgraph.blocks.datasets import euroc
from flowgraph.cli.app import app
from flowgraph.cli.options import case_of
from flowgraph.engines.c import CompileError, build, generate, write_c, write_events
from flowgraph.engines.c.syntax import comment, identifier, string, unique
from flowgraph.graphs.ins_eskf import ins_eskf
from tests.support import scalars

STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic")


def compiled(folder: Path, name: str, *flags: str) -> Path:
    """The replay program of a folder."""
    done = subprocess.run(
        ["cc", *flags, "-o", "replay", "main.c", f"{name}.c", "-lm"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[:2000]
    return folder / "replay"


def replayed(program: Path, events: Path, *, seed: int = 0) -> dict[str, list[list[float]]]:
    """Rows of each output that the program prints: time and numbers."""
    done = subprocess.run([program, events, str(seed)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:2000]
    found: dict[str, list[list[float]]] = {}
    for line in done.stdout.splitlines():
        time, name, *numbers = line.split(",")
        found.setdefault(name, []).append([float(time), *map(float, numbers)])
    return found


def check_replay(result: Any, rows: dict[str, list[list[float]]], *, atol: float = 0.0) -> None:
    """What was printed is what a run gave."""
    assert {n for n in result.series if len(result[n])} == set(rows)
    for name, printed in rows.items():
        series, table = result[name], np.array(printed)
        np.testing.assert_array_equal(table[:, 0], series.time)
        flat = np.concatenate([a.reshape(len(series), -1) for a in series.leaves.values()], axis=1)
        bound = 1e-9 * np.maximum(1.0, np.abs(flat)) + atol
        assert (np.abs(table[:, 1:] - flat) <= bound).all(), name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["async_kalman", "rbpf_indoor", "ins_eskf"])
def test_a_process_of_its_own_prints_what_python_computes(name, tmp_path):
    """Strict flags; and the address and undefined-behaviour sanitizers find nothing."""
    settings = ["duration=0.6"] + (["particles=40"] if name == "rbpf_indoor" else [])
    case, _ = case_of(name, "sim", settings, 0)
    pipeline = lower(case.graph)
    write_c(pipeline, tmp_path)
    write_events(pipeline, case.inputs, tmp_path / "events.csv")
    sanitize = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    program = compiled(tmp_path, name, *STRICT, *sanitize)
    check_replay(simulate(case.graph, case.inputs), replayed(program, tmp_path / "events.csv"))


def test_a_folder_builds_by_its_makefile(tmp_path):
    case, _ = case_of("kalman", "sim", ["duration=0.5"], 0)
    write_c(lower(case.graph), tmp_path)
    write_events(lower(case.graph), case.inputs, tmp_path / "events.csv")
    done = subprocess.run(["make", "-s"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    check_replay(simulate(case.graph, case.inputs), replayed(tmp_path / "replay", tmp_path / "events.csv"))


def test_no_heap_no_library_but_math(tmp_path):
    files = write_c(lower(case_of("rbpf_indoor", "sim", ["particles=20"], 0)[0].graph), tmp_path)
    text = files["rbpf_indoor.c"].read_text() + files["rbpf_indoor.h"].read_text()
    included = set(re.findall(r"#include [<\"]([^>\"]+)", text))
    assert included == {"rbpf_indoor.h", "math.h", "stddef.h", "stdbool.h", "stdint.h"}
    assert not re.search(r"\b(malloc|calloc|realloc|free|alloca|printf)\b", text)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rbpf_indoor", "ins_eskf", "ins_particle"])
def test_single_precision_computes_nothing_in_double(name):
    """A double among floats makes a compiler convert to and fro, and give a loop up."""
    data, settings = ("course", ["particles=40"]) if name == "ins_particle" else ("sim", [])
    made = generate(lower(case_of(name, data, settings, 0)[0].graph), "float32")
    text = re.sub(r"/\*.*?\*/", "", made.source + made.header, flags=re.DOTALL)
    assert "float" in text
    assert not re.search(r"\bdouble\b", text)
    number = r"(?<![\w.])(?:\d+\.\d*|\.\d+|\d+(?=[eE]))(?:[eE][+-]?\d+)?"
    assert not [n for n in re.findall(number + r"(?![\w.])", text)]
    functions = "exp log sin cos tan asin acos atan atan2 sqrt fabs floor ceil rint fmod copysign pow hypot"
    assert not re.findall(rf"\b(?:{functions.replace(' ', '|')})\(", text)


def test_loops_over_particles_call_no_function_of_math():
    """What a loop calls is written out, in both precisions: a call keeps it from being vectorised."""
    pipeline = lower(case_of("rbpf_indoor", "sim", ["particles=40"], 0)[0].graph)
    for dtype in ("float64", "float32"):
        loops = re.findall(r"i0 < 40; i0\+\+\) \{(.*?)\n    \}", generate(pipeline, dtype).source, re.DOTALL)
        assert any("fg_exp(" in text for text in loops)
        assert not [text for text in loops if re.search(r"\b(?:exp|log|sin|cos|atan2)f?\(", text)]


def test_the_header_says_units_frames_and_shapes(tmp_path):
    files = write_c(lower(case_of("ins_eskf", "sim", None, 0)[0].graph), tmp_path)
    text = files["ins_eskf.h"].read_text()
    for line in (
        "double gyro[3]; /* rad/s, body */",
        "void ins_eskf_reset(ins_eskf_state *s, uint64_t seed);",
    ):
        assert line in text
    assert "15 x 15" in text
    assert "input 0: imu, a Imu" in text


# -- what a user calls things -----------------------------------------------------------------------

HOSTILE = (
    "*/ int x; /*",
    "a\nb",
    "line\\",
    "??/",
    "??)",
    'quote"; system("x"); //',
    "int",
    "return",
    "fg_exp",
    "9lives",
    "größe",
    "a b",
    "a_b",
    "%s%n",
    "\r\n#include <x>",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_texts_cannot_leave_their_place(text):
    assert re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", identifier(text))
    said = comment(text)
    assert not any(bad in said for bad in ("*/", "/*", "\n", "\\", "??"))
    assert re.fullmatch(r'"([^"\\\n?%]|\\[0-7]{3})*"', string(text))
    assert len(set(unique([text, text, text]))) == 3


def test_a_graph_with_hostile_names_is_the_same_graph_in_c(tmp_path):
    from dataclasses import replace

    @graph
    def g(a: Stream[Scalar], b: Stream[Scalar]):
        """*/ #error this must stay a comment ??/
        \\"""
        held = delay(0.5, name="kept")
        made = merge(a, b, tie="left").map(lambda v: 2.0 * v)
        held.feed(made)
        return {"made": made, "held": held.at(a)}

    built = g.build()
    clean = lower(built)
    registers = tuple(replace(r, path=f"{HOSTILE[k]}/{r.path}") for k, r in enumerate(clean.registers))
    stages = tuple(
        replace(
            s,
            path=HOSTILE[0],
            instructions=tuple(replace(i, line=HOSTILE[k % 15]) for k, i in enumerate(s.instructions)),
        )
        for s in clean.stages
    )
    inputs = tuple(
        replace(
            p,
            name=n,
            type=HOSTILE[0],
            leaves=tuple(replace(x, unit=HOSTILE[1], frame=HOSTILE[3]) for x in p.leaves),
        )
        for p, n in zip(clean.inputs, (HOSTILE[5], HOSTILE[14]), strict=True)
    )
    outputs = tuple(
        replace(p, name=n, clock="*/") for p, n in zip(clean.outputs, ("int", "%s%n"), strict=True)
    )
    dirty = replace(
        clean,
        name=HOSTILE[0],
        registers=registers,
        stages=stages,
        inputs=inputs,
        outputs=outputs,
        doc="*/ #error\n??/",
    )
    data = {"a": scalars([0, 10, 20], [1.0, 2.0, 3.0]), "b": scalars([5, 10], [7.0, 8.0])}
    wanted = simulate(built, data)
    given = dict(zip((p.name for p in inputs), data.values(), strict=True))
    got = dirty.run(given, engine="c")
    assert got["int"].value.tolist() == wanted.made.value.tolist()
    files = write_c(dirty, tmp_path)
    write_events(dirty, given, tmp_path / "events.csv")
    (source,) = [n for n in files if n.endswith(".c") and n != "main.c"]
    rows = replayed(compiled(tmp_path, source[:-2], *STRICT), tmp_path / "events.csv")
    assert [r[1] for r in rows["int"]] == wanted.made.value.tolist()


# -- what can go wrong ------------------------------------------------------------------------------


def test_without_a_compiler_it_says_what_to_install(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")

    @graph
    def g(x: Stream[Scalar]):
        return x.map(lambda v: 3.0 * v)

    with pytest.raises(MissingDependencyError, match="the C engine needs a C compiler") as error:
        simulate(g.build(), {"x": scalars([0, 1])}, engine="c")
    assert error.value.got == "no no-such-compiler"
    assert "install gcc or clang" in str(error.value)


def test_what_the_compiler_refuses_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path))
    with pytest.raises(CompileError, match="refuses the generated code") as error:
        build({"a.c": "int f(void) { return missing; }\n"})
    assert "missing" in str(error.value.got)
    assert "error" in str(error.value.got)
    assert not list(tmp_path.iterdir()), "nothing is left behind"


def test_a_library_is_compiled_once(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path))
    text = {"a.c": "int f(void) { return 3; }\n"}
    first = build(text)
    stamp = first.stat().st_mtime_ns
    assert build(text) == first
    assert first.stat().st_mtime_ns == stamp
    assert build(text, ("-O0",)) != first


def test_another_filters_files_are_not_overwritten(tmp_path):
    @graph
    def g(x: Stream[Scalar]):
        return x.map(lambda v: 3.0 * v)

    write_c(lower(g.build()), tmp_path)
    write_c(lower(g.build()), tmp_path)
    (tmp_path / "main.c").write_text("mine")
    with pytest.raises(OutputError, match="another file is already here"):
        write_c(lower(g.build()), tmp_path)
    assert (tmp_path / "main.c").read_text() == "mine"


def test_the_replay_refuses_what_it_cannot_read(tmp_path):
    @graph
    def g(x: Stream[Scalar]):
        return x.map(lambda v: 3.0 * v)

    write_c(lower(g.build()), tmp_path)
    program = compiled(tmp_path, "g", *STRICT)
    for text, said in (
        ("0,y,1\n", "no input is called y"),
        ("0,x\n", "too few numbers"),
        ("5,x,1\n4,x,1\n", "backwards"),
    ):
        (tmp_path / "e.csv").write_text(text)
        done = subprocess.run([program, tmp_path / "e.csv"], capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert said in done.stderr


def test_the_command_writes_c_and_its_events(tmp_path):
    folder, events = tmp_path / "out", tmp_path / "events.csv"
    words = [
        "lower",
        "kalman",
        "--set",
        "duration=0.2",
        "--target",
        "c",
        "-o",
        str(folder),
        "--events",
        str(events),
    ]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert {f.name for f in folder.iterdir()} >= {
        "kalman.h",
        "kalman.c",
        "main.c",
        "Makefile",
        "pipeline.json",
    }
    assert events.read_text().count("\n") > 10


@pytest.mark.parametrize(("option", "value"), [("--target", "d"), ("--dtype", "float16")])
def test_an_unknown_target_is_refused(tmp_path, option, value):
    done = CliRunner().invoke(app, ["lower", "kalman", "-o", str(tmp_path / "out"), option, value])
    assert done.exit_code == 2
    assert f"no {option[2:]} is called {value!r}" in done.stderr
    assert not (tmp_path / "out").exists()


# -- small processors -------------------------------------------------------------------------------

CORTEX = ["-std=c99", "-Os", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]


def test_ins_eskf_fits_a_cortex_m4f(tmp_path, record_property):
    """In float, without one operation in double: that processor has none."""
    if shutil.which("arm-none-eabi-gcc") is None:
        pytest.skip("arm-none-eabi-gcc is not installed")
    write_c(lower(case_of("ins_eskf", "sim", None, 0)[0].graph), tmp_path, "float32")
    strict = ["-Wall", "-Wextra", "-Werror", "-Wdouble-promotion"]
    text = '#include "ins_eskf.h"\nins_eskf_state state;\n'
    (tmp_path / "ram.c").write_text(text)
    for name in ("ins_eskf.c", "ram.c"):
        done = subprocess.run(
            ["arm-none-eabi-gcc", *CORTEX, *strict, "-c", name],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[:2000]
    flash, ram = (section(tmp_path / f, k) for f, k in (("ins_eskf.o", 0), ("ram.o", 2)))
    record_property("flash_bytes", flash)
    record_property("ram_bytes", ram)
    print(f"ins_eskf in float on a Cortex-M4F: {flash} B of flash, {ram} B of state")
    assert flash < 128 * 1024
    assert ram < 32 * 1024


def section(file: Path, k: int) -> int:
    done = subprocess.run(["arm-none-eabi-size", file], capture_output=True, text=True, check=True)
    return int(done.stdout.splitlines()[1].split()[k])


# -- a whole flight ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_ins_eskf_on_mh_01_as_a_process_of_its_own(tmp_path):
    data = Path(os.environ.get("FLOWGRAPH_DATA", Path(__file__).parents[4] / "shared" / "datasets"))
    sequence = data / "euroc" / "MH_01_easy"
    if not sequence.is_dir():
        pytest.skip("needs EuRoC MH_01_easy: set FLOWGRAPH_DATA to the folder that holds euroc/")
    case = ins_eskf.case(euroc.load(str(sequence), settings={"leica.time_offset": "-0.135"}))
    pipeline = lower(case.graph)
    write_c(pipeline, tmp_path)
    assert write_events(pipeline, case.inputs, tmp_path / "events.csv") > 10_000
    program = compiled(tmp_path, "ins_eskf", *STRICT)
    check_replay(simulate(case.graph, case.inputs), replayed(program, tmp_path / "events.csv"))


def test_generated_c_is_the_same_each_time():
    pipeline = lower(case_of("ekf", "sim", None, 0)[0].graph)
    assert generate(pipeline) == generate(pipeline)
