"""`flowgraph bench late`: what becomes of a filter whose position comes late, by what is done about it.

`ins_eskf` on MH_01 of EuRoC, whose Leica is given its right stamps and arrives `latency` seconds after
them. All rows are scored at the same ticks, those of the inertial unit once the first fix has arrived, by the
belief that was known at each.

    sorted       as if nothing were late: what no filter can know by then
    foreseen     the best that can be known: the sorted belief of the last fix that has arrived, predicted
                 to now by the inertial unit, step by step
    on arrival   each fix is taken for fresh when it comes
    reorder      all streams are held back until the fix has come: right, but the belief is old
    rewind       each fix is applied at its own time, and what came since is made again
    random       rewind, with delays of 0 to `spread` s that reorder the fixes

`difference` is how far, in any number of the belief, rewind is from the sorted run at the time of each fix,
once that fix and all before it have been applied, relative to max(1, |x|); covariances relative to the
deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph import (
    Case,
    Flight,
    Report,
    Result,
    Series,
    Stream,
    clocks_of,
    delayed,
    graph,
    load_flight,
    lower,
    simulate,
)
from flowgraph.blocks.filtering import rewind
from flowgraph.blocks.inertial.imu import predict
from flowgraph.blocks.scoring.late import places
from flowgraph.blocks.signals import Belief, Imu, Position
from flowgraph.engines.registry import engine_names
from flowgraph.graphs.benches import lists, recordings
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.recorder.namespaces import NUMPY

__all__ = ["difference", "foreseen", "late", "late_eskf"]

OFFSET = "-0.135"
"""s, what the stamps of MH_01's Leica are late by."""


@graph
def late_eskf(
    imu: Stream[Imu], position: Stream[Position], *, settings: Mapping[str, Any], max_lag: str, size: int
):
    """`ins_eskf` whose position may come late. `then`: the belief at the stamp of a fix that just came."""
    streams: dict[str, Stream[Any]] = {"imu": imu, "position": position}
    rewound = rewind(ins_eskf, streams, late=("position",), max_lag=max_lag, size=size, **settings)
    return {"belief": rewound.now["belief"], "then": rewound.then["belief"], "stamp": rewound.stamp}


def late(
    *,
    data: str | None = None,
    latency: float = 0.135,
    spread: float = 0.5,
    duration: float | None = None,
    engines: str = "python,c",
    seed: int = 0,
) -> Report:
    """Late positions: ins_eskf on arrival, with rewind and with reorder, beside the best that can be known.

    Args:
        data: the folder of EuRoC, or one that holds euroc/.
        latency: s, after which each fix arrives.
        spread: s, the longest of the random delays.
        duration: s, only the first of the flight.
        engines: that run rewind, with commas between.
        seed: of the random delays.

    Returns:
        A row a policy and engine: `policy`, `engine`, `position_rmse_m`, `us_per_tick` (of the engine's
        loop), `bytes` (of registers), `difference`, and `applied` and `refused`, late fixes.

    Raises:
        DataError: where the recording is not there.
    """
    chosen = lists.names(engines, engine_names(), what="engine", path="late.engines")
    (folder,) = recordings(data, "euroc", "MH_01*")
    flight = load_flight(f"euroc:{folder}", settings={"leica.time_offset": OFFSET})
    case = ins_eskf.case(_first(flight, duration))
    given = _series(case)
    on_time = simulate(case.graph, given, engine="c")
    wait = round(latency * 1e9)
    fix = given["position"]
    since = int(fix.time[0]) + wait + round(max(spread - latency, 0.0) * 1e9)
    made = _Rows(case, on_time, since)
    made.add("sorted", "c", on_time, case.graph)
    made.add("foreseen", "python", replace(on_time, series={"belief": foreseen(case, on_time, wait)}), None)
    tardy = {**given, "position": _arrived(fix, delayed(fix, wait))}
    plain = ins_eskf.build(**clocks_of(tardy), **case.graph.settings)
    made.add("on arrival", "c", simulate(plain, tardy, engine="c"), plain)
    shown = replace(on_time, series={"belief": _old(on_time["belief"], wait)})
    made.add("reorder", "c", shown, case.graph)
    size = places(given, round(max(latency, spread) * 1e9))
    mixed = delayed(fix, ("0s", f"{spread}s"), seed=seed)
    for policy, fixes in (("rewind", delayed(fix, wait)), ("random", mixed)):
        inputs = {**given, "position": _arrived(fix, fixes)}
        lag = f"{max(latency, spread)}s"
        built = late_eskf.build(**clocks_of(inputs), settings=case.graph.settings, max_lag=lag, size=size)
        for engine in chosen:
            result = simulate(built, inputs, engine=engine)
            made.add(policy, engine, result, built, difference(result, on_time, fixes))
    return Report(
        made.rows,
        notes=(
            f"The Leica arrives {latency:g} s late, in random up to {spread:g} s; a history of {size} "
            f"places; errors at {len(made.times)} ticks of the inertial unit.",
            "Bytes are of registers, what lasts from tick to tick.",
        ),
    )


class _Rows:
    """The rows of the table, all scored at the same times."""

    def __init__(self, case: Case, on_time: Result, since: int) -> None:
        self.case = case
        imu = _series(case)["imu"].time
        self.times = imu[imu >= since]
        self.rows: list[dict[str, Any]] = []

    def add(self, policy: str, engine: str, result: Result, built: Any, apart: float | None = None) -> None:
        belief = result["belief"]
        kept = belief[np.isin(belief.time, self.times)]
        scored = self.case.score(replace(result, series={**result.series, "belief": kept}))
        stats = {name.rpartition("late_")[2]: n for name, n in result.stats.items()}
        self.rows.append(
            {
                "policy": policy,
                "engine": engine,
                "position_rmse_m": float(scored["position_rmse_m"]),
                "us_per_tick": None if built is None else 1e6 * result.wall_s / result.ticks,
                "bytes": None if built is None else lower(built).totals()["register_bytes"],
                "difference": apart,
                "applied": stats.get("applied"),
                "refused": stats.get("refused"),
            }
        )


def _series(case: Case) -> Mapping[str, Series]:
    assert isinstance(case.inputs, Mapping)  # as this graph's cases have them
    return case.inputs


def _first(flight: Flight, duration: float | None) -> Flight:
    if duration is None:
        return flight
    end = flight.streams["imu"].time[0] + round(duration * 1e9)
    return replace(flight, streams={n: s[s.time <= end] for n, s in flight.streams.items()})


def _arrived(series: Series, tardy: Series) -> Series:
    """What arrives within the recording."""
    return tardy[tardy.time <= series.time[-1]]


def _old(belief: Series, wait: int) -> Series:
    """A belief that is known only `wait` ns after its time, at the ticks at which it was asked for."""
    place = np.searchsorted(belief.time, belief.time - wait, side="right") - 1
    known = place >= 0
    held = belief[place[known]]
    return Series(belief.time[known], held.values, type=belief.type, name=belief.name)


def foreseen(case: Case, on_time: Result, wait: int) -> Series:
    """The sorted belief of the last fix that is `wait` ns old, predicted to each tick of the inertial unit.

    Made by the step of the prediction itself, apart from any history.
    """
    given, settings = _series(case), case.graph.settings
    imu, fixes = given["imu"], given["position"].time
    belief = on_time["belief"]
    controls = list(imu)
    held = {"noise": settings["noise"], "gravity": settings["gravity"]}
    times, found = [], []
    ends = np.append(fixes[1:], np.iinfo(np.int64).max - wait) + wait
    for fix, end in zip(fixes.tolist(), ends.tolist(), strict=True):
        now, at = belief[int(np.searchsorted(belief.time, fix))], fix
        for k in range(int(np.searchsorted(imu.time, fix, side="right")), len(imu)):
            t = int(imu.time[k])
            if t >= end:
                break
            now = predict.step(now, controls[k], dt=(t - at) * 1e-9, xp=NUMPY, **held)
            at = t
            if t >= fix + wait:
                times.append(t)
                found.append(now)
    names = list(found[0]._fields) if found else []
    values = Belief(**{n: np.stack([getattr(b, n) for b in found]) for n in names})
    return Series(np.array(times, np.int64), values, name="belief")


def difference(result: Result, on_time: Result, fixes: Series) -> float:
    """How far the belief at the time of a fix is from the sorted run's, once all up to it have arrived.

    Args:
        result: with the belief `then`, and its `stamp`.
        on_time: the sorted run.
        fixes: all that it had, as they arrive; those that came after the recording's end may be among them.
    """
    stamps = result["stamp"]["value"]
    arrived = np.searchsorted(fixes.time, result["stamp"].time)
    order = np.argsort(fixes.stamp, kind="stable")
    latest = np.maximum.accumulate(fixes.time[order])  # by stamp: when all up to it had arrived
    last = np.empty(len(fixes), bool)
    last[order] = latest == fixes.time[order]
    chosen = last[arrived]
    there, wanted = result["then"], on_time["belief"]
    place = np.searchsorted(wanted.time, stamps[chosen])
    apart = 0.0
    for name, values in there.leaves.items():
        ours, theirs = values[chosen], wanted[name][place]
        if name == "covariance":
            spread = np.sqrt(np.einsum("nii->ni", theirs))
            scale = spread[:, :, None] * spread[:, None, :]
        else:
            scale = np.maximum(1.0, np.abs(theirs))
        apart = max(apart, float(np.max(np.abs(ours - theirs) / scale, initial=0.0)))
    return apart
