"""`flowgraph bench drives`: `gnss_ins` on simulated drives, beside the Cramer-Rao bound of each.

A drive has a unit of a stated grade, and positions and velocities by satellites once a second (`sim:drive`).
Over drives of one road, with other noise each, the root mean square errors of position, velocity and attitude
are divided by the bound: the root of the mean trace of the covariance that the filter's own equations have
along the true motion, with exact fixes and biases. No estimate without bias does better, and one as good has
a ratio of 1. A ratio of so many flights has a deviation of its own, that of the mean of their squared errors;
a drive of a minute has few independent errors of its slow attitude, so that twenty say little of it.

All drives of a unit are one graph, compiled once; where a drive starts is a value of its run.

Beside it stands what NaveGo publishes of its own synthetic drive with its own two units, which is another
drive, in north, east and down. The last row is what a tick takes in C, beside one of `ins_eskf`.

Sources: P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear
filtering", IEEE TSP 46(5), 1998 (here the Riccati equation along the truth); R. Gonzalez, J. Giribet,
H. Patino, "NaveGo: a simulation framework for low-cost integrated navigation systems", CEAI 17(2), 2015.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import Graph, Report, Series, load_flight, simulate
from flowgraph.blocks.flights.drive import GRADES
from flowgraph.blocks.geometry.rotations import conjugate, from_rotation_vector, multiply, to_rotation_vector
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.signals import Belief, Position
from flowgraph.graphs.benches import lists
from flowgraph.graphs.gnss_ins import gnss_ins
from flowgraph.graphs.ins_eskf import ins_eskf

PUBLISHED = (
    {
        "unit": "NaveGo, worse unit, its own drive",
        "north_rmse_m": 0.33,
        "east_rmse_m": 0.48,
        "up_rmse_m": 0.44,
        "heading_rmse_deg": 8.9,
    },
    {
        "unit": "NaveGo, better unit, its own drive",
        "north_rmse_m": 0.33,
        "east_rmse_m": 0.48,
        "up_rmse_m": 0.69,
        "heading_rmse_deg": 0.81,
    },
)

_RUNS = 40

FIGURES = {"position_rmse_m": 1.0, "velocity_rmse_mps": 1.0, "attitude_rmse_deg": 180.0 / np.pi}


def drives(
    *, flights: int = 100, units: str = "consumer,tactical", duration: float = 60.0, settle: float = 10.0
) -> Report:
    """Simulated drives: errors of gnss_ins over the Cramer-Rao bound, a row a unit, and NaveGo's on its own
    drive.

    Args:
        flights: how many of each unit.
        units: of consumer, tactical and navigation, comma-separated.
        duration: s, of a drive.
        settle: s at the start that the errors leave out.
    """
    rows: list[dict[str, Any]] = []
    for unit in lists.names(units, GRADES, what="unit", path="drives.units"):
        begin = perf_counter()
        known, bounds, graph = None, None, None
        squares = []
        for seed in range(flights):
            truth, inputs, graph = _drive(unit, seed, duration, graph)
            if known is None:
                known = _known(unit, truth)
                bounds = _bound(graph, inputs, truth, known, settle)
            belief = simulate(graph, inputs, init={"belief": _drawn(known, truth, seed)}, engine="c")[
                "belief"
            ]
            squares.append(_squares(belief, truth, settle))
        assert bounds is not None
        rows.append({"unit": unit, "flights": flights, **_row(np.array(squares), bounds)})
        rows[-1]["wall_s"] = perf_counter() - begin
    return Report([*rows, *({**r} for r in PUBLISHED), _ticks()])


def _ticks() -> dict[str, Any]:
    """What a tick of gnss_ins takes in C beside one of ins_eskf: the least of some runs of one drive, of
    positions alone for the one and with velocities for the other."""
    flight = load_flight("sim:drive", settings={"duration": "10"})  # short: few runs are interrupted
    gnss = gnss_ins.case(flight, estimate="none")
    fixes = gnss.inputs["gnss"]  # type: ignore[index]
    place = Series(fixes.time, Position(position=fixes["position"]), name="leica")
    capture = replace(flight, streams={"imu": flight.streams["imu"], "leica": place})
    cases = {"gnss_ins": gnss, "ins_eskf": ins_eskf.case(capture)}
    found = dict.fromkeys(cases, np.inf)
    for _ in range(_RUNS):  # in turn, so that what else the machine does meets both
        for name, case in cases.items():
            run = simulate(case.graph, case.inputs, engine="c")
            found[name] = min(found[name], 1e6 * run.wall_s / run.ticks)
    took = {f"{name}_us_per_tick": value for name, value in found.items()}
    return {"unit": "a tick in C", **took, "ticks_ratio": found["gnss_ins"] / found["ins_eskf"]}


def _row(squares: np.ndarray, bounds: np.ndarray) -> dict[str, float]:
    """The figures of a unit.

    Args:
        squares: mean squares (n, 7) of each flight, as `_squares` gives them.
        bounds: of position, velocity and attitude.
    """
    mean = squares.mean(axis=0)
    rms = np.sqrt(mean)
    unsure = (
        squares.std(axis=0, ddof=1) / np.sqrt(len(squares)) / mean if len(squares) > 1 else np.full(7, np.nan)
    )
    row: dict[str, float] = {}
    for k, (name, scale) in enumerate(FIGURES.items()):
        what, ratio = name.split("_")[0], rms[k] / bounds[k]
        row |= {name: float(rms[k] * scale), f"{what}_over_bound": float(ratio)}
        row[f"{what}_over_bound_deviation"] = float(0.5 * unsure[k] * ratio)  # of a root
    row |= {name: float(rms[3 + k]) for k, name in enumerate(("east_rmse_m", "north_rmse_m", "up_rmse_m"))}
    return row | {"heading_rmse_deg": float(np.degrees(rms[6]))}


def _drive(unit: str, seed: int, duration: float, graph: Graph | None) -> tuple[Series, Any, Graph]:
    """The truth and the inputs of a drive over the one road, and the graph that the first was built as."""
    flight = load_flight(
        "sim:drive", seed=seed, settings={"unit": unit, "duration": f"{duration}", "road": "0"}
    )
    case = gnss_ins.case(flight, estimate="none")
    assert flight.truth is not None
    return flight.truth, case.inputs, case.graph if graph is None else graph


def _known(unit: str, truth: Series) -> Belief:
    """What is known of the start, about the true one."""
    grade, first = GRADES[unit], truth[0]
    spread = StartSpread(
        0.7, 0.1, 0.02, 0.05, max(grade.gyro_bias, 1e-9), max(grade.accelerometer_bias, 1e-9)
    )
    return start_belief(first.position, first.attitude, velocity=first.velocity, spread=spread)


def _drawn(known: Belief, truth: Series, seed: int) -> Belief:
    """A start as wrong as it is said to be; the biases are the flight's own."""
    first = truth[0]
    drawn = np.random.default_rng([seed, 77]).multivariate_normal(np.zeros(15), known.covariance)
    return known.replace(
        position=first.position + drawn[:3],
        velocity=first.velocity + drawn[3:6],
        attitude=np.asarray(multiply(first.attitude, from_rotation_vector(drawn[6:9], xp=np), xp=np)),
    )


def _squares(belief: Series, truth: Series, settle: float) -> np.ndarray:
    """Mean squares (7,): of position, velocity and attitude, of east, north and up, and of the heading."""
    keep = belief.time >= round(settle * 1e9)
    at = np.searchsorted(truth.time, belief.time[keep])
    q = belief["attitude"][keep]
    turn = to_rotation_vector(multiply(truth["attitude"][at], conjugate(q, xp=np), xp=np), xp=np)
    place, speed = (belief[name][keep] - truth[name][at] for name in ("position", "velocity"))
    whole = [np.mean(np.sum(part**2, axis=-1)) for part in (place, speed, turn)]
    return np.array([*whole, *np.mean(place**2, axis=0), np.mean(turn[:, 2] ** 2)])


def _bound(graph: Graph, inputs: Any, truth: Series, known: Belief, settle: float) -> np.ndarray:
    """The roots of the mean traces of position, velocity and attitude."""
    exact = known.replace(**{name: truth[name][0] for name in ("gyro_bias", "accelerometer_bias")})
    result = simulate(graph, _exact(inputs, truth), init={"belief": exact}, engine="c")["belief"]
    diagonal = np.einsum("nii->ni", result["covariance"][result.time >= round(settle * 1e9)])
    return np.sqrt([diagonal[:, a : a + 3].sum(axis=-1).mean() for a in (0, 3, 6)])


def _exact(inputs: Mapping[str, Series], truth: Series) -> dict[str, Series]:
    """The fixes without noise; readings are as they are, since what the bound hangs on is the motion."""
    at = lambda s: np.searchsorted(truth.time, s.time)
    gnss, speed = inputs["gnss"], inputs["gnss_velocity"]
    return {
        **inputs,
        "gnss": Series(gnss.time, gnss.values.replace(position=truth["position"][at(gnss)]), name="gnss"),
        "gnss_velocity": Series(
            speed.time, speed.values.replace(velocity=truth["velocity"][at(speed)]), name="gnss_velocity"
        ),
    }
