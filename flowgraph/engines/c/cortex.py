"""Generated C on a Cortex-M: built by arm-none-eabi-gcc, run in qemu-system-arm, its instructions counted.

A program runs on an emulated board (Arm's MPS2 with a Cortex-M4 or M7). It reads its events and prints its
outputs through the debugger's calls (semihosting), so the program is the very one that replays on the host.
Calls of the filter go through a meter. Each instruction takes one step of virtual time (`-icount`), which the
system timer tells; a stretch of 1,500 known instructions says what its steps are. So counts are good to two.
They are of instructions: how many cycles a core takes for them, with its memories and its pipeline, no
emulator says. The stack below a call is painted before and looked at behind.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowgraph.data.files import put
from flowgraph.errors import FlowgraphError, MissingDependencyError

COMPILER, SIZES, EMULATOR = "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm"

FLAGS = ("-mthumb", "-mfloat-abi=hard", "-std=gnu99", "-Os", "-ffp-contract=off", "-DFLOWGRAPH_OWN_MATH",
         "-DFLOWGRAPH_PLAIN_NAMES", "-ffunction-sections", "-fdata-sections")  # fmt: skip
"""What everything is compiled with: small, and with the host's arithmetic, operation for operation."""


@dataclass(frozen=True)
class Core:
    """A core that code is made for, and the board of the emulator that has it."""

    flags: tuple[str, ...]
    board: str


CORES: Mapping[str, Core] = {
    "cortex-m4f": Core(("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"), "mps2-an386"),
    "cortex-m7": Core(("-mcpu=cortex-m7", "-mfpu=fpv5-d16"), "mps2-an500"),
}


def missing() -> list[str]:
    """The programs that this machine lacks."""
    return [tool for tool in (COMPILER, SIZES, EMULATOR) if shutil.which(tool) is None]


def need_tools() -> None:
    """Refuse where a program is missing.

    Raises:
        MissingDependencyError: naming it.
    """
    lacking = missing()
    if lacking:
        raise MissingDependencyError(
            "code for a microcontroller needs a cross compiler and an emulator",
            path=lacking[0],
            expected=f"{COMPILER} with newlib, and {EMULATOR}",
            got=f"no {', '.join(lacking)}",
            fix="apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm",
        )


@dataclass(frozen=True)
class Metered:
    """A function whose calls are counted.

    Args:
        head: how it is declared, such as "uint64_t react(state *s, int64_t time)".
        name: of the function.
        arguments: the names of its arguments.
        pattern: the expression of the pattern of present inputs, in its arguments.
        last: whether a tick ends with it: of several functions of a tick, the last.
    """

    head: str
    name: str
    arguments: tuple[str, ...]
    pattern: str
    last: bool = True


def meter_text(headers: Sequence[str], functions: Sequence[Metered], ram: str) -> str:
    """The C of the meter: `ram` is the expression of the bytes that a program keeps for the filter."""
    wraps = []
    for f in functions:
        kind, rest = f.head.split(f.name, 1)
        text = _WRAP.replace("REAL", f"{kind}__real_{f.name}{rest}")
        text = text.replace("WRAPPED", f"{kind}__wrap_{f.name}{rest}").replace("KIND ", kind)
        text = text.replace("CALL", f"__real_{f.name}({', '.join(f.arguments)})")
        wraps.append(text.replace("PATTERN", f.pattern).replace("LAST", str(int(f.last))))
    includes = "\n".join(f'#include "{h}"' for h in headers)
    return (
        f"{includes}\n#include <stdint.h>\n#include <stdio.h>\n#define RAM ({ram})\n{_METER}\n"
        + "\n".join(wraps)
    )


_WRAP = """REAL;
WRAPPED;
WRAPPED
{
    meter_paint();
    const uint32_t begun = *meter_value;
    KIND made = CALL;
    const uint32_t ended = *meter_value;
    meter_told((unsigned)(PATTERN) & 255u, begun - ended, LAST);
    return made;
}
"""

_METER = r"""
/* the system timer counts down, 24 bits */
static volatile uint32_t *const meter_control = (volatile uint32_t *)0xE000E010u;
static volatile uint32_t *const meter_reload = (volatile uint32_t *)0xE000E014u;
static volatile uint32_t *const meter_value = (volatile uint32_t *)0xE000E018u;
enum { PAINTED = 32768, PAINT = 0x5AA55AA5, BELOW = 16 };
static uint64_t meter_spent[256], meter_calls[256];
static uint32_t meter_deepest, meter_empty, meter_known, meter_wrong;

static inline __attribute__((always_inline)) uint32_t *meter_top(void)
{
    uint32_t *sp;
    __asm volatile("mov %0, sp" : "=r"(sp));
    return sp - BELOW;
}

static inline __attribute__((always_inline)) void meter_paint(void)
{
    volatile uint32_t *at = meter_top();
    for (int k = 0; k < PAINTED / 4; ++k) *--at = PAINT;
}

static inline __attribute__((always_inline)) void meter_told(unsigned key, uint32_t steps, int last)
{
    const volatile uint32_t *const at = meter_top();
    uint32_t depth = PAINTED / 4;
    while (depth > 0 && at[-(int)depth] == PAINT) --depth;
    if (4u * (depth + BELOW) > meter_deepest) meter_deepest = 4u * (depth + BELOW);
    if ((*meter_control >> 16 & 1u) != 0) ++meter_wrong; /* it went through zero: more than it can count */
    meter_spent[key] += (steps - meter_empty) & 0xFFFFFFu;
    meter_calls[key] += (uint64_t)last;
    *meter_value = 0;
    (void)*meter_control;
}

static __attribute__((constructor)) void meter_begin(void)
{
    *meter_reload = 0xFFFFFFu;
    *meter_value = 0;
    *meter_control = 5u;
    (void)*meter_control;
    uint32_t begun = *meter_value, ended = *meter_value;
    meter_empty = begun - ended;
    begun = *meter_value;
    __asm volatile(".rept 1500\n nop\n .endr");
    ended = *meter_value;
    meter_known = begun - ended - meter_empty;
    *meter_value = 0;
    (void)*meter_control;
}

static __attribute__((destructor)) void meter_end(void)
{
    const char *before = "";
    FILE *file = fopen("measured.json", "w");
    if (file == NULL) return;
    fprintf(file, "{\"ram\": %lu, \"stack\": %lu, \"known\": %lu, \"wrong\": %lu, \"patterns\": {",
            (unsigned long)RAM, (unsigned long)meter_deepest, (unsigned long)meter_known,
            (unsigned long)meter_wrong);
    for (int k = 0; k < 256; ++k) {
        if (meter_calls[k] == 0) continue;
        fprintf(file, "%s\"%d\": [%llu, %llu]", before, k, (unsigned long long)meter_calls[k],
                (unsigned long long)(meter_spent[k] * 1500u / meter_known));
        before = ", ";
    }
    fprintf(file, "}}\n");
    fclose(file);
}
"""

_START = r"""#include <stdint.h>
extern void _start(void);
extern uint32_t stack_top;
void reset(void);
void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* the floating-point unit, which is off at first */
    __asm volatile("dsb\n isb");
    _start();
}
static void fault(void)
{
    __asm volatile("movs r0, #0x18\n ldr r1, =0x20023\n bkpt 0xab");
    for (;;) {}
}
__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
    &stack_top, (void *)reset, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault};
"""

_LINK = """MEMORY { code (rx) : ORIGIN = 0, LENGTH = 4M  data (rw) : ORIGIN = 0x20000000, LENGTH = 4M }
SECTIONS {
  .text : { KEEP(*(.vectors)) *(.text*) KEEP(*(.init)) KEEP(*(.fini)) *(.rodata*) . = ALIGN(8);
    __preinit_array_start = .; KEEP(*(.preinit_array)) __preinit_array_end = .;
    __init_array_start = .; KEEP(*(SORT(.init_array.*))) KEEP(*(.init_array)) __init_array_end = .;
    __fini_array_start = .; KEEP(*(SORT(.fini_array.*))) KEEP(*(.fini_array)) __fini_array_end = .; } > code
  .ARM.exidx : { __exidx_start = .; *(.ARM.exidx*) __exidx_end = .; } > code
  .data : ALIGN(8) { *(.data*) } > data
  .bss : ALIGN(8) { __bss_start__ = .; *(.bss*) *(COMMON) . = ALIGN(8); __bss_end__ = .; } > data
  end = .; _end = .; __end__ = .;
  stack_top = ORIGIN(data) + LENGTH(data);
}
"""


@dataclass(frozen=True)
class Measured:
    """What a filter took on a core.

    Args:
        outputs: what the program printed.
        text, data: bytes of the filter's code with its constants, and of its variables.
        flash: the same with what it calls of the compiler and of the library.
        ram: bytes that a program keeps for the filter.
        stack: bytes of the deepest call.
        instructions: by pattern of present inputs, the mean of a tick.
        ticks: by pattern, how many there were.
    """

    outputs: str
    text: int
    data: int
    flash: int
    ram: int
    stack: int
    instructions: Mapping[int, float]
    ticks: Mapping[int, int]


def measure(core: str, folder: Path, filter_file: str, functions: Sequence[Metered], ram: str,
            events: Path, tables: Sequence[str] = ()) -> Measured:  # fmt: skip
    """Build a written filter with its `main.c` for a core, replay events on it, and say what it took.

    Args:
        core: of `CORES`.
        folder: with the filter, its header and `main.c`; what is built stays there.
        filter_file: the name of its C file.
        functions: what is called of it.
        ram: the expression of the bytes that are kept for it.
        events: that `main.c` reads.
        tables: names of constants that a program needs besides the functions.

    Raises:
        MissingDependencyError: where a tool is missing.
        FlowgraphError: where the program does not build or run, with what was said.
    """
    need_tools()
    made, here = CORES[core], folder / core
    here.mkdir(exist_ok=True)
    flags = [*made.flags, *FLAGS, "-I.."]
    header = filter_file[:-2] + ".h"
    for name, body in (
        ("start.c", _START), ("link.ld", _LINK), ("meter.c", meter_text([header], functions, ram)),
    ):  # fmt: skip
        put(here / name, body)
    _do([COMPILER, *flags, "-c", f"../{filter_file}", "-o", "filter.o"], here)
    wraps = [f"-Wl,--wrap={f.name}" for f in functions]
    kept = [f"-Wl,-u,{name}" for name in (*(f.name for f in functions), *tables)]
    whole = ["--specs=rdimon.specs", "-T", "link.ld", *wraps, "start.c", "meter.c", "../main.c", "filter.o"]
    _do([COMPILER, *flags, "-o", "replay.elf", *whole, "-lm"], here)
    alone = ["-nostartfiles", "-Wl,--gc-sections", f"-Wl,-e,{functions[0].name}", *kept]
    _do([COMPILER, *flags, "--specs=nosys.specs", *alone, "-o", "alone.elf", "filter.o", "-lm"], here)
    text, data, bss = _sizes(here, "filter.o")
    code, constant, _ = _sizes(here, "alone.elf")
    measured = here / "measured.json"
    measured.unlink(missing_ok=True)
    told = f"enable=on,target=native,arg=replay,arg={events.resolve()}"
    board = ["-M", made.board, "-nographic", "-monitor", "none", "-serial", "none", "-icount", "shift=6"]
    printed = _do([EMULATOR, *board, "-semihosting-config", told, "-kernel", "replay.elf"], here)
    found: dict[str, Any] = json.loads(measured.read_text())
    if found["wrong"]:
        raise FlowgraphError(
            "a tick takes more instructions than the timer of the board counts",
            path=f"{filter_file} on {core}",
            expected="at most ten million",
            got=f"{found['wrong']} ticks with more",
            fix="measure a smaller filter",
        )
    patterns = {int(k): row for k, row in found["patterns"].items()}
    return Measured(
        printed,
        text,
        data + bss,
        code + constant,
        found["ram"] + data + bss,
        found["stack"],
        {k: spent / calls for k, (calls, spent) in patterns.items()},
        {k: calls for k, (calls, _) in patterns.items()},
    )


def on_host(folder: Path, filter_file: str, events: Path) -> str:
    """What the same files print on this machine, with the same arithmetic.

    Raises:
        FlowgraphError: where they do not build or run.
    """
    compiler = os.environ.get("CC", "cc").split()
    flags = ["-std=c99", "-O1", "-ffp-contract=off", "-DFLOWGRAPH_OWN_MATH", "-DFLOWGRAPH_PLAIN_NAMES"]
    _do([*compiler, *flags, "-o", "on_host", "main.c", filter_file, "-lm"], folder)
    return _do([str(folder.resolve() / "on_host"), str(events.resolve())], folder)


def _sizes(folder: Path, file: str) -> tuple[int, int, int]:
    """Bytes of code with constants, of variables, and of those that begin as zero."""
    text, data, bss = _do([SIZES, file], folder).splitlines()[1].split()[:3]
    return int(text), int(data), int(bss)


def _do(words: Sequence[str], folder: Path) -> str:
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, check=False, errors="replace", timeout=600
    )
    if done.returncode != 0:
        raise FlowgraphError(
            "a program for a microcontroller does not build or run",
            path=words[0],
            expected="an end without errors",
            got=f"status {done.returncode}: {done.stderr.strip()[:600]}",
            fix="see what it says; gcc-arm-none-eabi 12 and qemu 7.2 are known to do",
        )
    return done.stdout
