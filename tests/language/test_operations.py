"""Stream operations: each against a model in plain Python on random events in all engines; refusals."""

from __future__ import annotations

import enum
import functools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flowgraph import (
    Array,
    DeclarationError,
    FifoOverflowError,
    LoweringError,
    Run,
    Scalar,
    Series,
    Signal,
    Stream,
    TypeMismatchError,
    aperiodic,
    apply,
    batch,
    block,
    delta_time,
    drop,
    every,
    flat_map,
    graph,
    group_by,
    high_pass,
    integer,
    integrate,
    latest,
    low_pass,
    lower,
    padded,
    periodic,
    real,
    reduce,
    scan,
    simulate,
    stacked,
    take_while,
    tap,
    until,
    unzip,
    window,
    zip,
)
from flowgraph.language.clock import equal, within
from flowgraph.types import ArrayType
from tests.support import MS, all_engines, close, pairs, scalars


class Reading(Signal):
    rate: Array = real(3, unit="rad/s", frame="body")
    level: Array = real(unit="m")


# -- every operation against its model ---------------------------------------------------------------

MODELS = {}
"""Name of an output of `everything` -> its model, `(events of x, times of y) -> [(time, value)]`."""


def model(function):
    MODELS[function.__name__] = function
    return function


def third(v, *, xp):
    return xp.astype(xp.floor(v), xp.int32) % 3


def twice(v, *, xp):
    return xp.stack([v, 2.0 * v, v * v]), xp.stack([v > 0.0, v < 3.0, v > 100.0])


@graph
def everything(x: Stream[Scalar], y: Stream[Scalar]):
    groups = group_by(x, third, keys=(0, 1))
    left, right = unzip(apply(lambda v: (v, v > 0.0), x))
    return {
        "low": low_pass(x, alpha=0.3),
        "low_from": low_pass(x, alpha=0.3, init=2.0),
        "low_slow": low_pass(x, tau="7ms"),
        "high": high_pass(x, alpha=0.9),
        "high_from": high_pass(x, alpha=0.9, init=2.0),
        "high_slow": high_pass(x, tau="7ms"),
        "taken": take_while(x, lambda v: v < 4.0),
        "stopped": until(x, y),
        "stopped_after": until(x, y, inclusive=True),
        "dropped": drop(3, x),
        "scanned": scan(x, lambda total, v: 0.5 * total + v, init=1),
        "largest": reduce(x, lambda most, v, *, xp: xp.maximum(most, v), init=-1.0, at=y),
        "collected": window(x, at=y, size=30),
        "counted": window(x, at=every(4, x), size=4),
        "batched": batch(3, x),
        "sparse": batch(2, every(3, x)),
        "group_0": groups[0],
        "group_1": groups[1],
        "group_rest": groups[None],
        "first": left,
        "second": right,
        "elapsed": delta_time(x),
        "area": integrate(x),
        "trapezoids": integrate(x, rule="trapezoid", init=3.0),
        "several": flat_map(x, twice, size=3),
    }


@functools.cache
def built():
    return everything.build()


def recursive(share, first):
    """A first-order recursion y = first(x), then y + share(dt) (x - y)."""

    def run(xs, ys):
        out, before = [], None
        for t, v in xs:
            y = first(v) if before is None else out[-1][1] + share((t - before) * 1e-9) * (v - out[-1][1])
            out.append((t, y))
            before = t
        return out

    return run


def slow(dt):
    return 1.0 - math.exp(-dt / 7e-3)


MODELS["low"] = recursive(lambda dt: 0.3, lambda v: v)
MODELS["low_from"] = recursive(lambda dt: 0.3, lambda v: 2.0 + 0.3 * (v - 2.0))
MODELS["low_slow"] = recursive(slow, lambda v: v)


@model
def high(xs, ys, first=lambda v: 0.0, keep=lambda dt: 0.9):
    out = []
    for k, (t, v) in enumerate(xs):
        if k == 0:
            out.append((t, first(v)))
        else:
            before, x = xs[k - 1]
            out.append((t, keep((t - before) * 1e-9) * (out[-1][1] + v - x)))
    return out


MODELS["high_from"] = functools.partial(high, first=lambda v: 0.9 * (v - 2.0))
MODELS["high_slow"] = functools.partial(high, keep=lambda dt: math.exp(-dt / 7e-3))


@model
def taken(xs, ys):
    bad = next((k for k, (_, v) in enumerate(xs) if v >= 4.0), len(xs))
    return xs[:bad]


@model
def stopped(xs, ys):
    return [(t, v) for t, v in xs if not ys or t < ys[0]]


@model
def stopped_after(xs, ys):
    return [(t, v) for t, v in xs if not ys or t <= ys[0]]


@model
def dropped(xs, ys):
    return xs[3:]


@model
def scanned(xs, ys):
    out, total = [], 1.0
    for t, v in xs:
        total = 0.5 * total + v
        out.append((t, total))
    return out


def parts(xs, ys):
    """The values of x in each (y before, y]."""
    return [(t, [v for s, v in xs if (k == 0 or ys[k - 1] < s) and s <= t]) for k, t in enumerate(ys)]


@model
def largest(xs, ys):
    return [(t, max([-1.0, *inside])) for t, inside in parts(xs, ys)]


def pad(inside, size):
    return inside + [0.0] * (size - len(inside)), [k < len(inside) for k in range(size)], len(inside)


@model
def collected(xs, ys):
    return [(t, pad(inside, 30)) for t, inside in parts(xs, ys)]


@model
def counted(xs, ys):
    return [(t, pad(inside, 4)) for t, inside in parts(xs, [t for t, _ in xs][::4])]


@model
def batched(xs, ys):
    return [(xs[k + 2][0], [v for _, v in xs[k : k + 3]]) for k in range(0, len(xs) - 2, 3)]


@model
def sparse(xs, ys):
    kept = xs[::3]
    return [(kept[k + 1][0], [v for _, v in kept[k : k + 2]]) for k in range(0, len(kept) - 1, 2)]


def of_group(keys):
    return lambda xs, ys: [(t, v) for t, v in xs if math.floor(v) % 3 in keys]


MODELS["group_0"], MODELS["group_1"], MODELS["group_rest"] = of_group([0]), of_group([1]), of_group([2])
MODELS["first"] = lambda xs, ys: xs
MODELS["second"] = lambda xs, ys: [(t, v > 0.0) for t, v in xs]


@model
def elapsed(xs, ys):
    return [(t, (t - xs[max(k - 1, 0)][0]) * 1e-9) for k, (t, _) in enumerate(xs)]


@model
def area(xs, ys):
    steps = elapsed(xs, ys)
    return [
        (t, sum(v * dt for (_, v), (_, dt) in list(map(lambda *p: p, xs, steps))[: k + 1]))
        for k, (t, _) in enumerate(xs)
    ]


@model
def trapezoids(xs, ys):
    out, total = [], 3.0
    for k, (t, v) in enumerate(xs):
        before, last = xs[max(k - 1, 0)]
        total += 0.5 * (last + v) * (t - before) * 1e-9
        out.append((t, total))
    return out


@model
def several(xs, ys):
    out = []
    for t, v in xs:
        mask = [v > 0.0, v < 3.0, v > 100.0]
        values = [value * here for value, here in list(map(lambda *p: p, (v, 2.0 * v, v * v), mask))]
        out.append((t, (values, mask, sum(mask))))
    return out


numbers = st.floats(-8, 8, allow_subnormal=False)
stamps = st.integers(0, 60).map(lambda t: t * MS)
events = st.dictionaries(stamps, numbers, max_size=30).map(lambda d: sorted(d.items()))
times = st.sets(stamps, max_size=12).map(sorted)


def test_every_operation_has_a_model():
    assert sorted(MODELS) == sorted(c.name for c in built().collected)


@pytest.mark.parametrize("name", MODELS)
@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow])
@given(events, times)
def test_against_its_model_in_all_engines(name, xs, ys):
    data = {"x": scalars([t for t, _ in xs], [v for _, v in xs]), "y": scalars(ys)}
    expected = MODELS[name](xs, ys)
    series = all_engines(built(), data)[name]
    assert series.time.tolist() == [t for t, _ in expected]
    leaves = list(series.leaves.values())
    for k, (_, value) in enumerate(expected):
        for leaf, part in map(lambda *p: p, leaves, value if isinstance(value, tuple) else (value,)):
            close(leaf[k], np.asarray(part, leaf.dtype), name, exact=False)


# -- what the models do not show ---------------------------------------------------------------------


def run(body, x, y=None, /, **clocks):
    """The output of a graph of one or two sources, the same in all engines."""
    if y is None:

        @graph
        def one(x: Stream[Scalar]):
            return body(x)

        return all_engines(one.build(**clocks), {"x": x})

    @graph
    def two(x: Stream[Scalar], y: Stream[Scalar]):
        return body(x, y)

    return all_engines(two.build(**clocks), {"x": x, "y": y})


def build(body):
    @graph
    def g(x: Stream[Scalar]):
        out = body(x)
        return out if isinstance(out, Stream) else x

    return g.build()


def test_low_and_high_pass_add_up_to_the_stream():
    def body(x):
        fixed = low_pass(x, alpha=0.25) + high_pass(x, alpha=0.75)
        return {"fixed": fixed, "slow": low_pass(x, tau="5ms") + high_pass(x, tau="5ms")}

    values = np.random.default_rng(1).normal(size=20)
    result = run(body, scalars(np.cumsum(np.arange(1, 21)) * MS, values))
    np.testing.assert_allclose(result.fixed["value"], values, atol=1e-15)
    np.testing.assert_allclose(result.slow["value"], values, atol=1e-15)


def test_a_time_constant_does_not_depend_on_how_a_held_value_is_split():
    coarse, fine = [0, 10 * MS], [0, 1 * MS, 4 * MS, 10 * MS]
    body = lambda x: low_pass(x, tau="4ms", init=0.0)
    ends = [
        run(body, scalars(ts, [0.0] + [1.0] * (len(ts) - 1))).output["value"][-1] for ts in (coarse, fine)
    ]
    assert ends[0] == pytest.approx(1.0 - math.exp(-2.5), abs=1e-15)
    assert ends[1] == pytest.approx(ends[0], abs=1e-15)


def test_alpha_one_passes_everything_and_keeps_every_change():
    result = run(
        lambda x: {"low": low_pass(x, alpha=1), "high": high_pass(x, alpha=1)},
        scalars([0, 1, 2], [3.0, 5.0, 4.0]),
    )
    assert result.low["value"].tolist() == [3.0, 5.0, 4.0]
    assert result.high["value"].tolist() == [0.0, 2.0, 1.0]


def readings(n):
    k = np.arange(float(n))
    return Series(np.arange(n) * MS, Reading(rate=np.stack([k, -k, 2 * k], axis=1), level=10.0 + k))


def test_signals_keep_their_type_their_units_and_their_names():
    @graph
    def g(r: Stream[Reading]):
        smooth = low_pass(r, alpha=0.5, init=Reading(rate=np.zeros(3), level=10.0))
        full = window(r, at=every(3, r, phase=2), size=4)
        return {
            "smooth": smooth,
            "pair": batch(2, r),
            "full": full,
            "rate": full.map(lambda w: w.values.rate),
            "mean": full.map(lambda w, *, xp: xp.sum(w.values.level) / xp.astype(w.count, xp.float64)),
            "angle": integrate(r.map(lambda v: v.rate)),
        }

    built = g.build()
    types = {c.name: built.port(c.wire).type for c in built.collected}
    assert types["smooth"] == built.sources["r"].type
    assert str(types["rate"]) == "real[4,3], rad/s, body"
    assert str(types["angle"]) == "real[3], rad, body"
    assert str(types["pair"]) == "Reading[2]"
    assert str(types["full"]) == "Padded[Reading[4]]"
    result = all_engines(built, {"r": readings(6)})
    assert result.smooth["level"].tolist()[:3] == [10.0, 10.5, 11.25]
    assert result.pair["rate"].shape == (3, 2, 3)
    assert result.full["values.level"].tolist() == [[10.0, 11.0, 12.0, 0.0], [13.0, 14.0, 15.0, 0.0]]
    assert result.full["mask"].tolist() == [[True, True, True, False]] * 2
    assert result.mean["value"].tolist() == [11.0, 14.0]


def test_a_padded_value_can_be_held():
    Held: Any = padded(real(), 2)
    nothing = Held(values=np.zeros(2), mask=np.zeros(2, bool), count=np.int32(0))

    def body(x, y):
        return latest(window(x, at=y, size=2), init=nothing).at(x).map(lambda w: w.count)

    result = run(body, scalars([0, 1, 3]), scalars([1]))
    assert [v for _, v in pairs(result.output)] == [0, 2, 2]


def test_equal_padded_and_stacked_types_are_one():
    assert padded(real(3, unit="m"), 4) is padded(real(3, unit="m"), 4)
    assert padded(Reading, 4) is padded(Reading, 4)
    assert stacked(Reading, 4) == stacked(Reading, 4)
    assert stacked((tuple_of := tuple[float, bool]), 2) == stacked(tuple_of, 2)


def test_integers_and_tuples_go_into_windows_and_batches():
    @graph
    def g(k: Stream[integer()]):  # type: ignore[valid-type]
        both = apply(lambda v: (v, v > 1), k)
        return {"batch": batch(2, both), "window": window(both, at=every(2, k), size=3)}

    result = all_engines(g.build(), {"k": ([0, 1, 2], np.array([1, 2, 3], np.int32))})
    assert result.batch["0"].tolist() == [[1, 2]]
    assert result.batch["0"].dtype == np.int32
    assert result.batch["1"].tolist() == [[False, True]]
    assert result.window["values.1"].tolist() == [[False, False, False], [True, True, False]]


def test_a_fold_may_hold_a_tuple_and_takes_an_integer_for_a_real():
    def body(x):
        return scan(x, lambda s, v: (s[0] + v, s[1] + 1), init=(0.0, 0)).map(lambda s: s[0] / s[1])

    assert [v for _, v in pairs(run(body, scalars([0, 1, 2])).output)] == [1.0, 1.5, 2.0]
    assert (
        run(lambda x: scan(x, lambda s, v: s + v, init=0), scalars([0, 1])).output["value"].dtype
        == np.float64
    )


def test_symbolic_sizes_are_bound_first():
    @graph
    def g(x: Stream[real("N", unit="m")]):  # type: ignore[valid-type]
        return {
            "low": low_pass(x, alpha=0.5),
            "batch": batch(2, x),
            "window": window(x, at=every(2, x), size=3),
        }

    result = all_engines(g.build(sizes={"N": 4}), {"x": ([0, 5, 9], np.arange(12.0).reshape(3, 4))})
    assert result.batch["value"].shape == (1, 2, 4)
    assert result.window["values"].shape == (2, 3, 4)
    with pytest.raises(DeclarationError, match="size 'N' is not bound"):
        g.build()


def test_the_unit_of_an_integral():
    for unit, integral in (
        ("m/s^2", "m/s"),
        ("m/s", "m"),
        ("rad/s", "rad"),
        ("m", "m*s"),
        ("1", "s"),
        (None, None),
    ):

        @graph
        def g(x: Stream[real(unit=unit)]):  # type: ignore[valid-type]
            return integrate(x)

        built = g.build()
        kind = built.port(built.collected[0].wire).type
        assert isinstance(kind, ArrayType)
        assert kind.unit == integral


def test_clocks_that_the_build_knows():
    def body(x):
        assert equal(drop(2, x).clock, drop(2, x.map(lambda v: -v)).clock)
        assert not equal(drop(2, x).clock, drop(3, x).clock)
        assert equal(batch(3, x).clock, every(3, x, phase=2).clock)
        assert equal(low_pass(x, alpha=0.5).clock, x.clock)
        assert equal(window(x, at=every(2, x), size=2).clock, every(2, x).clock)
        assert equal(reduce(x, lambda a, v: a + v, init=0.0, at=every(2, x).clock).clock, every(2, x).clock)
        for part in group_by(x, lambda v: v > 0.0, keys=(True, False)).values():
            assert within(part.clock, x.clock)
        assert within(take_while(x, lambda v: v > 0.0).clock, x.clock)
        assert within(until(x, every(3, x)).clock, x.clock)

    build(body)


def test_what_is_known_equal_is_present_together():
    both = lambda x: apply(lambda a, b: a - b[2], every(3, x, phase=2), batch(3, x))
    assert run(both, scalars(range(9))).output["value"].tolist() == [0.0, 0.0, 0.0]
    dropped = run(lambda x: zip(drop(2, x), drop(2, x.map(lambda v: -v))), scalars(range(5))).output
    assert dropped["0"].tolist() == [3.0, 4.0, 5.0]
    assert dropped["1"].tolist() == [-3.0, -4.0, -5.0]


def test_a_window_closes_at_any_clock():
    result = run(
        lambda x, y: window(x, at=every(2, x | y), size=3).map(lambda w: w.count),
        scalars([0, 10, 20]),
        scalars([10, 15, 20]),
    )
    assert pairs(result.output) == [(0, 1), (15, 1)]


def test_a_window_of_a_filtered_stream():
    result = run(
        lambda x: window(x.filter(lambda v: v > 1.5), at=every(2, x, phase=1), size=2).map(
            lambda w: w.values
        ),
        scalars(range(4), [1.0, 2.0, 3.0, 4.0]),
    )
    assert result.output["value"].tolist() == [[2.0, 0.0], [3.0, 4.0]]


def test_a_full_window_is_an_error_that_names_it_its_bound_and_the_time():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return window(x, at=y, size=2, name="recent")

    assert len(simulate(g.build(), {"x": scalars([0, 10]), "y": scalars([15])}).output) == 1
    over = {"x": scalars([0, 10, 20, 30]), "y": scalars([35])}
    messages = set()
    for engine in ("python", "reference", "xla"):
        with pytest.raises(FifoOverflowError) as error:
            simulate(g.build(), over, engine=engine)
        messages.add(str(error.value))
    (message,) = messages
    for word in ("recent: the window is full", "at most 2", "t = 20 ns", "size="):
        assert word in message


def test_groups_by_an_enumeration():
    class Kind(enum.IntEnum):
        LOW = 0
        HIGH = 1

    def body(x):
        groups = group_by(x, lambda v, *, xp: xp.astype(v > 2.0, xp.int32), keys=tuple(Kind), name="kinds")
        assert groups[Kind.HIGH].label == "kinds[1]"
        return groups[Kind.HIGH]

    assert run(body, scalars([0, 1, 2, 3])).output["value"].tolist() == [3.0, 4.0]


def test_methods_read_as_the_functions():
    result = run(lambda x: x.drop(1).take_while(lambda v: v < 4.0), scalars(range(5)))
    assert pairs(result.output) == [(1, 2.0), (2, 3.0)]


def test_a_run_resumes_within_every_operation():
    rng = np.random.default_rng(3)
    x, y = scalars(np.arange(20) * MS, rng.normal(size=20)), scalars(np.arange(5, 20, 4) * MS)
    whole = simulate(built(), {"x": x, "y": y})
    cut = lambda s, part: Series(s.time[part], s["value"][part])
    early = Run(built(), {"x": cut(x, slice(0, 8)), "y": cut(y, slice(0, 1))}).to_end()
    late = Run(
        built(), {"x": cut(x, slice(8, None)), "y": cut(y, slice(1, None))}, state=early.state
    ).to_end()
    for name in whole.series:
        joined = np.concatenate([early.result()[name].time, late.result()[name].time])
        assert joined.tolist() == whole[name].time.tolist(), name
        for leaf, values in whole[name].leaves.items():
            halves = [early.result()[name].leaves[leaf], late.result()[name].leaves[leaf]]
            np.testing.assert_array_equal(np.concatenate(halves), values, err_msg=name)


@pytest.mark.parametrize("engine", ["reference", "xla"])
def test_single_precision(engine):
    data = {"x": scalars(np.arange(9) * MS, np.sqrt(np.arange(1.0, 10.0))), "y": scalars([4 * MS, 8 * MS])}
    exact, rounded = (simulate(built(), data, engine=engine, dtype=d) for d in ("float64", "float32"))
    for name in exact.series:
        assert rounded[name].time.tolist() == exact[name].time.tolist(), name
        for leaf, values in exact[name].leaves.items():
            np.testing.assert_allclose(rounded[name].leaves[leaf], values, rtol=1e-5, atol=1e-6, err_msg=name)


# -- the host ----------------------------------------------------------------------------------------


def test_tap_sees_each_value_and_changes_nothing():
    seen: list[float] = []

    @graph
    def g(x: Stream[Scalar]):
        assert tap(x, seen.append) is x
        return x.filter(lambda v: v > 1.0).tap(seen.append).tap(lambda v: 7)

    result = simulate(g.build(), {"x": scalars([0, 1, 2])})
    assert pairs(result.output) == [(1, 2.0), (2, 3.0)]
    assert sorted(seen) == [1.0, 2.0, 2.0, 3.0, 3.0]


def test_lowering_refuses_a_tap_by_name():
    with pytest.raises(LoweringError, match=r"tap\(print\): a host block cannot be lowered"):
        lower(build(lambda x: x.tap(print)))


def test_what_cannot_be_traced_runs_in_python_and_is_refused_by_name():
    def small(v):
        return float(v) < 2.5

    def body(x):
        kept = take_while(x, small)
        return kept, scan(kept, lambda total, v: np.float64(float(total) + float(v)), init=0.0)

    @graph
    def g(x: Stream[Scalar]):
        kept, total = body(x)
        return {"kept": kept, "total": total}

    result = simulate(g.build(), {"x": scalars(range(5))})
    assert pairs(result.kept) == [(0, 1.0), (1, 2.0)]
    assert pairs(result.total) == [(0, 1.0), (1, 3.0)]
    with pytest.raises(LoweringError, match="take_while"):
        lower(g.build())


def test_a_host_block_may_give_padded_values():
    Found: Any = padded(real(2), 3)

    @block(host=True)
    def detect(x) -> Found:  # type: ignore[valid-type]
        return Found(values=np.full((3, 2), float(x)), mask=np.arange(3) < 1, count=np.int32(1))

    built = build(detect)
    out = simulate(built, {"x": scalars([0, 1])}).output
    assert out["values"].shape == (2, 3, 2)
    assert out["count"].tolist() == [1, 1]


# -- what the build refuses --------------------------------------------------------------------------

add = lambda a, v: a + v


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (lambda x: low_pass(x), ["low_pass needs either alpha or tau", "neither"]),
        (lambda x: high_pass(x, alpha=0.5, tau="1s"), ["high_pass needs either alpha or tau", "both"]),
        (lambda x: low_pass(x, alpha=0.0), ["alpha is outside (0, 1]", "alpha=0.0"]),
        (lambda x: low_pass(x, alpha=1.5, name="lp"), ["lp: alpha is outside (0, 1]"]),
        (lambda x: high_pass(x, alpha=-0.1), ["alpha is outside (0, 1]"]),
        (lambda x: high_pass(x, alpha=float("nan")), ["alpha is outside (0, 1]"]),
        (lambda x: low_pass(x, tau="0s"), ["tau must be positive", 'tau="0.5s"']),
        (lambda x: low_pass(x, tau=0.5), ["tau is not understood", "0.5"]),
        (lambda x: low_pass(x, alpha=0.5, init=np.zeros(2)), ["low_pass.init", "the shape"]),
        (lambda x: low_pass(x > 0.0, alpha=0.5), ["low_pass needs real numbers", "bool"]),
        (
            lambda x: take_while(x, lambda v: v + 1.0),
            ["take_while", "does not give a truth value", "got real"],
        ),
        (lambda x: drop(-1, x), ["drop needs a whole number as 'n'", "n from 0", "n=-1"]),
        (lambda x: drop(1.5, x), ["drop needs a whole number as 'n'", "n=1.5"]),  # type: ignore[arg-type]
        (lambda x: batch(0, x), ["batch needs a whole number as 'n'", "n from 1"]),
        (lambda x: batch(True, x), ["batch needs a whole number as 'n'"]),
        (lambda x: window(x, at=x), ["window needs a whole number as 'size'", "size=None"]),
        (lambda x: window(x, at=x, size=0), ["window needs a whole number as 'size'", "size=0"]),
        (lambda x: window(x, size=3), ["window needs the clock at which it closes", "at="]),
        (lambda x: window(x, at=latest(x, init=0.0), size=3), ["this has no clock"]),
        (lambda x: reduce(x, add, init=0.0), ["reduce needs the clock at which it closes", "scan(...)"]),
        (lambda x: reduce(x, add, at=x), ["reduce needs an initial value", "init=0.0"]),
        (lambda x: scan(x, add), ["scan needs an initial value"]),
        (lambda x: scan(x, lambda a, v: a > v, init=0.0), ["scan"]),
        (lambda x: scan(x, lambda a, v, *, xp: xp.stack([v, v]), init=0.0), ["scan.init", "the shape"]),
        (lambda x: group_by(x, third, keys=()), ["group_by needs its keys declared", "keys=(0, 1, 2)"]),
        (lambda x: group_by(x, third, keys=(1, 1)), ["all different", "(1, 1)"]),
        (lambda x: group_by(x, third, keys=("a",)), ["whole numbers"]),
        (lambda x: group_by(x, lambda v: v, keys=(1,)), ["the key is no whole number", "got real"]),
        (lambda x: unzip(x), ["unzip needs a stream of tuples", "real from x"]),
        (lambda x: integrate(x, rule="simpson"), ["this integration rule does not exist", "'simpson'"]),
        (lambda x: integrate(x > 0.0), ["integrate needs real numbers"]),
        (
            lambda x: integrate(x.map(lambda v, *, xp: Reading(rate=xp.stack([v, v, v]), level=v))),
            ["the integral of a signal is another quantity", "lambda v: v.rate"],
        ),
        (lambda x: flat_map(x, twice), ["flat_map needs a whole number as 'size'"]),
        (lambda x: flat_map(x, twice, size=4), ["does not give padded values", "bool[4]", "real[3]"]),
        (lambda x: flat_map(x, lambda v: v, size=1), ["does not give padded values", "got real"]),
        (lambda x: padded("imu", 3), ["this is no signal type", "stacked(real(3), 8)"]),
    ],
)
def test_refusals(body, words):
    with pytest.raises((DeclarationError, TypeMismatchError)) as error:
        build(body)
    for word in words:
        assert word.replace("got ", "") in str(error.value)


@pytest.mark.parametrize(
    "operation",
    [
        lambda h: low_pass(h, alpha=0.5),
        lambda h: take_while(h, lambda v: v > 0.0),
        lambda h: until(h, h),
        lambda h: drop(1, h),
        lambda h: scan(h, add, init=0.0),
        lambda h: group_by(h, third, keys=(1,)),
        lambda h: unzip(h),
        lambda h: delta_time(h),
        lambda h: integrate(h),
        lambda h: tap(h, print),
        lambda h: window(h, at=h, size=1),
        lambda h: reduce(h, add, init=0.0, at=h),
        lambda h: batch(2, h),
        lambda h: flat_map(h, twice, size=3),
    ],
)
def test_held_values_are_refused(operation):
    with pytest.raises(DeclarationError, match="needs a stream") as error:
        build(lambda x: operation(latest(x, init=0.0)))
    assert ".at(clock)" in str(error.value)


def test_a_window_may_close_at_another_source_of_any_timing():
    counts = lambda x, y: window(x, at=y, size=8).map(lambda w: w.count)
    result = run(counts, scalars(range(8)), scalars([3, 7]), x=periodic(1), y=aperiodic(max_rate=1e9))
    assert pairs(result.output) == [(3, 4), (7, 4)]
