"""What a drawn graph means, by the words of docs/semantics.md alone: lists of events in, lists of events out.

A stream is a list of (time, value) in order of time, ms. Nothing here is quick, or shared with any engine.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

from tests.oracle.specs import Spec

Events = list[tuple[int, float]]

ONE = (lambda v: v / 2 + 1, lambda v: -v, lambda v: v * v / 8, lambda v: v - 2)
TWO = (lambda a, b: a + b, lambda a, b: a - b * 2, lambda a, b: a / 4 + a * b / 8)


def pair(a: float, b: float) -> float:
    return a + b * 3


def times(*streams: Events) -> list[int]:
    """The ticks of a clock that is the union of these."""
    return sorted({t for s in streams for t, _ in s})


def arc(v: float, x: float) -> float:
    """The shortest way from a turn about one axis to another, in halves of the turns; q and -q are one."""
    return (x - v + math.pi / 2) % math.pi - math.pi / 2


def seen(half: float) -> float:
    """A number of the quaternion of a turn about z, by half of its angle."""
    return math.cos(half) + 2 * math.sin(half)


def last(s: Events, t: int, otherwise: Any, *, before: bool = False) -> Any:
    """The value of a stream at or before a time, or strictly before it."""
    found = [v for u, v in s if (u < t if before else u <= t)]
    return found[-1] if found else otherwise


def at(s: Events, t: int) -> list[float]:
    return [v for u, v in s if u == t]


class Meaning:
    """The streams of a graph, one after the other, what its joins discarded (`counts`), and the first time at
    which one of them was full (`full`)."""

    def __init__(self, spec: Spec) -> None:
        self.streams: list[Events] = []
        self.counts: Counter[str] = Counter()
        self.late: list[list[int]] = []
        self.full: int | None = None
        for source in spec["sources"]:
            self.streams.append(list(zip(source["times"], source["values"], strict=True)))
            self.late.append(source["late"] or [0] * len(source["times"]))
        for node in spec["nodes"]:
            given = [self.streams[k] for k in node["args"]]
            rule: Callable[..., Events] = getattr(self, f"do_{node['op']}")
            self.streams.append(rule(node, *given))

    def is_full(self, n, t):
        if n.get("full") == "error" and (self.full is None or t < self.full):
            self.full = t

    # -- joins of one clock, registers -------------------------------------------------------------------

    def do_map(self, n, a):
        return [(t, ONE[n["f"]](v)) for t, v in a]

    def do_apply(self, n, a, b):
        return [(t, TWO[n["f"]](v, at(b, t)[0])) for t, v in a]

    def do_both_at(self, n, a, b):
        return [(t, TWO[n["f"]](v, at(b, t)[0])) for t, v in a if at(b, t)]

    def do_latest(self, n, a, *clocks):
        return [(t, last(a, t, n["init"])) for t in times(*clocks)]

    def do_delay(self, n, a, *clocks):
        return [(t, last(a, t, n["init"], before=True)) for t in times(*clocks)]

    def do_latest_in(self, n, a, b):
        return [(t, TWO[n["f"]](v, last(b, t, n["init"]))) for t, v in a]

    def do_delay_in(self, n, a, b):
        return [(t, TWO[n["f"]](v, last(b, t, n["init"], before=True))) for t, v in a]

    def do_both_held(self, n, a, b, *clocks):
        x, y = n["inits"]
        return [(t, TWO[n["f"]](last(a, t, x), last(b, t, y))) for t in times(*clocks)]

    def do_running(self, n, a):
        made, y, before = [], n["init"], None
        for t, x in a:
            dt = 0.0 if before is None else (t - before) / 1000
            y = y / 2 + x + (8 * dt if n["dt"] else 0.0)
            made.append((t, y))
            before = t
        return made

    def do_optional(self, n, a, z):
        made = []
        for t in times(a, z):
            prior, there = last(a, t, n["init"]), at(z, t)
            made.append((t, (prior + there[0]) / 2 if there else prior))
        return made

    # -- joins of two clocks -----------------------------------------------------------------------------

    def do_zip(self, n, a, b):
        p, q = n["phases"]
        left, right = a[p :: n["n"]], b[q :: n["n"]]
        return [(max(t, u), pair(v, w)) for (t, v), (u, w) in zip(left, right, strict=False)]

    def do_zip_latest(self, n, a, b):
        x, y = n["inits"]
        return [(t, pair(last(a, t, x), last(b, t, y))) for t in times(a, b)]

    def do_zip_latest_right(self, n, a, b):
        return [(t, pair(v, last(b, t, n["init"]))) for t, v in a]

    def do_zip_last(self, n, a, b):
        made, since = [], -1
        for t in times(a, b):
            new_a = [v for u, v in a if since < u <= t]
            new_b = [v for u, v in b if since < u <= t]
            if new_a and new_b:
                made.append((t, pair(new_a[-1], new_b[-1])))
                since = t
        return made

    def do_match(self, n, a, b):
        made: Events = []
        waiting: dict[str, Events] = {"a": [], "b": []}
        span = n["tolerance"]

        def expire(side: str, gone: Events) -> None:
            self.counts[f"expired_{side}"] += len(gone)
            waiting[side] = [e for e in waiting[side] if e not in gone]

        for t in times(a, b):
            fresh = {"a": at(a, t), "b": at(b, t)}
            if fresh["a"] and fresh["b"]:
                for side in "ab":
                    expire(side, list(waiting[side]))
                made.append((t, pair(fresh["a"][0], fresh["b"][0])))
                continue
            mine, other = ("a", "b") if fresh["a"] else ("b", "a")
            value = fresh[mine][0]
            near = [e for e in waiting[other] if t - e[0] <= span]
            expire(other, [e for e in waiting[other] if t - e[0] > span])
            if near:
                taken = near[-1]
                expire(other, [e for e in waiting[other] if e[0] < taken[0]])
                waiting[other].remove(taken)
                expire(mine, list(waiting[mine]))
                made.append((t, pair(value, taken[1]) if mine == "a" else pair(taken[1], value)))
            else:
                waiting[mine].append((t, value))
                if len(waiting[mine]) > n["size"]:
                    expire(mine, waiting[mine][:1])
                    self.is_full(n, t)
        return made

    def do_merge(self, n, a, b):
        made = []
        for t in times(a, b):
            x, y = at(a, t), at(b, t)
            if x and y:
                made.append((t, {"left": x[0], "right": y[0], "mean": (x[0] + y[0]) / 2}[n["tie"]]))
            else:
                made.append((t, (x or y)[0]))
        return made

    # -- operations on one stream ------------------------------------------------------------------------

    def do_filter(self, n, a):
        return [(t, v) for t, v in a if v > n["c"]]

    def do_gate(self, n, a):
        return [(t, v + 1) for t, v in a if v > n["c"]]

    def do_every(self, n, a):
        return a[n["phase"] :: n["n"]]

    def do_drop(self, n, a):
        return a[n["n"] :]

    def do_take_while(self, n, a):
        ends = [k for k, (_, v) in enumerate(a) if not v < n["c"]]
        return a[: ends[0]] if ends else a

    def do_until(self, n, a, b):
        if not b:
            return a
        return [(t, v) for t, v in a if t < b[0][0] or (t == b[0][0] and n["inclusive"])]

    def do_scan(self, n, a):
        made, y = [], n["init"]
        for t, x in a:
            y = y / 2 - x
            made.append((t, y))
        return made

    def do_group(self, n, a):
        key = lambda v: math.floor(v) % 5
        return [(t, v) for t, v in a if (key(v) == n["k"] if n["k"] is not None else key(v) > 2)]

    def do_window(self, n, a, b):
        made, since = [], -1
        for t, _ in b:
            inside = [v for u, v in a if since < u <= t]
            made.append((t, sum(inside) + 100 * len(inside)))
            since = t
        return made

    def do_reduce(self, n, a, b):
        made, since = [], -1
        for t, _ in b:
            y = n["init"]
            for u, v in a:
                if since < u <= t:
                    y = y / 2 + v
            made.append((t, y))
            since = t
        return made

    def do_batch(self, n, a):
        size = n["n"]
        ends = range(size - 1, len(a), size)
        return [(a[k][0], sum(v for _, v in a[k + 1 - size : k + 1])) for k in ends]

    def do_flat_map(self, n, a):
        made = []
        for t, v in a:
            inside = ([v] if v > 0.03 else []) + ([2 * v] if v > -1.03 else [])
            made.append((t, sum(inside) + 100 * len(inside)))
        return made

    # -- time --------------------------------------------------------------------------------------------

    def do_low_pass(self, n, a):
        made, y, before = [], n["init"], None
        for t, x in a:
            dt = 0.0 if before is None else t - before
            share = 0.25 if n["tau"] is None else 1 - math.exp(-dt / n["tau"])
            y = x if y is None else y + share * (x - y)
            made.append((t, y))
            before = t
        return made

    def do_high_pass(self, n, a):
        made, y, before = [], None, None
        for t, x in a:
            dt = 0.0 if before is None else t - before[0]
            keep = 0.25 if n["tau"] is None else math.exp(-dt / n["tau"])
            y = 0.0 if before is None else keep * (y + x - before[1])
            made.append((t, y))
            before = t, x
        return made

    def do_delta_time(self, n, a):
        return [(t, (t - a[k - 1][0]) / 1000 if k else 0.0) for k, (t, _) in enumerate(a)]

    def do_integrate(self, n, a):
        made, total = [], 0.0
        for k, (t, x) in enumerate(a):
            if k:
                u, w = a[k - 1]
                total += (t - u) / 1000 * (x if n["rule"] == "rectangle" else (x + w) / 2)
            made.append((t, total))
        return made

    def do_absent(self, n, a, b):
        made = []
        for t, _ in b:
            came = [u for u, _ in a if u <= t]
            start = min(times(a, b))
            made.append((t, float(t - (came[-1] if came else start) > 6)))
        return made

    def do_label(self, n, a):
        return [(t, pair(v, t)) for t, v in a]

    def do_resample(self, n, a, b):
        made: Events = []
        if n["how"] == "hold":
            for t, _ in b:
                if last(a, t, None) is None:
                    self.counts["expired"] += 1
                else:
                    made.append((t, last(a, t, None) + t))
            return made
        waits: list[int] = []
        for t in times(a, b):
            if at(b, t):
                if last(a, t, None) is None:
                    self.counts["expired"] += 1
                else:
                    waits.append(t)
            if waits and any(waits[0] <= u <= t for u, _ in a):
                asked = waits.pop(0)
                u, v = [e for e in a if e[0] <= asked][-1]
                if u < asked:
                    w, x = next(e for e in a if e[0] > asked)
                    along = arc(v, x) if n["how"] == "slerp" else x - v
                    v = v + along * ((asked - u) / (w - u))
                made.append((t, (seen(v) if n["how"] == "slerp" else v) + asked))
            if len(waits) > n["size"]:
                waits.pop(0)
                self.counts["expired"] += 1
                self.is_full(n, t)
        return made

    def do_stamp(self, n, a):
        source = next(k for k, s in enumerate(self.streams) if s is a)
        return [(t, float(t - late)) for (t, _), late in zip(a, self.late[source], strict=True)]
