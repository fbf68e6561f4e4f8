"""What outdoor filters gain by estimating the biases of their inertial unit, and how well they find them.

Flights of `sim:thesis` whose unit has biases, with all sensors; each filter with and without them in its
state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import DeclarationError, Flight, Report, Result, find_graph, load_flight, simulate

__all__ = ["biases", "found_biases", "true_biases"]

FILTERS = ("outdoor_eskf", "rbpf_outdoor")
SENSORS = "imu,gps,gps2,altimeter,magnetometer,optical_flow"


def biases(
    *,
    flights: int = 6,
    duration: float = 10.0,
    gyro: float = 0.05,
    accelerometer: float = 0.3,
    particles: int = 1000,
    seed: int = 0,
    engine: str = "c",
) -> Report:
    """Outdoor filters with and without the biases of their unit, on flights whose unit has some.

    Args:
        flights: so many, one seed each.
        duration: of a flight, s.
        gyro, accelerometer: deviations of the biases, rad/s and m/s^2.
        particles: of `rbpf_outdoor`.
        seed: of the first flight.

    Returns:
        A row a filter and choice, root mean squares over the flights: `position_rmse_m`, `attitude_rmse_deg`;
        `gyro_bias_rmse_rps` and `accelerometer_bias_rmse_mps2`, what the biases at the end are off by as the
        norm of three axes; `bias_deviations`, the same in its own deviations, a number.

    Raises:
        DeclarationError: for no flights.
    """
    if flights < 1:
        raise DeclarationError(
            "this bench needs a flight", path="biases.flights", expected="1 or more", got=str(flights),
            fix="leave it out for six",
        )  # fmt: skip
    told = {"sensors": SENSORS, "duration": f"{duration:g}"}
    told |= {"gyro.bias": f"{gyro:g}", "accelerometer.bias": f"{accelerometer:g}"}
    flown = [load_flight("sim:thesis", seed=k, settings=told) for k in range(seed, seed + flights)]
    rows = [_row(name, known, flown, seed, particles, engine) for name in FILTERS for known in (False, True)]
    return Report(rows, notes=(f"{flights} flights of sim:thesis of {duration:g} s, all sensors",))


def found_biases(result: Result) -> tuple[np.ndarray, np.ndarray] | None:
    """What a run of an outdoor filter ends with: the six biases and their deviations, rad/s and m/s^2.

    None where it estimates none.
    """
    if "biases" in result.series:
        last = result["biases"][-1:]
        return last["mean"][0], np.sqrt(np.diag(last["covariance"][0]))
    last = result["belief"][-1:]
    if "gyro_bias" not in last.leaves:
        return None
    mean = np.concatenate([last["gyro_bias"][0], last["accelerometer_bias"][0]])
    return mean, np.sqrt(np.diag(last["covariance"][0])[9:])


def true_biases(flight: Flight) -> np.ndarray:
    """The six at the end of a flight, rad/s and m/s^2."""
    assert flight.truth is not None
    return np.concatenate([flight.truth["gyro_bias"][-1], flight.truth["accelerometer_bias"][-1]])


def _row(
    name: str, known: bool, flown: Sequence[Flight], seed: int, particles: int, engine: str
) -> dict[str, Any]:
    more: dict[str, Any] = {} if known else {"biases": False}
    scores, off, normal = [], [], []
    for k, flight in enumerate(flown, seed):
        cloud = {"particles": particles, "seed": k} if name == "rbpf_outdoor" else {}
        case = find_graph(name).case(flight, **cloud, **more)
        result = simulate(case.graph, case.inputs, seed=k, engine=engine)
        scores.append(case.score(result))
        mean, deviations = found_biases(result) or (np.zeros(6), None)
        off.append(mean - true_biases(flight))
        if deviations is not None:
            normal.append(off[-1] / deviations)
    each = np.array(off)
    return {
        "filter": name,
        "biases": "left out" if known else "false",
        **{key: _root([s[key] for s in scores]) for key in ("position_rmse_m", "attitude_rmse_deg")},
        "gyro_bias_rmse_rps": _root(np.linalg.norm(each[:, :3], axis=1)),
        "accelerometer_bias_rmse_mps2": _root(np.linalg.norm(each[:, 3:], axis=1)),
        "bias_deviations": _root(normal) if normal else None,
    }


def _root(values: npt.ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
