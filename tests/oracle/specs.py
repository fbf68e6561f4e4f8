"""Random graphs as plain data: `{"sources": [...], "nodes": [...]}`, each node one operation.

Whatever is drawn is legal: which streams are of one clock is kept in mind while drawing, by `Drawn.clock`.
Times lie on a coarse grid, so that ties are frequent; numbers are multiples of 1/4, so that sums are exact,
and thresholds are not, so that no engine's rounding decides.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

MS = 1_000_000
Spec = dict[str, Any]


@dataclass(frozen=True)
class Drawn:
    """A stream that was drawn: its number, and a name of its clock that streams of one clock share."""

    number: int
    clock: str


class Draw:
    """One random graph in the making."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.streams: list[Drawn] = []
        self.sources: list[dict[str, Any]] = []
        self.nodes: list[dict[str, Any]] = []

    def spec(self) -> Spec:
        """A graph of two or three sources and some operations."""
        for k in range(self.random.randint(2, 3)):
            self.source(k)
        wanted = len(self.streams) + self.random.randint(4, 9)
        while len(self.streams) < wanted:
            name = self.random.choice(sorted(KINDS))
            KINDS[name](self, name)
        return {"sources": self.sources, "nodes": self.nodes}

    def source(self, k: int) -> None:
        r = self.random
        if r.random() < 0.3:
            period = r.choice((4, 5, 6))
            phase = r.randrange(period)
            times = [phase + period * i for i in range(r.randint(3, 10))]
            timing: list[Any] = ["periodic", period, phase]
        else:
            times = sorted(r.sample(range(50), r.randint(0 if k else 3, 14)))
            timing = ["aperiodic"]
        late = [r.choice((0, 0, 3, 11)) for _ in times] if r.random() < 0.4 else None
        values = [r.randint(-24, 24) / 4 for _ in times]
        self.sources.append({"times": times, "values": values, "timing": timing, "late": late})
        self.streams.append(Drawn(k, f"s{k}"))

    def any(self) -> Drawn:
        return self.random.choice(self.streams)

    def like(self, one: Drawn) -> Drawn:
        """A stream of the same clock."""
        return self.random.choice([s for s in self.streams if s.clock == one.clock])

    def add(self, op: str, args: list[Drawn], clock: str | None = None, **more: Any) -> None:
        """A node; a clock of its own, unless another is named."""
        number = len(self.streams)
        self.nodes.append({"op": op, "args": [a.number for a in args], **more})
        self.streams.append(Drawn(number, f"n{number}" if clock is None else clock))

    def quarter(self) -> float:
        return self.random.randint(-8, 8) / 4

    def threshold(self) -> float:
        return self.random.randint(-12, 12) / 4 + 0.0713

    def union(self) -> list[Drawn]:
        """One or two streams at whose ticks something happens."""
        return [self.any() for _ in range(self.random.randint(1, 2))]


def _one(op: str, same: bool = True, **draws: Callable[[Draw], Any]) -> Callable[[Draw, str], None]:
    """An operation on one stream, at its clock or at one of its own."""

    def add(d: Draw, name: str) -> None:
        a = d.any()
        d.add(op, [a], a.clock if same else None, **{k: f(d) for k, f in draws.items()})

    return add


def _two(op: str, **draws: Callable[[Draw], Any]) -> Callable[[Draw, str], None]:
    """A join of two streams of any clocks."""

    def add(d: Draw, name: str) -> None:
        d.add(op, [d.any(), d.any()], None, **{k: f(d) for k, f in draws.items()})

    return add


def _apply(d: Draw, name: str) -> None:
    a = d.any()
    d.add("apply", [a, d.like(a)], a.clock, f=d.random.randrange(3))


def _held(d: Draw, name: str) -> None:
    a = d.any()
    d.add(name, [a, d.any()], a.clock, f=d.random.randrange(3), init=d.quarter())


def _sampled(d: Draw, name: str) -> None:
    at = d.union()
    clock = at[0].clock if len(at) == 1 else None
    d.add(name, [d.any(), *at], clock, init=d.quarter())


def _both_held(d: Draw, name: str) -> None:
    at = d.union()
    clock = at[0].clock if len(at) == 1 else None
    inits = [d.quarter(), d.quarter()]
    d.add("both_held", [d.any(), d.any(), *at], clock, f=d.random.randrange(3), inits=inits)


def _every(d: Draw, name: str) -> None:
    n = d.random.randint(1, 4)
    a = d.any()
    phase = d.random.randrange(n)
    d.add("every", [a], a.clock if n == 1 else f"every({n},{phase},{a.clock})", n=n, phase=phase)


def _zip_halves(d: Draw, name: str) -> None:
    n = d.random.randint(2, 4)
    a = d.any()
    d.add("zip", [a, d.like(a)], None, n=n, phases=[d.random.randrange(n), d.random.randrange(n)])


def _optional(d: Draw, name: str) -> None:
    a, z = d.any(), d.any()
    d.add("optional", [a, z], None, init=d.quarter())


def _running(d: Draw, name: str) -> None:
    a = d.any()
    d.add("running", [a], a.clock, init=d.quarter(), dt=d.random.random() < 0.5)


def _window(d: Draw, name: str) -> None:
    at = d.any()
    d.add(name, [d.any(), at], at.clock, init=d.quarter())


def _both_at(d: Draw, name: str) -> None:
    d.add("both_at", [d.any(), d.any()], None, f=d.random.randrange(3))


def _stamp(d: Draw, name: str) -> None:
    source = d.random.randrange(len(d.sources))
    d.add("stamp", [d.streams[source]], d.streams[source].clock)


def _full(d: Draw) -> str:
    return d.random.choice(("error", "drop_oldest", "drop_oldest"))


def _tau(d: Draw) -> int | None:
    return d.random.choice((None, 7))


KINDS: dict[str, Callable[[Draw, str], None]] = {
    "map": _one("map", f=lambda d: d.random.randrange(4)),
    "apply": _apply,
    "filter": _one("filter", same=False, c=Draw.threshold),
    "gate": _one("gate", same=False, c=Draw.threshold),
    "every": _every,
    "drop": _one("drop", same=False, n=lambda d: d.random.randint(1, 4)),
    "take_while": _one("take_while", same=False, c=Draw.threshold),
    "until": _two("until", inclusive=lambda d: d.random.random() < 0.5),
    "scan": _one("scan", init=Draw.quarter),
    "group": _one("group", same=False, k=lambda d: d.random.choice((0, 1, 2, None))),
    "latest": _sampled,
    "delay": _sampled,
    "latest_in": _held,
    "delay_in": _held,
    "both_held": _both_held,
    "both_at": _both_at,
    "zip": _zip_halves,
    "zip_latest": _two("zip_latest", inits=lambda d: [d.quarter(), d.quarter()]),
    "zip_latest_right": _held,
    "zip_last": _two("zip_last"),
    "match": _two(
        "match",
        tolerance=lambda d: d.random.randint(0, 7),
        size=lambda d: d.random.randint(1, 4),
        full=_full,
    ),
    "merge": _two("merge", tie=lambda d: d.random.choice(("left", "right", "mean"))),
    "optional": _optional,
    "running": _running,
    "window": _window,
    "reduce": _window,
    "batch": _one("batch", same=False, n=lambda d: d.random.randint(1, 4)),
    "flat_map": _one("flat_map"),
    "low_pass": _one("low_pass", tau=_tau, init=lambda d: d.random.choice((None, 0.5))),
    "high_pass": _one("high_pass", tau=_tau),
    "delta_time": _one("delta_time"),
    "integrate": _one("integrate", rule=lambda d: d.random.choice(("rectangle", "trapezoid"))),
    "resample": _two(
        "resample",
        how=lambda d: d.random.choice(("linear", "slerp", "hold")),
        size=lambda d: d.random.randint(1, 6),
        full=_full,
    ),
    "absent": _window,
    "label": _one("label"),
    "stamp": _stamp,
}  # fmt: skip
"""How to draw each operation."""


def drawn(seed: int) -> Spec:
    """The random graph of a seed."""
    return Draw(seed).spec()
