"""`flowgraph bench ese650`: orientation filters over the sets of raw counts beside motion capture.

Each set is calibrated by all others, and one configuration serves all sets. A row is the root mean square of
the roll, pitch and yaw error in rad, and of the total, heading and inclination error in degrees. Beside the
filters that are installed stands, where it was published, what the original project reached. A picture a set
shows roll, pitch and yaw of the filters over the truth, as that project drew them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

from flowgraph import Report, Series, find_graph, load_flight, simulate
from flowgraph.blocks.datasets.ese650 import sets_in
from flowgraph.data.registry import graph_names
from flowgraph.graphs.benches import engine_of, lists, recordings

FILTERS = ("quaternion_ukf", "roll_pitch", "gyro_integration")
PUBLISHED: Mapping[int, tuple[float, float, float]] = {
    1: (0.102, 0.021, 0.138),
    2: (0.062, 0.034, 0.411),
    3: (0.044, 0.034, 0.224),
}
"""Roll, pitch and yaw in rad of the original project's filter, by set."""

FIGURES = (
    "roll_rmse_rad",
    "pitch_rmse_rad",
    "yaw_rmse_rad",
    "total_rmse_deg",
    "heading_rmse_deg",
    "inclination_rmse_deg",
)


def ese650(*, data: str | None = None, engine: str = "auto", filters: str = "") -> Report:
    """ESE 650: roll, pitch and yaw error of orientation filters from raw counts, a row a set and filter.

    Args:
        data: the folder of the sets, or one that holds ese650/.
        engine: "auto" is xla where JAX is installed.
        filters: comma-separated names; where empty, those of `FILTERS` that are installed.

    Raises:
        DataError: where there are no sets. UnknownNameError: for a filter that is not installed.
    """
    installed = graph_names()
    usual = ",".join(f for f in FILTERS if f in installed)
    chosen = lists.names(filters or usual, installed, what="graph", path="ese650.filters")
    folder = recordings(data, "ese650", "imuRaw*.mat")[0].parent
    rows: list[dict[str, Any]] = []
    figures: dict[str, Callable[[Path], None]] = {}
    for n in sets_in(folder):
        flight = load_flight(f"ese650:{folder}:{n}")
        found: dict[str, Series] = {}
        for name in chosen:
            begin = perf_counter()
            case = find_graph(name).case(flight)
            result = simulate(case.graph, case.inputs, engine=engine_of(engine))
            errors = case.score(result)
            estimate = result.series.get(case.estimate)
            if estimate is not None and "attitude" in estimate.leaves and len(estimate):
                found[name] = estimate
            kept = {f: errors.get(f) for f in FIGURES}
            rows.append({"set": n, "filter": name, **kept, "wall_s": perf_counter() - begin})
        if found:
            figures[f"set{n}.png"] = _comparison(found, flight.truth)
        if n in PUBLISHED:
            angles = dict(zip(FIGURES, PUBLISHED[n], strict=False))
            rows.append(
                {"set": n, "filter": "published", **angles, **dict.fromkeys(FIGURES[3:]), "wall_s": None}
            )
    missing = [f for f in FILTERS if f not in installed]
    notes = [f"{', '.join(missing)}: not installed, left out"] if missing and not filters else []
    return Report(rows, figures, tuple(notes))


def _comparison(estimates: Mapping[str, Series], truth: Series | None) -> Callable[[Path], None]:
    """Draws the picture of a set: filter, accelerometer and gyroscope against the truth."""

    def draw(file: Path) -> None:
        from flowgraph.drawing.attitude import plot_comparison  # with Matplotlib, which only pictures need

        plot_comparison(estimates, truth, file)

    return draw
