"""How many particles are enough: error and time of a particle filter against their number.

Beside each row stands the filter that the particles cannot beat, or hardly: for `particle` the exact Kalman
filter, for the Rao-Blackwellized ones an error-state filter on the same streams.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Case, DeclarationError, Flight, Report, UnknownNameError, simulate
from flowgraph.blocks.flights import simulated
from flowgraph.blocks.metrics.errors import plane_errors
from flowgraph.blocks.models.plane import exact
from flowgraph.graphs.benches import engine_of
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.outdoor_eskf import outdoor_eskf
from flowgraph.graphs.particle import particle
from flowgraph.graphs.rbpf_indoor import rbpf_indoor
from flowgraph.graphs.rbpf_outdoor import rbpf_outdoor
from flowgraph.language.checks import need_count

__all__ = ["FILTERS", "particles"]

OUTDOOR = {"sensors": "imu,gps,gps2,altimeter,magnetometer,optical_flow"}

FILTERS: dict[str, tuple[Any, Any, str, dict[str, Any], dict[str, Any]]] = {
    "particle": (particle, None, "plane", {}, {}),
    "rbpf_indoor": (rbpf_indoor, ins_eskf, "", {}, {"unknown_yaw": False}),
    "rbpf_outdoor": (rbpf_outdoor, outdoor_eskf, "thesis", OUTDOOR, {}),
}
"""The filter, its reference (None: the exact one), the simulated flight, its settings and the filter's."""


def particles(
    *,
    filter: str = "rbpf_indoor",
    least: int = 10,
    most: int = 10_000,
    flights: int = 2,
    duration: float = 5.0,
    engine: str = "auto",
    seed: int = 0,
) -> Report:
    """Error and time of a particle filter against the number of particles, from 10 to 10,000.

    Args:
        filter: rbpf_indoor, rbpf_outdoor or particle.
        least, most: particles; between them three sizes a decade.
        flights: simulated ones, over which the squared errors are averaged.
        duration: of a flight, s.
        engine: "auto" is xla where JAX is installed, else python.
        seed: of the first flight; the next has the next.

    Returns:
        A row a size: `filter`, `particles`, `position_rmse_m`, `attitude_rmse_deg` (None in the plane),
        `reference_position_rmse_m`, `position_ratio`, `effective_part` (the mean effective sample size, as a
        part of the particles), `us_per_tick` (of the engine's loop, without compiling) and `engine`. Figure
        `particles.svg`.

    Raises:
        UnknownNameError: for a filter that is not there; DeclarationError: for a setting out of range.
    """
    if filter not in FILTERS:
        raise UnknownNameError("particle filter", filter, FILTERS, path="particles.filter")
    for name, count in (("least", least), ("most", most), ("flights", flights)):
        need_count("particles", name, count, least=1)
    if least > most:
        raise DeclarationError(
            "there is no size between these",
            path="particles.least",
            expected="least <= most",
            got=f"least={least}, most={most}",
            fix="write least=10 and most=10000",
        )
    engine = engine_of(engine)
    graph, reference, world, settings, extra = FILTERS[filter]
    some = [
        simulated.load(world, seed=seed + k, settings={**settings, "duration": duration})
        for k in range(flights)
    ]
    best = _rms([_reference(reference, flight) for flight in some])
    rows = []
    for n in sizes(least, most):
        scores, seconds, ticks, part = [], 0.0, 0, 0.0
        for k, flight in enumerate(some):
            case: Case = graph.case(flight, particles=n, seed=seed + k, **extra)
            result = simulate(case.graph, case.inputs, engine=engine, seed=seed + k)
            scores.append(case.score(result))
            seconds, ticks = seconds + result.wall_s, ticks + result.ticks
            part += float(np.mean(result["effective_sample_size"]["value"])) / n / flights
        error = _rms([s["position_rmse_m"] for s in scores])
        angle = [s["attitude_rmse_deg"] for s in scores if "attitude_rmse_deg" in s]
        rows.append({
            "filter": filter,
            "particles": n,
            "position_rmse_m": error,
            "attitude_rmse_deg": _rms(angle) if angle else None,
            "reference_position_rmse_m": best,
            "position_ratio": error / best,
            "effective_part": part,
            "us_per_tick": 1e6 * seconds / ticks,
            "engine": engine,
        })  # fmt: skip
    name = "the exact filter" if reference is None else reference.name
    note = f"{flights} flights of {duration:g} s; the reference is {name}"
    return Report(rows, {"particles.svg": lambda path: _draw(rows, name, path)}, (note,))


def sizes(least: int, most: int) -> list[int]:
    """Round numbers from `least` to `most`, three a decade, and both ends."""
    steps = [round(a * 10.0**k) for k in range(10) for a in (1, 2, 5)]
    return sorted({least, most, *(n for n in steps if least < n < most)})


def _reference(graph: Any, flight: Flight) -> float:
    """The position RMSE of the reference on a flight, m."""
    if graph is None:
        assert flight.truth is not None  # simulated
        return plane_errors(exact(flight, spread=1.0), flight.truth)["position_rmse_m"]
    case = graph.case(flight)
    return case.score(simulate(case.graph, case.inputs))["position_rmse_m"]


def _rms(x: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def _draw(rows: list[dict[str, Any]], reference: str, path: Path) -> None:
    from matplotlib.figure import Figure  # a second that only pictures need

    n = [r["particles"] for r in rows]
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.loglog(n, [r["position_rmse_m"] for r in rows], "o-", label=rows[0]["filter"])
    left.axhline(rows[0]["reference_position_rmse_m"], color="black", linestyle="--", label=reference)
    left.set(xlabel="particles", ylabel="position RMSE in m")
    left.legend()
    right.loglog(n, [r["us_per_tick"] for r in rows], "o-")
    right.set(xlabel="particles", ylabel=f"time in µs a tick ({rows[0]['engine']})")
    for axes in (left, right):
        axes.grid(True, which="both", alpha=0.3)
    figure.savefig(path)
