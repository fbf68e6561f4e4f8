"""`flowgraph bench broad`: orientation filters over the trials of the BROAD benchmark.

One configuration for all trials. A row is the root mean square of the total, heading and inclination error
over the times that count, in degrees: the body moves, and the optical system saw it. The error is that of the
benchmark, q_estimate q_truth^-1 in the world, split into a turn about the vertical and the rest; nothing is
aligned afterwards. A filter that claims a covariance is judged by it too: `heading_nees_median` and
`tilt_nees_median` are the medians of the squared errors in its own deviations, 0.45 and 1.39 where it is
honest; in the last row, those over all times of all trials.

Beside `marg` run two peers, if they are installed: the filter of Madgwick (`ahrs`, gain 0.12, the best over
all trials in the paper) and VQF (`vqf`, as it comes).

Source: D. Laidig, M. Caruso, A. Cereatti and T. Seel, "BROAD", Data 6(7):72, 2021, sec. 4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import Flight, Report, Series, load_flight, simulate
from flowgraph.blocks.geometry.rotations import multiply
from flowgraph.blocks.metrics.errors import tilt_and_heading_nees
from flowgraph.blocks.scoring.orientation import counted, scored_errors
from flowgraph.blocks.signals import Attitude
from flowgraph.graphs.benches import engine_of, lists, recordings
from flowgraph.graphs.marg import marg

FIGURES = ("total_rmse_deg", "heading_rmse_deg", "inclination_rmse_deg")
CLAIMS = ("tilt_nees_median", "heading_nees_median")


def broad(
    *,
    data: str | None = None,
    engine: str = "auto",
    trials: str = "",
    duration: float | None = None,
) -> Report:
    """BROAD: total, heading and inclination error of marg, Madgwick and VQF, a row a trial and filter.

    Args:
        data: the folder of the trials, or one that holds broad/.
        engine: of marg; "auto" is xla where JAX is installed.
        trials: comma-separated parts of names; all where empty.
        duration: s, only the first of each trial.

    Raises:
        DataError: where there is no trial.
    """
    wanted = lists.parts(trials)
    files = recordings(data, "broad", "[0-9][0-9]_*.mat")
    files = [f for f in files if not wanted or any(part in f.stem for part in wanted)]
    if not files:
        files = recordings(data, "broad", f"*{wanted[0]}*.mat")  # raises, naming what was looked for
    found, notes = peers()
    settings = {} if duration is None else {"duration": str(duration)}
    rows: list[dict[str, Any]] = []
    claimed: dict[str, list[np.ndarray]] = {}
    for file in files:
        flight = load_flight(f"broad:{file}", settings=settings)
        for name, run in (("marg", lambda f: ours(f, engine_of(engine))), *found.items()):
            begin = perf_counter()
            attitude = run(flight)
            wall = perf_counter() - begin
            rows.append(row(file, name, scored_errors(attitude, flight), wall))
            if "covariance" in attitude.leaves and flight.truth is not None:
                claimed.setdefault(name, []).append(claims(attitude, flight))
                rows[-1].update(medians(claimed[name][-1]))
    for name in ("marg", *found):
        mine = [r for r in rows if r["filter"] == name]
        means = {f: float(np.mean([r[f] for r in mine])) for f in FIGURES}
        wall = sum(r["wall_s"] for r in mine)
        rows.append({"trial": f"mean of {len(mine)}", "filter": name, **means, "wall_s": wall})
        if name in claimed:
            rows[-1].update(medians(np.concatenate(claimed[name], axis=-1)))
    return Report(rows, notes=tuple(notes))


def row(file: Path, name: str, errors: Mapping[str, float], seconds: float) -> dict[str, Any]:
    return {"trial": file.stem, "filter": name, **{f: errors[f] for f in FIGURES}, "wall_s": seconds}


def claims(estimate: Series, flight: Flight) -> np.ndarray:
    """The NEES of tilt and heading (2, n) where an error counts."""
    assert flight.truth is not None
    return np.stack(tilt_and_heading_nees(counted(estimate, flight), flight.truth))


def medians(nees: np.ndarray) -> dict[str, float]:
    return dict(zip(CLAIMS, np.median(nees, axis=-1).tolist(), strict=True))


def ours(flight: Flight, engine: str) -> Series:
    """The belief of `marg`, as it comes."""
    case = marg.case(flight)
    return simulate(case.graph, case.inputs, engine=engine)["belief"]


def peers() -> tuple[dict[str, Callable[[Flight], Series]], list[str]]:
    """The filters of other packages that are installed, and a note for each that is not."""
    found: dict[str, Callable[[Flight], Series]] = {}
    notes = []
    for name, package, run in (("madgwick", "ahrs", madgwick), ("vqf", "vqf", vqf)):
        try:
            __import__(package)
        except ImportError:
            notes.append(f'{name} is left out: pip install "flowgraph-filters[bench]" brings {package}')
        else:
            found[name] = run
    return found, notes


def readings(flight: Flight) -> tuple[Series, np.ndarray, np.ndarray, np.ndarray, float]:
    """The IMU's series, rate, force and field (microtesla) at its times, and the step in s.

    A peer knows no absent samples: the field is the last one read.
    """
    imu, field = flight.streams["imu"], flight.streams["magnetometer"]
    held = np.maximum(np.searchsorted(field.time, imu.time, side="right") - 1, 0)
    step = flight.info["imu_period_ns"] * 1e-9
    parts = (imu["gyro"], imu["specific_force"], field["field"][held] * 1e6)
    return imu, *(np.ascontiguousarray(p) for p in parts), step  # type: ignore[return-value]


def madgwick(flight: Flight) -> Series:
    """Madgwick's filter. Its world has north on x; ours, as the trials', has it on y."""
    from ahrs.filters import Madgwick  # optional

    imu, gyro, force, field, step = readings(flight)
    q = Madgwick(gyr=gyro, acc=force, mag=field, frequency=1.0 / step, gain=0.12).Q
    quarter = np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (len(q), 1))
    return Series(imu.time, Attitude(attitude=np.asarray(multiply(quarter, q, xp=np))), name="madgwick")


def vqf(flight: Flight) -> Series:
    """VQF with nine axes, as it comes; its world is east-north-up."""
    from vqf import VQF  # optional

    imu, gyro, force, field, step = readings(flight)
    q = VQF(step).updateBatch(gyro, force, field)["quat9D"]
    return Series(imu.time, Attitude(attitude=q), name="vqf")
