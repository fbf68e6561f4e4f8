"""What an influence function and a learned noise buy: outliers, and a noise that is told wrong.

Outliers: a tenth of the poses of a simulated flight are off, some by 3 m and 0.5 rad to any side. Noise:
`kalman` is told a fraction or a multiple of the deviation that its measurements have, and learns or not.
Each row is over several flights, errors as the root of their mean square.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from flowgraph import DeclarationError, Report, find_graph, load_flight, simulate
from flowgraph.graphs.benches import lists
from flowgraph.graphs.benches.fault_kinds import aids_of, faulty, outliers

__all__ = ["robust"]

FILTERS = ("ekf", "ukf", "kalman", "ins_eskf")
METHODS = ("none", "huber", "student_t")
FACTORS = (0.2, 1.0, 5.0)
"""By what the deviation that a filter is told is multiplied."""

WINDOW = 20
"""Measurements over which a noise is learned."""

BEGINS = 1.0
"""s after the first reading, from which on poses are off: what a filter starts from is none of them."""


def robust(
    *,
    filters: str = ",".join(FILTERS),
    flights: int = 6,
    share: float = 0.1,
    duration: float = 20.0,
    noise_duration: float = 36.0,
    seed: int = 0,
    engine: str = "python",
) -> Report:
    """Outliers with and without an influence function, and a noise that is told wrong, learned or not.

    Args:
        filters: Kalman filters of `sim`, with commas between.
        flights: so many, one seed each.
        share: of the poses that are off.
        duration, noise_duration: of a flight with outliers, and of one whose noise is told wrong, s.
        seed: of the first flight.

    Returns:
        Rows `part` ("outliers" or "noise"), `filter`, `robust`, `outliers` (the share), `told` (times the
        true deviation), `adaptive` (measurements, 0 for none), `position_rmse_m`, `nees_mean`.

    Raises:
        DeclarationError: for no flights, or a share that is none.
        UnknownNameError: for a filter that is none of `FILTERS`.
    """
    if flights < 1 or not 0.0 < share < 1.0:
        raise DeclarationError(
            "this bench needs a flight, and a share of its poses",
            path="robust", expected="flights of 1 or more, and a share between 0 and 1",
            got=f"flights={flights}, share={share:g}", fix="leave both out",
        )  # fmt: skip
    chosen = lists.names(filters, FILTERS, what="filter of this bench", path="robust.filters")
    seeds = range(seed, seed + flights)
    rows = [
        {"part": "outliers", "filter": name, "robust": method, "outliers": off, "told": 1.0, "adaptive": 0,
         **_figures(name, seeds, duration, off, engine, {} if method == "none" else {"robust": method})}
        for name in chosen for off in (0.0, share) for method in METHODS
    ]  # fmt: skip
    rows += [
        {"part": "noise", "filter": "kalman", "robust": "none", "outliers": 0.0, "told": told,
         "adaptive": window, **_told_wrong(seeds, noise_duration, told, window, engine)}
        for told in FACTORS for window in (0, WINDOW)
    ]  # fmt: skip
    return Report(rows, notes=(f"{flights} flights of sim, of {duration:g} and {noise_duration:g} s",))


def _figures(
    name: str, seeds: Iterable[int], duration: float, off: float, engine: str, more: Mapping[str, Any]
) -> dict[str, Any]:
    return _mean(_flown(name, seed, duration, off, engine, more) for seed in seeds)


def _told_wrong(
    seeds: Iterable[int], duration: float, told: float, window: int, engine: str
) -> dict[str, Any]:
    def one(seed: int) -> dict[str, float]:
        flight = load_flight("sim", seed=seed, settings={"duration": f"{duration:g}"})
        more = {"position_noise": told * flight.info["position_noise"]}
        return _flown(
            "kalman", seed, duration, 0.0, engine, {**more, **({"adaptive": window} if window else {})}
        )

    return _mean(map(one, seeds))


def _flown(
    name: str, seed: int, duration: float, off: float, engine: str, more: Mapping[str, Any]
) -> dict[str, float]:
    flight = load_flight("sim", seed=seed, settings={"duration": f"{duration:g}"})
    if off:
        flight = faulty(flight, aids_of(flight), outliers, BEGINS, off, seed)
    case = find_graph(name).case(flight, **more)
    return case.score(simulate(case.graph, case.inputs, seed=seed, engine=engine))


def _mean(scores: Iterable[Mapping[str, float]]) -> dict[str, float]:
    found = list(scores)
    return {
        "position_rmse_m": float(np.sqrt(np.mean([one["position_rmse_m"] ** 2 for one in found]))),
        "nees_mean": float(np.mean([one["nees_mean"] for one in found])),
    }
