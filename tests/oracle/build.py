"""A drawn graph declared with flowgraph; every stream is an output, as a scalar."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import (
    Graph,
    Scalar,
    Series,
    Stream,
    absent_for,
    aperiodic,
    apply,
    batch,
    block,
    delay,
    delta_time,
    drop,
    every,
    flat_map,
    graph,
    group_by,
    high_pass,
    integrate,
    label_data,
    latest,
    low_pass,
    match,
    merge,
    periodic,
    reduce,
    resample_at,
    scan,
    stamp_of,
    take_while,
    until,
    when,
    window,
    zip,
    zip_last,
    zip_latest,
    zip_latest_right,
)
from tests.oracle.specs import MS, Spec

ONE: tuple[Callable[[Any], Any], ...] = (
    lambda v: 0.5 * v + 1.0,
    lambda v: -v,
    lambda v: 0.125 * v * v,
    lambda v: v - 2.0,
)
TWO: tuple[Callable[[Any, Any], Any], ...] = (
    lambda a, b: a + b,
    lambda a, b: a - 2.0 * b,
    lambda a, b: 0.25 * a + 0.125 * a * b,
)
PAIR = lambda p: p[0] + 3.0 * p[1]
WIDE = 64


@block
def gate(x: Scalar, *, c: float) -> tuple[Scalar, Scalar | None]:
    return x, when(x > c, x + 1.0)


@block
def corrected(prior: Scalar, z: Scalar | None) -> Scalar:
    return prior if z is None else 0.5 * (prior + z)


@block
def stepped(x: Scalar, before: Scalar, *, dt: float) -> Scalar:
    return 0.5 * before + x + 8.0 * dt


def _at(streams: list[Stream[Any]]) -> Any:
    return streams[0] if len(streams) == 1 else streams[0] | streams[1]


def _running(n: dict[str, Any], a: Stream[Any]) -> Stream[Any]:
    held = delay(n["init"])
    new = stepped(a, held) if n["dt"] else apply(lambda x, y: 0.5 * y + x, a, held)
    held.feed(new)
    return new


def _zip(n: dict[str, Any], a: Stream[Any], b: Stream[Any]) -> Stream[Any]:
    p, q = n["phases"]
    return zip(a.every(n["n"], phase=p), b.every(n["n"], phase=q)).map(PAIR)


def _group(n: dict[str, Any], a: Stream[Any]) -> Stream[Any]:
    key = lambda v, *, xp: xp.astype(xp.floor(v), xp.int32) % np.int32(5)
    return group_by(a, key, (0, 1, 2))[n["k"]]


def _sum(w: Any, *, xp: Any) -> Any:
    return xp.sum(w.values) + 100.0 * xp.astype(w.count, xp.float64)


def _resample(n: dict[str, Any], a: Stream[Any], b: Stream[Any]) -> Stream[Any]:
    how = {"how": n["how"], "size": n["size"], "full": n["full"]}
    if n["how"] != "slerp":
        return resample_at(a, b, **how).map(lambda p, *, xp: p[1] + 1e-6 * xp.astype(p[0], xp.float64))
    turned = a.map(lambda v, *, xp: xp.stack([xp.cos(v), 0.0 * v, 0.0 * v, xp.sin(v)]))
    return resample_at(turned, b, **how).map(
        lambda p, *, xp: p[1][0] + 2.0 * p[1][3] + 1e-6 * xp.astype(p[0], xp.float64)
    )


def _optional(n: dict[str, Any], a: Stream[Any], z: Stream[Any]) -> Stream[Any]:
    return corrected(latest(a, init=n["init"]).at(a | z), z)


BUILD: dict[str, Callable[..., Any]] = {
    "map": lambda n, a: a.map(ONE[n["f"]]),
    "apply": lambda n, a, b: apply(TWO[n["f"]], a, b),
    "filter": lambda n, a: a.filter(lambda v, c=n["c"]: v > c),
    "gate": lambda n, a: gate(a, c=n["c"])[1],
    "every": lambda n, a: every(n["n"], a, phase=n["phase"]),
    "drop": lambda n, a: drop(n["n"], a),
    "take_while": lambda n, a: take_while(a, lambda v, c=n["c"]: v < c),
    "until": lambda n, a, b: until(a, b, inclusive=n["inclusive"]),
    "scan": lambda n, a: scan(a, lambda y, x: 0.5 * y - x, init=n["init"]),
    "group": _group,
    "latest": lambda n, a, *at: latest(a, init=n["init"]).at(_at(list(at))),
    "delay": lambda n, a, *at: a.delay(n["init"]).at(_at(list(at))),
    "latest_in": lambda n, a, b: apply(TWO[n["f"]], a, latest(b, init=n["init"])),
    "delay_in": lambda n, a, b: apply(TWO[n["f"]], a, b.delay(n["init"])),
    "both_held": lambda n, a, b, *at: apply(
        TWO[n["f"]], latest(a, init=n["inits"][0]), latest(b, init=n["inits"][1]), at=_at(list(at))
    ),
    "both_at": lambda n, a, b: apply(TWO[n["f"]], a, b, at=a & b),
    "zip": _zip,
    "zip_latest": lambda n, a, b: zip_latest(a, b, init=tuple(n["inits"])).map(PAIR),
    "zip_latest_right": lambda n, a, b: zip_latest_right(a, b, init=n["init"]).map(PAIR),
    "zip_last": lambda n, a, b: zip_last(a, b).map(PAIR),
    "match": lambda n, a, b: match(
        a, b, tolerance=n["tolerance"] * MS, size=n["size"], full=n.get("full", "drop_oldest")
    ).map(PAIR),
    "merge": lambda n, a, b: merge(a, b, tie=n["tie"] if n["tie"] != "mean" else lambda x, y: 0.5 * (x + y)),
    "optional": _optional,
    "running": _running,
    "window": lambda n, a, at: window(a, at=at, size=WIDE).map(_sum),
    "reduce": lambda n, a, at: reduce(a, lambda y, x: 0.5 * y + x, init=n["init"], at=at),
    "batch": lambda n, a: batch(n["n"], a).map(lambda v, *, xp: xp.sum(v)),
    "flat_map": lambda n, a: flat_map(
        a, lambda v, *, xp: (xp.stack([v, 2.0 * v]), xp.stack([v > 0.03, v > -1.03])), size=2
    ).map(_sum),
    "low_pass": lambda n, a: low_pass(a, init=n["init"], **_share(n)),
    "high_pass": lambda n, a: high_pass(a, **_share(n)),
    "delta_time": lambda n, a: delta_time(a).map(lambda v: 1.0 * v),  # seconds fit no other unit
    "integrate": lambda n, a: integrate(a, rule=n["rule"]),
    "resample": _resample,
    "absent": lambda n, a, at: absent_for(a, 6 * MS, at=at).map(lambda v, *, xp: xp.astype(v, xp.float64)),
    "label": lambda n, a: label_data(a, lambda t, *, xp: xp.astype(t, xp.float64) * 1e-6).map(PAIR),
    "stamp": lambda n, a: stamp_of(a).map(lambda t, *, xp: xp.astype(t, xp.float64) * 1e-6),
}


def _share(n: dict[str, Any]) -> dict[str, Any]:
    return {"alpha": 0.25} if n["tau"] is None else {"tau": n["tau"] * MS}


@graph
def three(a: Stream[Scalar], b: Stream[Scalar], c: Stream[Scalar] | None = None, *, spec: Spec):
    streams: list[Stream[Any]] = [a, b] if c is None else [a, b, c]
    found = {}
    for k, node in enumerate(spec["nodes"], start=len(streams)):
        made = BUILD[node["op"]](node, *(streams[i] for i in node["args"]))
        streams.append(made)
        found[f"n{k}"] = made
    for k, source in enumerate(streams[: len(spec["sources"])]):
        found[f"n{k}"] = source.map(lambda v: v)
    return found


def built(spec: Spec) -> Graph:
    """The graph of a spec."""
    timings: dict[str, Any] = {}
    for name, source in dict(_named(spec)).items():
        kind, *more = source["timing"]
        timings[name] = aperiodic() if kind == "aperiodic" else periodic(more[0] * MS, phase=more[1] * MS)
    return three.build(**timings, spec=spec)


def inputs_of(spec: Spec) -> dict[str, Series]:
    """The events of its sources."""
    made = {}
    for name, source in _named(spec):
        time = np.array(source["times"], np.int64) * MS
        late = source["late"]
        stamp = None if late is None else time - np.array(late, np.int64) * MS
        made[name] = Series(time, np.array(source["values"], float), stamp=stamp, name=name)
    return made


def _named(spec: Spec) -> list[tuple[str, Any]]:
    return [("abc"[k], source) for k, source in enumerate(spec["sources"])]
