"""What each pose filter makes of each fault of its sensors, and whether it says so.

A fault that goes unnoticed is the dangerous one. So every cell has a verdict: the error is soon back within
twice its usual value (`recovered`); or the covariance says how large it is (`covered`); or a note or an error
says what happened (`said`); or nothing could have shown it, and the row says why (`undetectable`). What is
none of these is `silent`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowgraph import (
    Case,
    Flight,
    Report,
    Result,
    Series,
    find_graph,
    load_flight,
    simulate,
)
from flowgraph.blocks.metrics import nis_summary
from flowgraph.blocks.metrics.chi_square import chi_square_band
from flowgraph.data.registry import flight_settings
from flowgraph.data.settings import parsed_settings
from flowgraph.errors import FlowgraphError
from flowgraph.graphs.benches import lists
from flowgraph.graphs.benches.fault_kinds import Fault, faults_of
from flowgraph.types import flatten, leaves_of, unflatten

THESIS = "imu,gps,gps2,altimeter,magnetometer,optical_flow"
FLOWN: Mapping[str, tuple[str, dict[str, str]]] = {
    **dict.fromkeys(
        ("ins_eskf", "ekf", "ukf", "kalman", "async_kalman", "augmented_complementary", "complementary",
         "quaternion_ukf", "gyro_integration", "roll_pitch", "ins_ekf_pose", "ins_ukf_pose"),
        ("sim", {"imu.rate": "100"}),
    ),
    **dict.fromkeys(("rbpf_indoor", "ins_particle"), ("sim", {"imu.rate": "100", "particles": "100"})),
    "ins_ukf_velocity": ("course", {"velocity_noise": "0.06"}),
    "orientation_complementary": ("sim:hover", {"sensors": "gyro,coordinate_acceleration,thrust"}),
    "attitude_mekf": ("sim:roundtrip", {"sensors": "body_rate,magnetic_attitude"}),
    "marg": ("sim:roundtrip", {"sensors": "imu,magnetometer"}),
    "outdoor_eskf": ("sim:roundtrip", {"sensors": THESIS, "gyro.bias": "0"}),
    "rbpf_outdoor": ("sim:roundtrip", {"sensors": THESIS, "gyro.bias": "0", "particles": "100"}),
    "gnss_ins": (
        "sim:drive",
        {"sensors": "gps,gps_velocity,magnetometer,barometer", "gps.rate": "4", "compass_noise": "0.025",
         "height_noise": "0.3"},
    ),
}  # fmt: skip
"""The flight of each filter of a pose or an attitude, and settings of both."""

BEGINS, AFTER, WINDOW = 3.0, 8.0, 0.5
"""s after the first reading at which a fault begins, from its end to that of the flight (twice that where it
goes on), and of a window."""

SOON, TWICE = 4.0, 2.0
"""s within which an error is to be back, and within how many times its usual value."""

GATE = 0.999
_KEYS = ("position_rmse_m", "attitude_rmse_deg", "total_rmse_deg", "tilt_rmse_deg")
_FIGURES = re.compile(r"[-+]?\d[\d.e+-]*")
_SAYS = ("warning: ", "bridged: ", "refused: ", "counted: ", "skipped: ", "diverged: ")


def faults(*, graphs: str = "all", kinds: str = "all", seed: int = 0, engine: str | None = None) -> Report:
    """Each fault of each sensor on every pose filter, gates on and off: recovered, covered, said, or silent.

    Args:
        graphs: names, with commas between; all if left out.
        kinds: words with which the names of faults begin, with commas between, such as "dropout,late".
        seed: of the flights.
        engine: that flies them; if left out C for clouds, and Python for all else, since a flight is short.

    Raises:
        UnknownNameError: for a graph that is none of those that are flown here.
    """
    chosen = lists.names(graphs, FLOWN, what="graph of this bench", path="faults.graphs")
    wanted = ("",) if kinds == "all" else tuple(lists.parts(kinds))
    rows = [row for name in chosen for row in _rows(name, wanted, seed, engine or _quick(name))]
    counts = {v: sum(r["verdict"] == v for r in rows) for v in dict.fromkeys(r["verdict"] for r in rows)}
    return Report(rows, notes=("info: " + ", ".join(f"{n} {v}" for v, n in sorted(counts.items())),))


def _quick(name: str) -> str:
    return "c" if "particles" in FLOWN[name][1] else "python"


@dataclass(frozen=True)
class Flown:
    """A run: its case, result and notes, by which its windows are scored."""

    case: Case
    result: Result
    notes: tuple[str, ...]

    def figures(self, first: float, last: float) -> dict[str, float]:
        """The errors of the ticks from the first second after the start on, before the last."""
        begun = int(self.result[self.case.estimate].time[0])
        low, high = begun + round(first * 1e9), begun + round(last * 1e9)
        parts = {n: s[(s.time >= low) & (s.time < high)] for n, s in self.result.series.items()}
        there = len(parts[self.case.estimate]) > 0
        return self.case.score(replace(self.result, series=parts)) if there else {}

    def error(self, first: float, last: float) -> float:
        """The error in this window; infinite where there is none."""
        found = self.figures(first, last)
        return next((found[k] for k in _KEYS if k in found), np.inf)

    @property
    def weighs(self) -> bool:
        """Whether the filter has innovations whose size it expects."""
        return bool(self.innovations)

    @property
    def innovations(self) -> dict[str, Series]:
        """Those that it expects to be of some size, by the name of their stream."""
        return {n: s for n, s in self.result.series.items() if "nis" in s.leaves}

    def surprise(self, first: float, last: float) -> float | None:
        """The largest NIS a number of a stream in a window; None where one is beyond its 95 % band."""
        begun, largest = int(self.result[self.case.estimate].time[0]), 0.0
        for series in self.innovations.values():
            there = (series.time >= begun + round(first * 1e9)) & (series.time < begun + round(last * 1e9))
            if there.any():
                found = nis_summary(series[there])
                if found["nis_mean"] > found["nis_high"]:
                    return None
                largest = max(largest, found["nis_mean"])
        return largest

    def sees_what(self, other: Flown) -> bool:
        """Whether its innovations are those of another run, but for rounding."""
        mine, its = self.innovations, other.innovations
        return mine.keys() == its.keys() and all(
            len(s) == len(its[n]) and np.allclose(s["residual"], its[n]["residual"], rtol=1e-6, atol=1e-9)
            for n, s in mine.items()
        )


def _rows(name: str, wanted: tuple[str, ...], seed: int, engine: str) -> Iterator[dict[str, Any]]:
    prepare = find_graph(name).prepare
    assert prepare is not None
    own = prepare.__annotations__
    for gate in (None, GATE) if "gate" in own else (None,):
        flights: dict[float, Flight] = {}
        usual: dict[float, Flown] = {}
        for fault in faults_of(_flight(name, 4.0, seed)[0]):
            if not fault.name.startswith(wanted) or (
                "start_heading" in fault.settings and "start_heading" not in own
            ):
                continue
            lasts = _duration(fault)
            if lasts not in flights:
                flights[lasts] = _flight(name, lasts, seed)[0]
                flown = _fly(name, flights[lasts], None, gate, seed, engine)
                assert flown is not None
                usual[lasts] = flown
            row: dict[str, Any] = {
                "graph": name,
                "fault": fault.name,
                "gate": "off" if gate is None else f"{gate:g}",
            }
            try:
                found = _fly(name, flights[lasts], fault, gate, seed, engine)
            except FlowgraphError as error:
                yield {**row, "verdict": "said", "factor": None, "recovery_s": None, "nees_mean": None,
                       "dimension": None, "why": " ".join(str(error.message).split())}  # fmt: skip
                continue
            if found is not None:
                yield {**row, **_verdict(fault, found, usual[lasts])}


def _duration(fault: Fault) -> float:
    return BEGINS + fault.lasts + AFTER * (1.0 if fault.lasts else 2.0)


def _flight(name: str, duration: float, seed: int) -> tuple[Flight, dict[str, Any]]:
    data, settings = FLOWN[name]
    prepare = find_graph(name).prepare
    assert prepare is not None
    mine, rest = parsed_settings(
        prepare, {**settings, "duration": f"{duration:g}"}, also=flight_settings(data), path=name
    )
    return load_flight(data, seed=seed, settings=rest), mine


def _fly(
    name: str, flight: Flight, fault: Fault | None, gate: float | None, seed: int, engine: str
) -> Flown | None:
    more: dict[str, Any] = {} if gate is None else {"gate": gate}
    _, mine = _flight(name, 4.0, seed)
    made = flight if fault is None else fault.make(flight, BEGINS)
    if fault is not None and "start_heading" in fault.settings:
        more["start_heading"] = _first_heading(flight) + 0.5 * np.pi
    case = find_graph(name).case(made, settle=0.0, **mine, **more)
    init = None
    if fault is not None and "singular" in fault.settings:
        init = _singular(case)
        if init is None:
            return None
    result = simulate(case.graph, case.inputs, init=init, diverged="count", seed=seed, engine=engine)
    return Flown(case, result, case.remarks(result))


def _first_heading(flight: Flight) -> float:
    assert flight.truth is not None
    w, x, y, z = flight.truth["attitude"][0]
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2)))


def _singular(case: Case) -> dict[str, Any] | None:
    """Initial values of the beliefs with a covariance of zeros; None where there is none."""
    found = {}
    for _, node in case.graph.registers:
        names = [name for name, _ in leaves_of(node.type)]
        if "covariance" in names and node.role not in ("join", "stamp"):
            leaves = zip(names, flatten(node.initial, node.type), strict=True)
            made = [np.zeros_like(leaf) if n == "covariance" else leaf for n, leaf in leaves]
            found[node.path] = unflatten(node.type, iter(made))
    return found or None


def _verdict(fault: Fault, found: Flown, usual: Flown) -> dict[str, Any]:
    """What became of the error, and whether anybody is told."""
    hour = 3600.0 if fault.name.startswith("time jumps") else 0.0
    begins = 0.0 if fault.settings else BEGINS
    ends, last = begins + fault.lasts + hour, _duration(fault) + hour
    right = usual.error(begins, last - hour)
    back: float | None = None
    for first in np.arange(ends, last - WINDOW, WINDOW).tolist():
        allowed = TWICE * max(right, usual.error(first - hour, first - hour + WINDOW))
        if found.error(first, first + WINDOW) <= allowed:
            back = first - ends if back is None else back
        else:
            back = None
    worst = found.error(begins, last) / right
    figures = found.figures(begins, last)
    nees, dimension = figures.get("nees_mean"), _dimension(figures)
    known = {_FIGURES.sub("", n) for n in usual.notes}
    new = [n for n in found.notes if n.startswith(_SAYS) and _FIGURES.sub("", n) not in known]
    why = ""
    if back is not None and back <= SOON:
        verdict = "recovered"
    elif nees is not None and dimension is not None and nees <= TWICE * dimension:
        verdict = "covered"
    elif new:
        verdict, why = "said", new[0]
    elif not found.weighs:
        verdict, why = "undetectable", "it expects no size of what it corrects by"
    elif found.sees_what(usual):
        verdict, why = "undetectable", "no reading depends on it: its innovations are those without the fault"
    elif (largest := found.surprise(begins, last)) is not None:
        verdict = "undetectable"
        why = f"its innovations are no larger than an honest filter's: a NIS of {largest:.2f} a number"
    else:
        verdict = "silent"
    return {
        "verdict": verdict, "factor": float(worst) if np.isfinite(worst) else None, "recovery_s": back,
        "nees_mean": nees if nees is None or np.isfinite(nees) else None, "dimension": dimension, "why": why,
    }  # fmt: skip


def _dimension(figures: Mapping[str, float]) -> int | None:
    """How many numbers the NEES is of, told from its band."""
    low = figures.get("nees_low")
    return None if low is None else next((k for k in range(1, 31) if chi_square_band(k)[0] == low), None)
