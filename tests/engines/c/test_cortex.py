"""Generated C on an emulated Cortex-M: the same text as on this machine, and counts that are right."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from flowgraph import FlowgraphError, MissingDependencyError, lower
from flowgraph.engines.c import generate, write_c, write_events
from flowgraph.engines.c.cortex import Metered, measure, missing, need_tools, on_host
from flowgraph.engines.c.fixed_replay import write_fixed
from flowgraph.engines.c.header import react_signature
from flowgraph.engines.c.names import given, made
from flowgraph.engines.fixed.files import texts_of
from flowgraph.pipeline.optimise import COMPILED, optimise
from flowgraph.pipeline.plain import plain
from tests.engines.fixed.test_fixed import formats_of
from tests.graphs.library import library_case

needs_tools = pytest.mark.skipif(
    bool(missing()),
    reason="apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm",
)


def _floating(folder, case, dtype):
    pipeline = lower(case.graph, dtype=dtype)
    write_c(pipeline, folder, dtype)
    source = generate(pipeline, dtype, tidy=lambda program: optimise(program, COMPILED))
    m = source.names.module
    arguments = ("s", "time", "present", *given(source.names), *made(source.names))
    return (
        f"{m}.c",
        [Metered(react_signature(source.names), f"{m}_react", arguments, "present")],
        f"sizeof({m}_state)",
    )


def _fixed(folder, case):
    pipeline = replace(plain(lower(case.graph, dtype="fixed")), formats=formats_of("complementary", 28, 0.3))
    write_fixed(pipeline, folder)
    takes, names = "(int32_t *v, int64_t *w, int64_t *count, int key)", ("v", "w", "count", "key")
    both = ("fx_compute", "fx_end")
    metered = [Metered(f"int {f}{takes}", f, names, "key", f == "fx_end") for f in both]
    return f"{pipeline.name}_fixed.c", metered, "FX_SMALL * sizeof(int32_t) + FX_WIDE * sizeof(int64_t)"


@needs_tools
@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "core"), [("float32", "cortex-m4f"), ("float32", "cortex-m7"),
                                             ("float64", "cortex-m7"), ("fixed", "cortex-m4f")])  # fmt: skip
def test_the_text_is_that_of_this_machine(dtype, core, tmp_path):
    case = library_case("complementary", 0.3)
    file, functions, ram = _fixed(tmp_path, case) if dtype == "fixed" else _floating(tmp_path, case, dtype)
    events = tmp_path / "events.csv"
    assert write_events(lower(case.graph), case.inputs, events) > 20
    took = measure(core, tmp_path, file, functions, ram, events)
    assert took.outputs.count("\n") > 20
    assert took.outputs == on_host(tmp_path, file, events)
    assert sum(took.ticks.values()) > 20
    fullest, least = max(took.ticks, key=int.bit_count), min(took.ticks, key=int.bit_count)
    assert took.instructions[fullest] >= took.instructions[least] > 100
    assert took.text > 1_000
    assert took.flash > 1_000
    assert 0 < took.stack < 32_768
    assert took.ram > 0


_FILTER = """#include "known.h"
int known(int many) {{
    volatile char room[{room}];
    room[0] = (char)many;
    __asm volatile(".rept {count}\\n nop\\n .endr");
    return room[0];
}}
"""


def _known(folder, count, room, main="known(1); known(3); known(3);"):
    (folder / "known.h").write_text("#include <stddef.h>\nint known(int many);\n")
    (folder / "known.c").write_text(_FILTER.format(count=count, room=room))
    (folder / "main.c").write_text(f'#include "known.h"\nint main(void) {{ {main} return 0; }}\n')
    metered = Metered("int known(int many)", "known", ("many",), "many")
    return measure("cortex-m4f", folder, "known.c", [metered], "(size_t)7", folder / "none")


@needs_tools
def test_instructions_and_stack_are_those_that_were_written(tmp_path):
    few, many = (_known(tmp_path, count, room) for count, room in ((100, 400), (900, 4000)))
    assert few.ticks == many.ticks == {1: 1, 3: 2}
    assert few.instructions[1] == pytest.approx(few.instructions[3], abs=3)
    assert 100 <= few.instructions[3] < 130
    assert many.instructions[3] - few.instructions[3] == pytest.approx(800, abs=3)
    assert many.stack - few.stack == pytest.approx(3600, abs=16)
    assert few.ram == 7


@needs_tools
def test_a_program_that_fails_on_the_board_is_an_error(tmp_path):
    with pytest.raises(FlowgraphError, match="does not build or run") as failed:
        _known(tmp_path, 1, 8, main="*(volatile int *)0xE0000000u = 1; ((void (*)(void))0xE0000000u)();")
    assert failed.value.path == "qemu-system-arm"


def test_without_the_tools_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda tool: None)
    with pytest.raises(MissingDependencyError, match="a cross compiler and an emulator") as refused:
        need_tools()
    assert "qemu-system-arm" in str(refused.value.fix)
    assert "arm-none-eabi-gcc" in str(refused.value.got)


_HEAD = re.compile(r"^[A-Za-z_][\w *]*?\b(\w+)\([^;{}]*\)\s*\{", re.MULTILINE)


@pytest.mark.parametrize("dtype", ["float32", "fixed"])
def test_a_filter_has_no_heap_no_recursion_and_no_jumps(dtype):
    if dtype == "fixed":
        pipeline = replace(plain(lower(library_case("kalman", 0.5).graph)), formats=formats_of("kalman", 24))
        text = next(t for name, t in texts_of(pipeline)[1].items() if name.endswith(".c"))
    else:
        text = generate(lower(library_case("rbpf_indoor", 0.1).graph), dtype).source
    bare = re.sub(r"#.*", "", re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL))
    starts = list(_HEAD.finditer(bare))
    assert len(starts) > 10
    for k, start in enumerate(starts):
        body = bare[start.end() : starts[k + 1].start() if k + 1 < len(starts) else len(bare)]
        below = {s[1] for s in starts[k:]}
        assert not below & set(re.findall(r"\b(\w+)\(", body)), start[1]
    words = set(re.findall(r"\w+", bare))
    assert not words & {"malloc", "calloc", "realloc", "free", "alloca", "goto", "setjmp", "longjmp"}
    for loop in re.findall(r"\bfor \(([^{]*?;[^{]*?;[^{]*?)\)", bare):
        assert loop.split(";")[1].strip(), "a loop without an end"
    assert all("low < high" in w or "step <=" in w for w in re.findall(r"while \([^)]*\)", bare))
