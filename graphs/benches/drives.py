"""`flowgraph bench drives`: `gnss_ins` on simulated drives, beside the Cramer-Rao bound of each.

A drive has a unit of a stated grade, and positions and velocities by satellites once a second (`sim:drive`).
Over drives of one road, with other noise each, the root mean square errors of position, velocity and attitude
are divided by the bound: the root of the mean trace of the covariance that the filter's own equations have
along the true motion, with exact fixes and biases. No estimate without bias does better, and one as good has
a ratio of 1.

Beside it stands what NaveGo publishes of its own synthetic drive with its own two units, which is another
drive: north, east, down .33, .48, .44 m and yaw 8.9 degrees for its worse unit, .33, .48, .69 m and 0.81
degrees for the better.

Sources: P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear
filtering", IEEE TSP 46(5), 1998 (here the Riccati equation along the truth); R. Gonzalez, J. Giribet,
H. Patino, "NaveGo: a simulation framework for low-cost integrated navigation systems", CEAI 17(2), 2015.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import Report, Series, load_flight, simulate
from flowgraph.blocks.flights.drive import GRADES
from flowgraph.blocks.geometry.rotations import conjugate, from_rotation_vector, multiply, to_rotation_vector
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.graphs.gnss_ins import gnss_ins

PUBLISHED = (
    {"unit": "NaveGo, worse unit, its own drive", "position_rmse_m": 0.73, "yaw_rmse_deg": 8.9},
    {"unit": "NaveGo, better unit, its own drive", "position_rmse_m": 0.90, "yaw_rmse_deg": 0.81},
)
"""The three directions put together."""


FIGURES = {"position_rmse_m": 1.0, "velocity_rmse_mps": 1.0, "attitude_rmse_deg": 180.0 / np.pi}


def drives(
    *, flights: int = 20, units: str = "consumer,tactical", duration: float = 60.0, settle: float = 10.0
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
    for unit in (u.strip() for u in units.split(",")):
        begin = perf_counter()
        squares, bounds = [], None
        for seed in range(flights):
            error, bound = _run(unit, seed, duration, settle, bounds is None)
            squares.append(error)
            bounds = bound if bounds is None else bounds
        assert bounds is not None
        rms = np.sqrt(np.mean(squares, axis=0))
        row: dict[str, Any] = {"unit": unit, "flights": flights}
        for k, (name, scale) in enumerate(FIGURES.items()):
            row |= {
                name: float(rms[k] * scale),
                f"{name.split('_')[0]}_over_bound": float(rms[k] / bounds[k]),
            }
        rows.append({**row, "wall_s": perf_counter() - begin})
    return Report([*rows, *({**r} for r in PUBLISHED)])


def _run(
    unit: str, seed: int, duration: float, settle: float, bounded: bool
) -> tuple[np.ndarray, np.ndarray | None]:
    """The mean squares of the errors of a run, and the roots of the mean traces of the bound."""
    settings = {"unit": unit, "duration": f"{duration}", "road": "0"}
    flight = load_flight("sim:drive", seed=seed, settings=settings)
    truth = flight.truth
    assert truth is not None
    grade = GRADES[unit]
    case = gnss_ins.case(flight, estimate="none")
    rng = np.random.default_rng([seed, 77])
    first = truth[0]
    spread = StartSpread(
        0.7, 0.1, 0.02, 0.05, max(grade.gyro_bias, 1e-9), max(grade.accelerometer_bias, 1e-9)
    )
    known = start_belief(first.position, first.attitude, velocity=first.velocity, spread=spread)
    drawn = rng.multivariate_normal(np.zeros(15), known.covariance)
    begun = known.replace(
        position=known.position + drawn[:3],
        velocity=known.velocity + drawn[3:6],
        attitude=np.asarray(multiply(known.attitude, from_rotation_vector(drawn[6:9], xp=np), xp=np)),
    )
    result = simulate(case.graph, case.inputs, init={"belief": begun}, engine="c")
    belief = result["belief"]
    keep = belief.time >= round(settle * 1e9)
    at = np.searchsorted(truth.time, belief.time[keep])
    turn = to_rotation_vector(
        multiply(conjugate(belief["attitude"][keep], xp=np), truth["attitude"][at], xp=np), xp=np
    )
    off = [belief[name][keep] - truth[name][at] for name in ("position", "velocity")]
    parts = (*off, turn)
    found = np.array([np.mean(np.sum(part**2, axis=-1)) for part in parts])
    if not bounded:
        return found, None
    exact = _exact(case.inputs, truth)
    along = simulate(
        case.graph,
        exact,
        init={"belief": known.replace(**{n: truth[n][0] for n in ("gyro_bias", "accelerometer_bias")})},
        engine="c",
    )["belief"]["covariance"][keep]
    diagonal = np.einsum("nii->ni", along)
    traces = [diagonal[:, a : a + 3].sum(axis=-1).mean() for a in (0, 3, 6)]
    return found, np.sqrt(traces)


def _exact(inputs: Any, truth: Series) -> dict[str, Series]:
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
