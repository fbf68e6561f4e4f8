"""Runs: ticks, time, state outside the graph, and resuming to the same bits."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    ClockError,
    DataError,
    DeclarationError,
    FifoOverflowError,
    LoweringError,
    Run,
    Scalar,
    Series,
    Stream,
    TypeMismatchError,
    UnknownNameError,
    apply,
    block,
    delay,
    every,
    graph,
    latest,
    load_state,
    lower,
    match,
    merge,
    periodic,
    real,
    save_state,
    simulate,
    sink,
    when,
    zip,
)
from tests.support import MS, all_engines, pairs, same, same_state, scalars


@block
def add(a, b):
    return a + b


@block
def seconds(x, *, dt):
    return dt + 0.0 * x


@block
def mean(state, x):
    count, value = state[0] + 1, state[1] + (x - state[1]) / (state[0] + 1)
    return (count, value), value


@mean.init
def _(x: Any) -> Any:
    return np.int32(0), 0.0


@graph
def everything(x: Stream[Scalar], y: Stream[Scalar]):
    """All kinds of memory in one graph."""
    belief = delay(0.5, name="belief")
    held = latest(y, init=-1.0, name="held")
    now = add(belief, held.at(x | y))
    belief.feed(now.map(lambda v: 0.5 * v))
    slow = every(3, x, phase=1)
    return {
        "now": now,
        "dt": seconds(x),
        "mean": mean(x.filter(lambda v: v > 0.0)),
        "pairs": zip(slow, every(3, x, phase=2)),
        "match": match(x, y, tolerance=3, size=50, name="match"),
        "merge": merge(x, y, tie="left"),
    }


EVERYTHING = everything.build()


def test_a_run_counts_ticks_not_events():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return merge(x, y, tie=lambda a, b: a + b)

    result = all_engines(g.build(), {"x": scalars([0, 10, 20]), "y": scalars([10, 30])})
    assert result.ticks == 4
    assert pairs(result.output) == [(0, 1.0), (10, 3.0), (20, 3.0), (30, 2.0)]


def test_a_diamond_fires_once():
    calls: list[float] = []

    @block(host=True)
    def count(a, b) -> Scalar:
        calls.append(a)
        return a + b

    @graph
    def g(x: Stream[Scalar]):
        return count(x.map(lambda v: v), x.map(lambda v: 2.0 * v))

    assert pairs(simulate(g.build(), {"x": scalars([0, 1])}).output) == [(0, 3.0), (1, 6.0)]
    assert calls == [1.0, 2.0]


@settings(deadline=None, max_examples=25)
@given(
    st.lists(st.integers(0, 12), unique=True).map(sorted),
    st.lists(st.integers(0, 12), unique=True).map(sorted),
)
def test_the_order_in_which_sources_are_declared_does_not_matter(times_x, times_y):
    def body(x, y):
        now = add(latest(x, init=0.0).at(x | y), latest(y, init=0.0))
        return {"now": now, "old": add(x.delay(0.0).at(x | y), y.delay(0.0))}

    @graph
    def one(x: Stream[Scalar], y: Stream[Scalar]):
        return body(x, y)

    @graph
    def two(y: Stream[Scalar], x: Stream[Scalar]):
        return body(x, y)

    data = {"x": scalars(times_x), "y": scalars(times_y)}
    a, b = simulate(one.build(), data), simulate(two.build(), data)
    for name in ("now", "old"):
        assert pairs(a[name]) == pairs(b[name])


def test_dt_is_zero_at_first_and_then_the_seconds_since_this_block_fired():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return {"x": seconds(x), "slow": seconds(every(2, x)), "any": seconds(latest(y, init=0.0), at=x | y)}

    start = 5 * MS
    result = all_engines(
        g.build(), {"x": scalars([start, start + 2 * MS, start + 5 * MS]), "y": scalars([start + MS])}
    )
    assert result.x.value.tolist() == pytest.approx([0.0, 2e-3, 3e-3], abs=1e-15)
    assert result.slow.value.tolist() == pytest.approx([0.0, 5e-3], abs=1e-15)
    assert result["any"].value.tolist() == pytest.approx([0.0, 1e-3, 1e-3, 3e-3], abs=1e-15)


def test_dt_counts_from_the_first_firing_even_at_time_zero_and_before():
    @graph
    def g(x: Stream[Scalar]):
        return seconds(x)

    for first in (0, -7 * MS):
        out = all_engines(g.build(), {"x": scalars([first, first + MS])}).output
        assert out.value.tolist() == pytest.approx([0.0, 1e-3], abs=1e-15)


def test_t_is_the_time_of_the_tick():
    @block
    def stamp(x, *, t):
        return t

    @graph
    def g(x: Stream[Scalar]):
        return stamp(x)

    times = [-(2**62), 1403636579758555392, 1403636579758555393]
    out = all_engines(g.build(), {"x": scalars(times)}).output
    assert out.value.tolist() == times
    assert out.value.dtype == np.int64


DATA = {
    "x": scalars([0, 2, 4, 5, 8, 9], [1.0, -2.0, 3.0, 0.1, 0.7, -0.2]),
    "y": scalars([2, 3, 8, 11], [0.3, 0.6, 0.9, 1.2]),
}


def events(series: Series) -> list[tuple[int, float]]:
    return pairs(series)


def test_series_pairs_iterables_and_mixtures_give_the_same_answer():
    expected = simulate(EVERYTHING, DATA)
    forms: dict[str, dict[str, Any]] = {
        "pairs of arrays": {n: (s.time, s.value) for n, s in DATA.items()},
        "lists": {n: events(s) for n, s in DATA.items()},
        "generators": {n: (e for e in events(s)) for n, s in DATA.items()},
        "mixed": {"x": iter(events(DATA["x"])), "y": DATA["y"]},
    }
    for form in forms.values():
        same(expected, simulate(EVERYTHING, form))
    same(expected, simulate(EVERYTHING, {n: iter(events(s)) for n, s in DATA.items()}, engine="reference"))


def test_step_advances_one_tick():
    run = Run(EVERYTHING, DATA)
    times = []
    while run.step():
        times.append(run.time)
    assert times == [0, 2, 3, 4, 5, 8, 9, 11]
    assert not run.step()
    same(simulate(EVERYTHING, DATA), run.result())


def test_push_makes_ticks_from_live_events():
    run = Run(EVERYTHING)
    for t in sorted({*DATA["x"].time.tolist(), *DATA["y"].time.tolist()}):
        here = {n: float(s.value[s.time == t][0]) for n, s in DATA.items() if t in s.time}
        run.push(t, **here)
    same(simulate(EVERYTHING, DATA), run.result())


def test_a_lazy_source_is_not_read_further_than_needed():
    read: list[int] = []

    def source():
        for t in range(100):
            read.append(t)
            yield t, float(t)

    @graph
    def g(x: Stream[Scalar]):
        return x.map(lambda v: v)

    run = Run(g.build(), {"x": source()})
    run.step()
    run.step()
    assert len(read) <= 3
    assert pairs(run.result().output) == [(0, 0.0), (1, 1.0)]


@pytest.mark.parametrize(
    ("push", "error", "words"),
    [
        (lambda r: r.push(0, z=1.0), UnknownNameError, "no source is called 'z'"),
        (lambda r: r.push(0.5, x=1.0), DataError, "x: times must be integer nanoseconds"),
        (lambda r: r.push(0, x=np.nan), DataError, "x, this event: a value is not finite"),
        (lambda r: (r.push(5, x=1.0), r.push(5, x=1.0)), DataError, "two events at one time"),
        (lambda r: (r.push(5, x=1.0), r.push(4, y=1.0)), DataError, "time goes backwards"),
        (lambda r: (r.push(5, x=1.0), r.push(5, y=1.0)), DataError, "time goes backwards"),
        (lambda r: r.push(0, x=np.zeros(2)), TypeMismatchError, "source x: the shape"),
    ],
)
def test_push_refuses(push, error, words):
    with pytest.raises(error, match=words):
        push(Run(EVERYTHING))


def test_push_into_a_run_over_recorded_inputs_is_refused():
    with pytest.raises(DataError, match="this run reads recorded inputs"):
        Run(EVERYTHING, DATA).push(0, x=1.0)


def test_a_refused_push_changes_nothing():
    run = Run(EVERYTHING)
    run.push(0, x=1.0, y=2.0)
    before = run.state
    with pytest.raises(DataError):
        run.push(1, x=3.0, y=np.inf)
    same_state(before, run.state)
    run.push(2, x=3.0)
    assert run.ticks == 2


TIMES = st.lists(st.integers(0, 30), unique=True, max_size=12).map(sorted)


@settings(deadline=None, max_examples=40)
@given(TIMES, TIMES, st.integers(0, 31), st.sampled_from(["python", "reference"]), st.integers(0, 2**32 - 1))
def test_a_run_saved_and_resumed_at_any_cut_gives_the_same_bits(times_x, times_y, cut, engine, seed):
    random = np.random.default_rng(seed)
    data = {
        "x": scalars(times_x, random.normal(size=len(times_x))),
        "y": scalars(times_y, random.normal(size=len(times_y))),
    }
    whole = simulate(EVERYTHING, data, engine=engine)
    head = simulate(EVERYTHING, {n: s[s.time < cut] for n, s in data.items()}, engine=engine)
    tail = simulate(
        EVERYTHING, {n: s[s.time >= cut] for n, s in data.items()}, engine=engine, state=head.state
    )
    same_state(whole.state, tail.state)
    assert whole.stats == tail.stats
    for name, series in whole.series.items():
        for leaf, array in series.leaves.items():
            joined = np.concatenate([head[name].leaves[leaf], tail[name].leaves[leaf]])
            np.testing.assert_array_equal(array, joined)


def test_state_goes_through_a_file_exactly(tmp_path: Path):
    run = Run(EVERYTHING, DATA)
    for _ in range(5):
        run.step()
    save_state(run.state, tmp_path / "state.npz")
    state = load_state(tmp_path / "state.npz")
    same_state(run.state, state)
    rest = {n: s[s.time > run.time] for n, s in DATA.items()}
    same_state(simulate(EVERYTHING, DATA).state, simulate(EVERYTHING, rest, state=state).state)


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 broken"])
def test_a_file_that_is_no_state_is_refused(tmp_path: Path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(DataError, match=r"x\.npz: this is no saved state"):
        load_state(tmp_path / "x.npz")
    np.save(tmp_path / "y.npy", np.zeros(3))
    with pytest.raises(DataError, match="this is no saved state"):
        load_state(tmp_path / "y.npy")
    with pytest.raises(DataError, match="this is no saved state"):
        load_state(tmp_path / "missing.npz")


def test_a_pickle_in_a_state_file_is_never_opened(tmp_path: Path):
    evil: dict[str, Any] = {"registers\na\n": np.array([object()], dtype=object)}
    np.savez(tmp_path / "evil.npz", **evil)
    with pytest.raises(DataError, match="this is no saved state"):
        load_state(tmp_path / "evil.npz")


def test_the_state_of_another_graph_is_refused():
    @graph
    def g(x: Stream[Scalar]):
        return x.delay(0.0, name="other").at(x)

    state = simulate(g.build(), {"x": scalars([0])}).state
    with pytest.raises(DataError, match="everything: this state is of another graph"):
        simulate(EVERYTHING, DATA, state=state)


@pytest.mark.parametrize("engine", ["python", "reference"])
def test_a_resumed_run_refuses_what_came_before(engine):
    state = simulate(EVERYTHING, DATA, engine=engine).state
    with pytest.raises(DataError, match="time goes backwards") as error:
        simulate(EVERYTHING, DATA, engine=engine, state=state)
    assert "after 11 ns" in str(error.value)


def test_a_resumed_run_verifies_the_period_across_the_cut():
    from flowgraph import ClockError

    @graph
    def g(x: Stream[Scalar]):
        return x.map(lambda v: v)

    built = g.build(x=periodic(10))
    state = simulate(built, {"x": scalars([0, 10])}).state
    assert simulate(built, {"x": scalars([20])}, state=state).ticks == 1
    with pytest.raises(ClockError, match="do not keep the declared period"):
        simulate(built, {"x": scalars([25])}, state=state)


def test_other_initial_values_are_part_of_a_run():
    expected = simulate(EVERYTHING, DATA, init={"belief": 100.0})
    assert expected.now.value[0] == 99.0
    same(expected, simulate(EVERYTHING, DATA, init={"belief": 100.0}, engine="reference"))
    assert simulate(EVERYTHING, DATA).now.value[0] == -0.5
    with pytest.raises(UnknownNameError, match="no register is called 'beleif'") as error:
        simulate(EVERYTHING, DATA, init={"beleif": 0.0})
    assert "did you mean 'belief'" in str(error.value)
    with pytest.raises(TypeMismatchError, match="belief"):
        simulate(EVERYTHING, DATA, init={"belief": np.zeros(3)})


def test_one_graph_runs_in_threads_with_the_same_answer():
    random = np.random.default_rng(0)
    times = np.arange(3000) * 10
    data = {
        "x": scalars(times, random.normal(size=3000)),
        "y": scalars(times[::3] + 3, random.normal(size=1000)),
    }
    fresh = everything.build()
    expected = simulate(fresh, data)
    found: dict[int, Any] = {}

    def work(k: int) -> None:
        found[k] = simulate(shared, data)

    shared = everything.build()
    threads = [threading.Thread(target=work, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 3
    for result in found.values():
        same(expected, result)


def test_runs_of_one_graph_interleave_without_touching_each_other():
    one, two = Run(EVERYTHING, DATA), Run(EVERYTHING, DATA, init={"belief": 7.0})
    while one.step():
        two.step()
    same(one.result(), simulate(EVERYTHING, DATA))
    same(two.result(), simulate(EVERYTHING, DATA, init={"belief": 7.0}))


def fails_at_three():
    @block(host=True)
    def fragile(x) -> Scalar:
        if x == 3.0:
            raise RuntimeError("boom")
        return x

    @graph
    def inner(x: Stream[Scalar]):
        return fragile(x)

    @graph
    def outer(x: Stream[Scalar]):
        return {"y": inner(x, name="part"), "memory": x.delay(0.0, name="memory").at(x)}

    return outer.build()


def test_an_error_in_a_step_is_noted_with_path_and_time():
    with pytest.raises(RuntimeError, match="boom") as error:
        simulate(fails_at_three(), {"x": scalars([0, 10, 20, 30])})
    assert error.value.__notes__ == ["in outer, at part/fragile, t = 20 ns"]


def test_an_error_in_a_graph_that_was_lowered_keeps_its_message():
    """Regression: the pipeline that is kept with the graph was taken for a plan."""

    @block
    def root(x):
        if isinstance(x, np.generic):
            raise RuntimeError("not while it is recorded")
        return x

    @graph
    def g(x: Stream[Scalar]):
        return root(x)

    built = g.build()
    lower(built)
    with pytest.raises(RuntimeError) as error:
        simulate(built, {"x": scalars([0], [-1.0])})
    assert error.value.__notes__ == ["in g, at root, t = 0 ns"]


def test_after_an_error_state_and_time_are_those_of_the_last_good_tick():
    run = Run(fails_at_three(), {"x": scalars([0, 10, 20, 30])})
    with pytest.raises(RuntimeError):
        run.to_end()
    assert (run.ticks, run.time) == (2, 10)
    assert run.state["registers"]["memory"] == 2.0
    assert run.state["sources"]["x"] == 10


def test_no_events_at_all():
    for engine in ("python", "reference", "xla"):
        result = simulate(EVERYTHING, {"x": scalars([]), "y": scalars([])}, engine=engine)
        assert result.ticks == 0
        assert len(result.now) == 0
        assert result.state["registers"]["belief"] == 0.5


def test_a_meter_is_told_how_far_the_run_is():
    class Meter:
        def __init__(self) -> None:
            self.seen: list[tuple[int, int]] = []

        def update(self, ticks: int, time: int) -> None:
            self.seen.append((ticks, time))

    @graph
    def g(x: Stream[Scalar]):
        return x.map(lambda v: v)

    meter = Meter()
    simulate(g.build(), {"x": scalars(range(5000))}, progress=meter)
    assert meter.seen[-1] == (5000, 4999)
    assert len(meter.seen) > 1


def test_unknown_engine_dtype_and_python_in_float32():
    with pytest.raises(UnknownNameError, match="no engine is called 'pyhton'") as error:
        simulate(EVERYTHING, DATA, engine="pyhton")
    assert "did you mean 'python'" in str(error.value)
    with pytest.raises(UnknownNameError, match="no dtype is called 'float16'"):
        simulate(EVERYTHING, DATA, dtype="float16")
    with pytest.raises(DeclarationError, match="the Python engine computes in float64"):
        simulate(EVERYTHING, DATA, dtype="float32")


def test_results_are_series_by_name():
    result = simulate(EVERYTHING, DATA)
    assert result["now"] is result.now
    with pytest.raises(UnknownNameError, match="no output is called 'nwo'"):
        result["nwo"]
    with pytest.raises(AttributeError):
        _ = result.nwo
    assert set(result.stats) == {"match.expired_a", "match.expired_b"}


# -- what an error, an impure block or a careless name must not break --------------------------------


Pair = Annotated[Any, real(2)]


@block
def in_place(x: Pair) -> Pair:
    x += 1.0
    return x


def test_an_in_place_write_is_refused_at_build():
    @graph
    def g(a: Stream[Pair]):
        return in_place(a)

    with pytest.raises(LoweringError, match="in-place"):
        g.build()


@block(host=True)
def scribble(x: Pair) -> Pair:
    x[0] = 99.0
    return x


@block(host=True)
def shaky(x: Scalar) -> Scalar:
    return None if x > 2 else np.ones(3) if x > 1 else x


def test_host_blocks_can_neither_change_their_inputs_nor_break_their_promises():
    @graph
    def writes(a: Stream[Pair]):
        return scribble(a)

    values = np.zeros((2, 2))
    with pytest.raises(ValueError, match="read-only"):
        simulate(writes.build(), {"a": Series([0, 1], values)})
    assert not values.any()

    @graph
    def promises(a: Stream[Scalar]):
        return shaky(a)

    with pytest.raises(TypeMismatchError, match="shape"):
        simulate(promises.build(), {"a": Series([0, 1], [1.0, 2.0])})
    with pytest.raises(TypeMismatchError, match="absent"):
        simulate(promises.build(), {"a": Series([0, 1], [1.0, 3.0])})


def test_a_run_that_stopped_at_an_error_does_not_go_on_with_the_wrong_values():
    def bad_at_three(x):
        if x == 3.0:
            raise KeyboardInterrupt
        return x

    @graph
    def g(a: Stream[Scalar]):
        return a.map(bad_at_three, out=real())

    events = Series(np.arange(6), np.arange(6.0))
    run = Run(g.build(), {"a": events})
    with pytest.raises(KeyboardInterrupt):
        run.to_end()
    assert (run.ticks, run.time, int(run.state["sources"]["a"])) == (3, 2, 2)
    with pytest.raises(DataError, match="stopped at an error"):
        run.step()
    rest = Run(g.build(), {"a": events[4:]}, state=run.state).to_end().result()
    assert rest.output.value.tolist() == [4.0, 5.0]


def test_a_failed_push_leaves_no_trace_and_may_be_repeated():
    def bad(x):
        if x > 1.0:
            raise RuntimeError("no")
        return x

    @graph
    def g(a: Stream[Scalar], b: Stream[Scalar]):
        return {"a": a.map(bad, out=real()), "b": b}

    run = Run(g.build())
    with pytest.raises(RuntimeError):
        run.push(10, a=2.0, b=1.0)
    assert int(run.state["sources"]["a"]) == int(run.state["sources"]["b"]) == run.time
    run.push(10, a=0.5, b=3.0)
    assert run.result()["b"].value.tolist() == [3.0]
    refused: list[tuple[Any, dict[str, float]]] = [(1.5, {"a": 1.0}), ("x", {"a": 1.0}), (20, {})]
    for time, values in refused:
        with pytest.raises(DataError):
            run.push(time, **values)
    with pytest.raises(TypeMismatchError):
        run.push(30, a=True)


@graph
def echoed(imu: Stream[Scalar]):
    return imu.map(lambda x: x)


@pytest.mark.parametrize("timing", [periodic("5ms", jitter="1ms"), periodic("5ms"), periodic("5ms", phase=0)])
def test_a_live_run_goes_on_after_lost_packets_and_counts_them(timing):
    run = Run(echoed.build(imu=timing))
    came = [k for k in range(100) if k not in (10, 20, 21, 22)]
    for k in came:
        run.push(5 * MS * k, imu=float(k))
    assert run.lost == {"imu": 4}
    assert run.result().output.value.tolist() == came


def test_a_clock_that_jumps_is_refused_once_and_one_without_its_phase_is_refused():
    run = Run(echoed.build(imu=periodic("5ms")))
    for k in range(5):
        run.push(5 * MS * k, imu=0.0)
    with pytest.raises(ClockError, match="do not keep the declared period"):
        run.push(27 * MS, imu=1.0)
    run.push(32 * MS, imu=2.0)
    assert run.lost == {"imu": 0}
    phased = Run(echoed.build(imu=periodic("5ms", phase=0)))
    phased.push(0, imu=0.0)
    for time in (7, 12, 17):
        with pytest.raises(ClockError):
            phased.push(time * MS, imu=0.0)
    phased.push(20 * MS, imu=0.0)


@pytest.mark.parametrize("time", [2**63, -(2**63), 10**400, -(10**400)])
def test_a_time_beyond_64_bits_is_our_error(time):
    with pytest.raises(DataError, match="does not fit 64 bits"):
        Run(echoed.build()).push(time, imu=1.0)


def test_what_is_not_finite_is_refused_absent_or_kept():
    with pytest.raises(UnknownNameError, match="no rule for not_finite is called 'drop'"):
        Run(echoed.build(), not_finite="drop")
    absent = Run(echoed.build(), not_finite="absent")
    for time, value in enumerate([1.0, np.nan, np.inf, 2.0]):
        absent.push(time, imu=value)
    assert absent.absent == {"imu": 2}
    assert absent.result().output.value.tolist() == [1.0, 2.0]
    kept = Run(echoed.build(), not_finite="keep")
    kept.push(0, imu=np.nan)
    assert np.isnan(kept.result().output.value).all()


@graph
def matched(imu: Stream[Scalar], cam: Stream[Scalar], *, full):
    return {"imu": imu, "pair": match(imu, cam, tolerance="5ms", size=4, full=full, name="m")}


@pytest.mark.parametrize("back", [False, True])
def test_a_live_run_goes_on_when_a_match_is_full(back):
    """The error is raised once, in a tick that has happened; what waits is the latest, and pairs again."""
    run, raised = Run(matched.build(full="error")), []
    for k in range(60):
        try:
            run.push(5 * MS * k, imu=float(k), **({"cam": 1.0} if k < 10 or (back and k > 50) else {}))
        except FifoOverflowError as error:
            raised.append(error.path)
    assert raised == ["m"]
    assert len(run.result().imu) == 60
    assert len(run.result().pair) == 10 + 9 * back
    assert run.stats["m.expired_a"] == 41 + (0 if back else 5)


@pytest.mark.parametrize("engine", ["python", "reference", "c"])
def test_a_match_may_drop_the_oldest_instead(engine):
    time = np.arange(60) * 5 * MS
    inputs = {"imu": Series(time, np.arange(60.0)), "cam": Series(time[:10], np.ones(10))}
    found = simulate(matched.build(full="drop_oldest"), inputs, engine=engine)
    assert len(found.pair) == 10
    assert found.stats["m.expired_a"] == 46
    with pytest.raises(FifoOverflowError):
        simulate(matched.build(full="error"), inputs, engine=engine)
    with pytest.raises(DeclarationError, match="not what a full queue can do"):
        matched.build(full="drop")


def test_iterables_are_read_one_event_ahead():
    read = []
    seen = []

    def events():
        for k in range(5):
            read.append(k)
            yield k, float(k)

    @graph
    def g(a: Stream[Scalar]):
        sink(a, lambda x: seen.append((x, len(read))))
        return {"a": a}

    simulate(g.build(), {"a": events()})
    assert all(ahead <= x + 2 for x, ahead in seen)


@pytest.mark.parametrize("engine", ["python", "reference"])
def test_t_is_an_array_number_in_every_engine(engine):
    @block
    def late(x: Scalar, *, t, xp) -> Scalar:
        return xp.where(~(t > 15), -1.0, x) + 0.0 * xp.astype(t, xp.float64)

    @graph
    def g(a: Stream[Scalar]):
        return late(a)

    result = simulate(g.build(), {"a": Series([0, 10, 20, 30], [1.0, 2.0, 3.0, 4.0])}, engine=engine)
    assert result.output.value.tolist() == [-1.0, -1.0, 3.0, 4.0]


def test_a_stamp_register_does_not_hide_one_of_the_same_name():
    @block
    def step(x: Scalar, *, dt) -> Scalar:
        return x + dt

    @graph
    def g(a: Stream[Scalar]):
        held = delay(5.0, name="last(a)")
        held.feed(a)
        return {"x": step(a), "y": held.at(a)}

    registers = Run(g.build(), {"a": Series([0, 1], [1.0, 2.0])}).to_end().state["registers"]
    assert sorted(registers) == ["last(a)", "last(a)_2"]
    assert registers["last(a)"] == 2.0


def test_clock_proofs_are_not_fooled_by_names():
    @block
    def gate(x: Scalar) -> tuple[Scalar | None, Scalar | None]:
        return when(x > 1.0, x), when(x > 2.0, x)

    @graph
    def g(a: Stream[Scalar]):
        _, q = gate(a, name="g")
        return apply(lambda x, y: x + y, q, a.filter(lambda v: v < 2.0, name="g.out_2"))

    with pytest.raises(ClockError):
        g.build()
