"""`flowgraph bench outdoor`: satellites and an inertial unit on recorded flights of a quadrotor.

The receiver's RTK positions are thinned to one a second, or one in five, and those left out judge what is
found
between: by `gnss_ins` as it runs, smoothed over the whole flight, and by curves through the positions alone.
One configuration serves all flights; no heading and no place of the antenna is given. In an outage, fixes of
one a second stop for 10 s in the middle of the flight, and only these 10 s are judged.

The clocks of unit and receiver are apart by a constant of each recording. It is found first, by all
positions: for each of a row of offsets an alignment in motion says how well readings and positions fit, and
the filter, which estimates what is left of it, says the rest.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from flowgraph import Case, Flight, Report, Series, load_flight, simulate
from flowgraph.blocks.inertial.moving import align_moving
from flowgraph.blocks.kalman.smoothing import rauch_tung_striebel
from flowgraph.blocks.outdoor.errors import at_antenna
from flowgraph.blocks.signals import GRAVITY
from flowgraph.errors import DataError
from flowgraph.graphs.benches import lists, recordings
from flowgraph.graphs.gnss_ins import gnss_ins

AIDS: Mapping[str, str] = {"1 Hz": "1", "0.2 Hz": "5", "outage 10 s": "1"}
"""By name, s between fixes."""

METHODS = ("filter", "smoothed", "batch", "linear", "spline")
OUTAGE = 10.0
SETTLE = 1.0
"""s, after the first fix, that are left out of the errors."""

_WIDEST, _STEP, _LOOK = 1.2, 0.2, 6.0  # s: offsets that are tried, and how long is looked at


class Judged(NamedTuple):
    """Positions (n, 3) at times of the truth, their deviations or None, and the mean NIS or None. Of a batch
    that does not settle there are none."""

    position: np.ndarray | None
    deviation: np.ndarray | None = None
    nis: float | None = None


def outdoor(
    *, data: str | None = None, imu: str = "1", flights: str = "", aids: str = "", engine: str = "python"
) -> Report:
    """Flights with RTK thinned to 1 Hz, 0.2 Hz and with an outage: position errors, a row a flight, aid and
    method.

    Args:
        data: the folder of the flights, or one that holds outdoor_quadrotor/.
        imu: numbers of the inertial units, comma-separated.
        flights: comma-separated names; all where empty.
        aids: of 1 Hz, 0.2 Hz and outage 10 s, comma-separated; all where empty.
        engine: of the filter.

    Raises:
        DataError: where there are no flights.
    """
    wanted = lists.parts(flights)
    folders = [f.parent for f in recordings(data, "outdoor_quadrotor", "*/GT.csv")]
    folders = sorted((f for f in folders if not wanted or f.name in wanted), key=_number)
    chosen = lists.names(aids, AIDS, what="aid", path="outdoor.aids")
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for folder in folders:
        for unit in lists.parts(imu):
            offset = clock_offset(folder, unit)
            notes.append(f"{folder.name}, imu {unit}: the receiver's clock is {offset:+.3f} s off the unit's")
            for aid in chosen:
                begin = perf_counter()
                for method, found in _rows(folder, unit, aid, offset, engine):
                    wall = perf_counter() - begin
                    head = {"flight": folder.name, "aid": aid, "imu": unit, "method": method}
                    rows.append({**head, **found, "wall_s": wall})
                    if found["position_rmse_m"] is None:
                        notes.append(f"{folder.name}, {aid}, imu {unit}: the {method} does not settle")
                    begin = perf_counter()
    return Report([*rows, *_means(rows, chosen)], notes=tuple(notes))


def _number(folder: Path) -> tuple[int, str]:
    """So that path_2 comes before path_11."""
    found = re.search(r"(\d+)$", folder.name)
    return (int(found.group(1)) if found else -1, folder.name)


def loaded(folder: Path, unit: str, every: str, offset: float) -> Flight:
    """A flight with its positions thinned and its clocks put together; rows of the same stamp count once."""
    settings = {"rtk.every": every, "rtk.time_offset": f"{offset:.6f}", "bad_time": "drop"}
    return load_flight(f"outdoor_quadrotor:{folder}:{unit}", settings=settings)


def clock_offset(folder: Path, unit: str) -> float:
    """By how much (s) the stamps of the receiver must be moved to be the inertial unit's."""
    flight = loaded(folder, unit, "0.2", 0.0)
    imu, rtk = flight.streams["imu"], flight.streams["rtk"]
    span = (rtk.time[-1] - rtk.time[0]) * 1e-9
    starts = [1.0, max(1.0, span - _LOOK - 3.0)]
    tried = np.arange(-_WIDEST, _WIDEST + 0.5 * _STEP, _STEP)
    best = float(tried[int(np.argmin([_unlike(imu, rtk, offset, starts) for offset in tried]))])
    flight = loaded(folder, unit, "0.1", best)
    case = gnss_ins.case(flight, estimate="lever+time_offset")
    late = simulate(case.graph, case.inputs)["belief"]["parameters"][-1, 3]
    return best - float(late)


def _unlike(imu: Series, rtk: Series, offset: float, starts: list[float]) -> float:
    """How badly readings and positions fit with such an offset: the mean square residual of alignments,
    m^2."""
    moved = Series(rtk.time + round(offset * 1e9), rtk.values, name=rtk.name)
    moved = moved[moved.time >= imu.time[0]]
    found = []
    for start in starts:
        part = moved[moved.time >= rtk.time[0] + round((offset + start) * 1e9)]
        fit = None
        if len(part) > 9:
            fit = align_moving(imu, part, gravity=GRAVITY, noise=0.1, least=_LOOK, longest=_LOOK)
        found.append(np.inf if fit is None else fit.residual**2)
    return float(np.mean(found))


def _rows(
    folder: Path, unit: str, aid: str, offset: float, engine: str
) -> Iterator[tuple[str, dict[str, float | None]]]:
    """What each method reaches."""
    flight = loaded(folder, unit, AIDS[aid], offset)
    assert flight.truth is not None
    rtk, span = flight.streams["rtk"], None
    if aid.startswith("outage"):
        middle = 0.5 * float(rtk.time[0] + rtk.time[-1])
        held = np.abs(rtk.time - middle) > 0.5 * OUTAGE * 1e9
        gone = np.flatnonzero(~held)
        span = int(rtk.time[gone[0] - 1]), int(rtk.time[gone[-1] + 1])
        rtk = rtk[held]
        flight = replace(flight, streams={**flight.streams, "rtk": rtk})
    case = gnss_ins.case(flight, smooth="rts", settle=SETTLE)
    assert isinstance(case.inputs, Mapping)
    assert flight.truth is not None
    fixes = case.inputs["gnss"]
    judged = judging(flight.truth, rtk, fixes, span)
    for method, found in _found(case, fixes, judged.time, engine).items():
        if found.position is None:
            yield method, dict.fromkeys(("position_rmse_m", "position_3sigma", "nis_mean"))
            continue
        error = found.position - judged["position"]
        covered = None
        if found.deviation is not None:
            covered = float(np.mean(np.abs(error) <= 3.0 * found.deviation))
        rmse = float(np.sqrt(np.mean(np.sum(error**2, axis=-1))))
        yield method, {"position_rmse_m": rmse, "position_3sigma": covered, "nis_mean": found.nis}


def judging(truth: Series, rtk: Series, fixes: Series, span: tuple[int, int] | None) -> Series:
    """The rows of the truth that were no aid, between the first fix, and `SETTLE`, and the last; of an
    outage those in its span."""
    t = truth.time
    first, last = span or (int(fixes.time[0]) + round(SETTLE * 1e9), int(fixes.time[-1]))
    return truth[(t >= first) & (t <= last) & ~np.isin(t, rtk.time)]


def _found(case: Case, fixes: Series, time: np.ndarray, engine: str) -> dict[str, Judged]:
    """Positions at times, by method."""
    result = simulate(case.graph, case.inputs, engine=engine)
    errors, steps = case.score.errors, case.score.steps  # type: ignore[attr-defined]
    prior, posterior, cross, space, named = steps(result)
    smoothed = rauch_tung_striebel(prior, posterior, cross, space=space)
    try:
        batch = named(case.score.recording(smoothed, None))  # type: ignore[attr-defined]
    except DataError:
        batch = None
    place = lambda series: at_antenna(
        series, antenna=errors.keywords["antenna"], estimated=errors.keywords["estimated"]
    )
    nis = case.score(result)["gnss_nis_mean"]
    t = (fixes.time - fixes.time[0]) * 1e-9
    at = (time - fixes.time[0]) * 1e-9
    p = fixes["position"]
    return {
        "filter": _between(place(result["belief"]), time, nis),
        "smoothed": _between(place(named(smoothed)), time),
        "batch": Judged(None) if batch is None else _between(place(batch), time),
        "linear": Judged(np.stack([np.interp(at, t, column) for column in p.T], axis=-1)),
        "spline": Judged(CubicSpline(t, p)(at)),
    }


def _between(belief: Series, time: np.ndarray, nis: float | None = None) -> Judged:
    """A belief at times, by its last tick before and its velocity."""
    rows = np.clip(np.searchsorted(belief.time, time, side="right") - 1, 0, len(belief) - 1)
    ahead = ((time - belief.time[rows]) * 1e-9)[:, None]
    deviation = np.sqrt(np.einsum("nii->ni", belief["covariance"][rows, :3, :3]))
    return Judged(belief["position"][rows] + belief["velocity"][rows] * ahead, deviation, nis)


def _means(rows: list[dict[str, Any]], aids: list[str]) -> Iterator[dict[str, Any]]:
    """Over all flights, a row an aid and method."""
    for aid in aids:
        for method in METHODS:
            mine = [r for r in rows if r["aid"] == aid and r["method"] == method]
            if not mine:
                continue
            mine = [r for r in mine if r["position_rmse_m"] is not None]
            mean = {
                key: float(np.mean([r[key] for r in mine])) if mine and mine[0][key] is not None else None
                for key in ("position_rmse_m", "position_3sigma", "nis_mean", "wall_s")
            }
            yield {"flight": f"mean of {len(mine)}", "aid": aid, "imu": "all", "method": method, **mean}
