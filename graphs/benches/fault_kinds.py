"""What goes wrong with sensors, as functions from a flight to a flight: gaps, spikes, clocks, noise.

Each takes the flight, the name of a stream and the time at which the fault begins, in s after the first
reading, and leaves the other streams and the truth as they are (but a jump of all stamps, which the truth
makes too). What a fault is like is said once, here: how long, how large, how often.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.scoring.readings import AIDS, CONTROLS
from flowgraph.blocks.signals import MagneticField
from flowgraph.types import StructType, unflatten

__all__ = [
    "HOUR",
    "Fault",
    "aids_of",
    "controls_of",
    "faults_of",
    "faulty",
    "gap",
    "jump",
    "nan",
    "outliers",
    "spikes",
]

HOUR = 3600.0
SPIKES = {"gyro": 20.0, "rate": 20.0, "specific_force": 150.0, "force": 150.0, "acceleration": 150.0}
"""What a spike adds to each axis of a control, rad/s and m/s^2; a measurement's are below."""

FAR, TURNED, METRE = 10.0, 1.0, 1.6e-7
"""By how much a spike of a measurement is off: m (or what its unit is), and rad; how much of a latitude one
metre is, rad."""

OFF, OFF_TURNED = 3.0, 0.5
"""m and rad: how far an outlier is off."""

TOLD = ("covariance", "deviation", "interval")
"""What a reading tells of itself, which no fault changes."""

Make = Callable[[Flight, float], Flight]


@dataclass(frozen=True)
class Fault:
    """A fault of a flight.

    Args:
        name: with the sensor and the size: "dropout vicon 3 s".
        make: the flight with it, where it begins so many s after the first reading.
        lasts: s from its beginning to its end; 0 for what goes on.
        settings: of the graph instead, where the fault is not in the flight: "start_heading", "singular".
    """

    name: str
    make: Make
    lasts: float = 0.0
    settings: tuple[str, ...] = ()


def faults_of(flight: Flight) -> Iterator[Fault]:
    """All faults that the streams of a flight can have."""
    measured = aids_of(flight)
    for name in (*controls_of(flight), *measured):
        for length in (1.0, 10.0, 30.0):
            yield Fault(f"dropout {name} {length:g} s", _of(name, gap, length), length)
        yield Fault(f"nan {name} 0.5 s", _of(name, nan, 0.5), 0.5)
        yield Fault(f"spikes {name}", _of(name, spikes), 1.0)
        yield Fault(f"stuck {name} 2 s", _of(name, _stuck, 2.0), 2.0)
        yield Fault(f"duplicates {name}", _of(name, _twice), 1.0)
        yield Fault(f"noise x10 {name}", _of(name, _noisy))
        yield Fault(f"clock 1 % fast {name}", _of(name, _fast))
        if name in measured:
            for late in (0.1, 0.3, 0.5):
                yield Fault(f"late {name} {late:g} s", _of(name, _late, late))
        if _class(flight.streams[name]) is MagneticField:
            yield Fault(f"disturbance {name} 3 s", _of(name, _disturbed, 3.0), 3.0)
    yield Fault("time jumps 1 h", jump)
    yield Fault("start heading 90 deg off", lambda flight, _: flight, settings=("start_heading",))
    yield Fault("singular start covariance", lambda flight, _: flight, settings=("singular",))


def _class(series: Series) -> type | None:
    return series.type.cls if isinstance(series.type, StructType) else None


def controls_of(flight: Flight) -> list[str]:
    """The streams of a flight that say how the body moves."""
    return sorted(n for n, s in flight.streams.items() if _class(s) in CONTROLS)


def aids_of(flight: Flight) -> list[str]:
    """The streams of a flight that correct."""
    return sorted(n for n, s in flight.streams.items() if _class(s) in AIDS)


def faulty(
    flight: Flight, names: Iterable[str], change: Callable[..., Series], begins: float, *sizes: float
) -> Flight:
    """The flight whose streams of these names have a fault.

    Args:
        change: `gap`, `nan`, `spikes` or another `(series, t, begins, *sizes)` of this module.
        begins: s after the first reading.
        sizes: of the fault.
    """
    streams = dict(flight.streams)
    first = min(int(s.time[0]) for s in streams.values() if len(s))
    for name in names:
        series = streams[name]
        streams[name] = change(series, (series.time - first) * 1e-9, begins, *sizes)
    return replace(flight, streams=streams)


def _of(name: str, change: Callable[..., Series], *sizes: float) -> Make:
    return lambda flight, begins: faulty(flight, [name], change, begins, *sizes)


def _with(
    series: Series, *, time: Any = None, leaves: dict[str, Any] | None = None, gaps: bool = False
) -> Series:
    found = series.leaves if leaves is None else leaves
    values = unflatten(series.type, iter(found.values()))
    stamps = series.time if time is None else time
    return Series(stamps, values, type=series.type, name=series.name, gaps=gaps or series.gaps)


def gap(series: Series, t: np.ndarray, begins: float, length: float) -> Series:
    """No reading for so many seconds."""
    kept: Series = series[(t < begins) | (t >= begins + length)]
    return kept


def nan(series: Series, t: np.ndarray, begins: float, length: float) -> Series:
    """Readings that are no numbers, for so many seconds."""
    there = (t >= begins) & (t < begins + length)
    leaves = {n: np.array(a) for n, a in series.leaves.items()}
    for array in leaves.values():
        if array.dtype.kind == "f":
            array[there] = np.nan
    return _with(series, leaves=leaves, gaps=True)


def spikes(series: Series, t: np.ndarray, begins: float, count: float = 5, times: float = 1.0) -> Series:
    """So many, or as many as there are readings, within a second; so many times as large as usual ones."""
    rows = np.flatnonzero((t >= begins) & (t < begins + 1.0))
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(int(count), len(rows)), dtype=int))]
    leaves = {n: np.array(a) for n, a in series.leaves.items()}
    for name, array in leaves.items():
        if name == "attitude":
            turn = from_rotation_vector(np.array([0.0, 0.0, TURNED]), xp=np)
            array[rows] = multiply(array[rows], np.broadcast_to(turn, array[rows].shape), xp=np)
        elif name == "field":
            array[rows] += 3.0 * float(np.abs(array).max())
        elif array.dtype.kind == "f" and name not in TOLD:
            array[rows] += (
                times * SPIKES.get(name, FAR) * (METRE if name in ("latitude", "longitude") else 1.0)
            )
    return _with(series, leaves=leaves)


def outliers(series: Series, t: np.ndarray, begins: float, share: float, seed: float) -> Series:
    """From then on so large a share of the poses or positions, drawn at random, is off to any side."""
    rng = np.random.default_rng(int(seed))
    rows = np.flatnonzero((rng.random(len(t)) < share) & (t >= begins))
    leaves = {n: np.array(a) for n, a in series.leaves.items()}
    leaves["position"][rows] += OFF * _directions(rng, len(rows))
    if "attitude" in leaves:
        turns = from_rotation_vector(OFF_TURNED * _directions(rng, len(rows)), xp=np)
        leaves["attitude"][rows] = multiply(leaves["attitude"][rows], turns, xp=np)
    return _with(series, leaves=leaves)


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)  # type: ignore[no-any-return]


def _stuck(series: Series, t: np.ndarray, begins: float, length: float) -> Series:
    there = (t >= begins) & (t < begins + length)
    first = max(int(np.argmax(there)) - 1, 0)
    leaves = {n: np.array(a) for n, a in series.leaves.items()}
    for array in leaves.values():
        array[there] = array[first]
    return _with(series, leaves=leaves)


def _twice(series: Series, t: np.ndarray, begins: float) -> Series:
    """Each reading of a second comes again at its own stamp."""
    rows = np.repeat(np.arange(len(t)), 1 + ((t >= begins) & (t < begins + 1.0)))
    return _with(series, time=series.time[rows], leaves={n: a[rows] for n, a in series.leaves.items()})


def _noisy(series: Series, t: np.ndarray, begins: float) -> Series:
    """Noise of ten times the deviation that it has; that is told from second differences."""
    rng = np.random.default_rng(7)
    leaves = {n: np.array(a) for n, a in series.leaves.items()}
    there = t >= begins
    for name, array in leaves.items():
        if array.dtype.kind != "f" or len(array) < 4 or name in TOLD:
            continue
        spread = np.sqrt(99.0) * np.median(np.abs(np.diff(array, 2, axis=0)), axis=0) / 0.6745 / np.sqrt(6.0)
        if name == "attitude":
            turn = rng.normal(size=(len(array), 3)) * float(np.mean(spread)) * 2.0
            turned = multiply(array, from_rotation_vector(turn, xp=np), xp=np)
            array[there] = turned[there]
        else:
            array[there] += (rng.normal(size=array.shape) * spread)[there]
    return _with(series, leaves=leaves)


def _fast(series: Series, t: np.ndarray, begins: float) -> Series:
    more = np.where(t > begins, 0.01 * (t - begins), 0.0)
    return _with(series, time=series.time + np.round(more * 1e9).astype(np.int64))


def _late(series: Series, t: np.ndarray, begins: float, delay: float) -> Series:
    """From then on; what would come before what has come already is left out."""
    time = series.time + np.where(t >= begins, round(delay * 1e9), 0)
    return _with(series, time=time)


def _disturbed(series: Series, t: np.ndarray, begins: float, length: float) -> Series:
    there = (t >= begins) & (t < begins + length)
    leaves = {n: np.array(a) for n, a in series.leaves.items()}
    for array in leaves.values():
        array[there] += 0.5 * float(np.linalg.norm(array, axis=-1).mean()) * np.array([0.6, 0.8, 0.0])
    return _with(series, leaves=leaves)


def jump(flight: Flight, begins: float) -> Flight:
    """From then on all stamps are an hour later, those of the truth as well."""
    first = min(int(s.time[0]) for s in flight.streams.values() if len(s))

    def later(series: Series) -> Series:
        after = (series.time - first) * 1e-9 >= begins
        return _with(series, time=series.time + np.where(after, round(HOUR * 1e9), 0))

    truth = None if flight.truth is None else later(flight.truth)
    return replace(flight, streams={n: later(s) for n, s in flight.streams.items()}, truth=truth)
