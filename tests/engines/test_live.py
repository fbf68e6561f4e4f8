"""Live runs: from several threads and event loops, late and in disorder, nothing is lost uncounted."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    DataError,
    DeclarationError,
    Live,
    Scalar,
    Stream,
    TypeMismatchError,
    UnknownNameError,
    aperiodic,
    block,
    delay,
    graph,
    match,
    merge,
    periodic,
    simulate,
    sink,
    stamp_of,
)
from flowgraph.engines.mailbox import Event, Mailboxes, Order
from flowgraph.engines.pace import Pace
from tests.support import MS, scalars

ENGINES = ("python", "c")


@block
def plus(total: Scalar, x: Scalar, *, dt: float) -> Scalar:
    return total + x + 0.0 * dt


@graph
def summed(a: Stream[Scalar], b: Stream[Scalar]):
    """The sum of all that came, of both where both did."""
    total = delay(0.0, name="total")
    now = plus(total, merge(a, b, tie="left"))
    total.feed(now)
    return {"now": now}


@graph
def paired(a: Stream[Scalar], b: Stream[Scalar]):
    return match(a, b, tolerance=0, size=2)


SUMMED = summed.build()


def same_streams(a: Any, b: Any) -> None:
    for name, series in a.series.items():
        np.testing.assert_array_equal(series.time, b[name].time)
        for leaf, values in series.leaves.items():
            np.testing.assert_array_equal(values, b[name].leaves[leaf])


def known(live: Live, name: str) -> int:
    """Events of a source that are in a count or in a tick."""
    kinds = ("late", "twice", "dropped", "refused", "unclocked", "absent")
    return sum(live.counts[f"{name}.{kind}"] for kind in kinds) + len(live.arrived[name])


@pytest.mark.parametrize("thread", [True, False])
@pytest.mark.parametrize("engine", ENGINES)
def test_threads_that_push_without_a_lock_lose_nothing(engine, thread):
    live, each = Live(SUMMED, engine=engine, queue=16, lateness="10s", thread=thread), 400

    def pushes(source: str, first: int) -> None:
        for k in range(first, first + each):
            live.push(2 * k + (source == "b"), **{source: 1.0})

    threads = [threading.Thread(target=pushes, args=(s, n * each)) for n in range(3) for s in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    result = live.close()
    assert [known(live, s) for s in "ab"] == [3 * each] * 2
    made = len(live.arrived["a"]) + len(live.arrived["b"])
    assert float(result.state["registers"]["total"]) == result.ticks == made
    same_streams(result, simulate(SUMMED, live.arrived, engine=engine))


@settings(max_examples=30, deadline=None)
@given(data=st.data(), lateness=st.integers(0, 8))
def test_disorder_within_the_lateness_is_put_right(data, lateness):
    """The ticks are those of the sorted events, as long as none comes later than was declared."""
    second = 10**12  # a thousand: so long nothing is taken for complete because nothing comes
    stamps = data.draw(st.lists(st.integers(0, 40), unique=True, min_size=1, max_size=25))
    late = {t: data.draw(st.integers(0, lateness)) for t in stamps}
    which = {t: data.draw(st.sampled_from(("a", "b"))) for t in stamps}
    with Live(SUMMED, lateness=lateness * second, queue=64) as live:
        for t in sorted(stamps, key=lambda t: (t + late[t], t)):
            live.push(t * second, **{which[t]: float(t)})
    result = live.result()
    times = {s: np.array(sorted(t for t in stamps if which[t] == s), np.int64) for s in "ab"}
    assert result.ticks == len(stamps)
    same_streams(
        result, simulate(SUMMED, {s: scalars(t * second, t.astype(float)) for s, t in times.items()})
    )


def test_what_is_too_late_or_comes_twice_is_counted():
    order = Order(2, 10, 100)
    given_ = [(0, 0), (1, 5), (0, 20), (0, 9), (1, 9), (0, 12), (0, 12), (0, 40)]
    taken, made = [], []
    for n, (source, stamp) in enumerate(given_):
        taken.append(order.put(Event(n, stamp, source, None, 0)))
        made += [(t, [e.source for e in events]) for t, events in order.ready()]
    assert taken == [True, True, True, True, False, True, False, True]
    assert (order.late, order.twice) == ([0, 1], [1, 0])
    assert made == [(0, [0]), (5, [1]), (9, [0]), (12, [0]), (20, [0])]
    assert [t for t, _ in order.ready(everything=True)] == [40]
    assert not order.waiting


def test_events_of_one_stamp_are_one_tick_and_no_more_are_held_than_said():
    order = Order(2, 10**9, 2)
    order.put(Event(0, 7, 1, None, 0))
    order.put(Event(1, 7, 0, None, 0))
    assert order.ready() == []
    order.put(Event(2, 8, 0, None, 0))
    ((stamp, events),) = order.ready()
    assert (stamp, [e.source for e in events]) == (7, [0, 1])


def test_policies_of_a_full_queue():
    for full, kept, dropped, refused in (("refuse", [0, 1], 0, 1), ("drop_oldest", [1, 2], 1, 0)):
        boxes = Mailboxes(2, 2, full)
        taken = [boxes.put([(0, k, None)], 0) for k in range(3)]
        assert taken == [True, True, not refused]
        assert boxes.put([(1, 9, None)], 0)  # the other queue has room
        assert (boxes.dropped, boxes.refused) == ([dropped, 0], [refused, 0])
        found = boxes.take(0.0)
        assert found is not None
        assert [e.stamp for e in found] == [*kept, 9]
    boxes = Mailboxes(1, 1, "block")
    boxes.put([(0, 0, None)], 0)
    assert not boxes.put([(0, 1, None)], 0, timeout=0.01)
    assert boxes.refused == [1]
    later = threading.Thread(target=lambda: boxes.put([(0, 2, None)], 0))
    later.start()
    assert len(boxes.take(60.0) or ()) == 1
    later.join(60.0)
    assert boxes.taken_in == [2]
    boxes.close()
    assert not boxes.put([(0, 3, None)], 0)
    assert [e.stamp for e in boxes.take(None) or ()] == [2]
    assert boxes.take(None) is None


@pytest.mark.parametrize("full", ["block", "drop_oldest", "refuse"])
def test_a_slow_run_says_what_it_lost(full):
    gone = threading.Event()

    def slow(name: str, stamp: int, value: Any) -> None:
        assert gone.wait(60.0)

    live = Live(SUMMED, queue=4, full=full, on_output=slow)
    for k in range(4):
        assert live.push(k, a=1.0)
    if full != "block":
        for k in range(4, 20):
            live.push(k, a=1.0)
    gone.set()
    result = live.close()
    assert known(live, "a") == (4 if full == "block" else 20)
    lost = live.counts["a.dropped"] + live.counts["a.refused"]
    assert (lost == 0) == (full == "block")
    assert any(note.startswith("counted: a: ") for note in result.notes) == (full != "block")


def test_an_event_loop_pushes():
    live = Live(SUMMED, queue=2, lateness="60s")

    async def pushes(source: str, offset: int) -> None:
        for k in range(30):
            assert await live.push_async(k * 1000 + offset, **{source: 1.0})
            await asyncio.sleep(0)

    async def both() -> None:
        await asyncio.gather(pushes("a", 0), pushes("b", 1))

    asyncio.run(both())
    result = live.close()
    assert [known(live, s) for s in "ab"] == [30, 30]  # of so few that are held some come too late
    assert float(result.state["registers"]["total"]) == result.ticks > 0


@pytest.mark.parametrize("engine", ENGINES)
def test_the_clock_is_kept_and_the_run_goes_on(engine):
    @graph
    def echo(a: Stream[Scalar]):
        return a.map(lambda x: 2.0 * x)

    built = echo.build(a=periodic("10ms", jitter="1ms"))
    with Live(built, engine=engine, not_finite="absent") as live:
        for t in (0, 10, 40, 43, 53, 63):  # two lost, one too early, which may have been a jump of the clock
            live.push(t * MS, a=np.nan if t == 63 else float(t))
    result = live.result()
    assert result.output.time.tolist() == [0, 10 * MS, 40 * MS, 53 * MS]
    assert {k: n for k, n in live.counts.items() if n} == {
        "a.taken": 6, "a.lost": 2, "a.unclocked": 1, "a.absent": 1,
    }  # fmt: skip
    assert any(note.startswith("refused: a, event 1: ") for note in result.notes)
    assert "counted: a: 1 unclocked, 1 absent, 2 lost" in result.notes


@pytest.mark.parametrize("engine", ENGINES)
def test_a_full_match_gives_up_its_oldest_and_says_so(engine):
    built = paired.build(a=aperiodic(), b=aperiodic())
    with Live(built, engine=engine, lateness="1000s") as live:
        for t in range(5):
            live.push(t, a=float(t))
        live.push(4, b=0.5)
    result = live.result()
    assert result.output.time.tolist() == [4]
    assert result.stats["match.expired_a"] == 3 + 1
    assert [n for n in result.notes if n.startswith("counted: match")] == [
        "counted: match: the queue is full; its oldest values give way"
    ]


def test_an_event_that_is_refused_is_refused_to_who_pushed_it():
    with Live(SUMMED) as live:
        with pytest.raises(UnknownNameError, match="no source is called 'c'"):
            live.push(0, c=1.0)
        with pytest.raises(DataError, match="a value is not finite"):
            live.push(0, a=np.nan)
        with pytest.raises(DataError, match="times must be integer nanoseconds"):
            live.push(0.5, a=1.0)  # type: ignore[arg-type]
        with pytest.raises(TypeMismatchError):
            live.push(0, a=np.zeros(3))
        live.push(1, a=2.0)
    assert live.result().ticks == 1
    with pytest.raises(DataError, match="this live run has ended"):
        live.push(2, a=1.0)


def test_what_ends_the_run_is_raised():
    @graph
    def breaks(a: Stream[Scalar]):
        sink(a, lambda x: 1 / 0)
        return a.map(lambda x: x + 1.0)

    live = Live(breaks.build())
    live.push(0, a=1.0)
    with pytest.raises(ZeroDivisionError):
        live.close()
    with pytest.raises(ZeroDivisionError):
        live.push(1, a=1.0)
    with pytest.raises(ZeroDivisionError), Live(breaks.build()) as other:
        other.push(0, a=1.0)


def test_what_cannot_be_live_is_refused():
    with pytest.raises(DeclarationError, match="the reference engine makes no single ticks"):
        Live(SUMMED, engine="reference")
    with pytest.raises(UnknownNameError, match="rule for full"):
        Live(SUMMED, full="wait")
    with pytest.raises(UnknownNameError, match="rule for record"):
        Live(SUMMED, record="some")
    for queue in (0, 2.5, "3", True):
        with pytest.raises(DeclarationError, match="whole number as 'queue'"):
            Live(SUMMED, queue=queue)  # type: ignore[arg-type]
    with pytest.raises(DeclarationError, match="lateness is too short.*\n.*0 ns or more.*\n.*-5.*\n.*write"):
        Live(SUMMED, lateness=-5)
    with pytest.raises(DeclarationError, match="deadline is too short"):
        Live(SUMMED, deadline=0)
    with pytest.raises(DeclarationError, match="Live.on_output: 'on_output' is no function"):
        Live(SUMMED, on_output=3)  # type: ignore[arg-type]
    with pytest.raises(DeclarationError, match="Live: this is no graph"):
        Live(None)  # type: ignore[arg-type]

    @graph
    def shown(a: Stream[Scalar]):
        doubled = a.map(lambda x: 2.0 * x)
        sink(doubled, lambda x: None)
        return doubled

    with pytest.raises(DeclarationError, match="blocks of the host run in the Python engine"):
        Live(shown.build(), engine="c")


@pytest.mark.parametrize("thread", [True, False])
def test_what_is_no_push_is_refused(thread):
    with Live(SUMMED, thread=thread) as live:
        with pytest.raises(DataError, match="summed: a tick needs an event"):
            live.push(10)
        with pytest.raises(DataError, match="summed: a tick needs an event"):
            asyncio.run(live.push_async(10))
        for wrong in ("x", None):
            with pytest.raises(DeclarationError, match="source a: a signal cannot carry this kind"):
                live.push(10, a=wrong)
        with pytest.raises(DataError, match="not finite(.*\n)*.*fix: +start the run with not_finite="):
            live.push(10, a=float("nan"))
        for timeout in ("1", -1, float("nan")):
            with pytest.raises(DeclarationError, match="summed.timeout"):
                live.push(10, a=1.0, timeout=timeout)  # type: ignore[arg-type]
        live.push(10, a=1.0)
    assert live.counts["a.taken"] == 1
    assert not live.result().notes


@pytest.mark.parametrize(("unit", "said"), [(1e-3, "us"), (1e-6, "ms"), (1e-9, "s"), (1.0, ""), (0.1, "")])
def test_a_clock_of_another_unit_is_said(unit, said):
    pace = Pace()
    for k in range(101):
        pace.tick(round(k * 10 * MS * unit * 1.01), k * 10 * MS + k % 3)
    assert ["are they" in n for n in pace.notes()] == [True] * bool(said)
    assert f"are they {said}?" in "".join(pace.notes()) or not said


def test_a_short_time_says_nothing_of_a_pace():
    with Live(SUMMED) as live:
        for k in range(100):
            live.push(k, a=1.0)
    assert not live.result().notes


def test_a_live_run_of_milliseconds_says_so():
    with Live(SUMMED, thread=False) as live:
        for _ in range(3):
            live.push(round(time.perf_counter() * 1e3), a=1.0)  # of a sender that counts milliseconds
            time.sleep(0.3)
    assert any(note.startswith("warning:") and "are they ms?" in note for note in live.result().notes)


def test_deadlines_and_latencies():
    def slow(name: str, stamp: int, value: Any) -> None:
        time.sleep(0.003)

    with Live(SUMMED, deadline="2ms", on_output=slow, record="nothing") as live:
        for k in range(5):
            live.push(k, a=1.0)
    took = live.latencies
    assert took.deadline_missed == 5
    assert 0.003 <= took.work["p50"] <= took.work["max"]
    assert took.arrival["max"] >= took.response["max"] >= 0.003
    assert "counted: 5 of 5 ticks missed the deadline" in live.result().notes
    assert len(live.arrived["a"]) == len(live.result().now) == 0


@pytest.mark.parametrize("engine", ENGINES)
def test_a_recording_is_played_at_its_pace_and_gone_on_with(engine):
    inputs: Mapping[str, Any] = {"a": scalars(np.arange(6) * 10 * MS), "b": scalars([15 * MS, 35 * MS])}
    whole = simulate(SUMMED, inputs, engine=engine)
    begun = time.perf_counter()
    with Live(SUMMED, engine=engine, deadline="10s") as live:
        assert live.play(inputs, speed=0.5) == 0
    assert time.perf_counter() - begun >= 0.1
    same_streams(live.result(), whole)
    with Live(SUMMED, engine=engine, state=live.state) as more:
        more.push(60 * MS, b=1.0)
        more.push(50 * MS, b=1.0)
    assert more.counts["b.late"] == 1
    assert float(more.result().now["value"][0]) == float(whole.now["value"][-1]) + 1.0


@graph
def two(a: Stream[Scalar], b: Stream[Scalar]):
    return {"a": a, "b": b}


@pytest.mark.parametrize("thread", [True, False])
@pytest.mark.parametrize("engine", ["python", "c"])
@pytest.mark.parametrize("lateness", [0, "1ms"])
def test_events_of_one_push_are_one_tick(engine, lateness, thread):
    built = two.build(a=aperiodic(), b=aperiodic())
    with Live(built, engine=engine, lateness=lateness, thread=thread) as live:
        for k in range(1, 201):
            live.push(k * MS, a=1.0 * k, b=2.0 * k)
    assert not any(n for kind, n in live.counts.items() if "taken" not in kind), live.counts
    result = live.result()
    assert len(result["a"]) == len(result["b"]) == 200
    np.testing.assert_array_equal(result["b"].value, 2.0 * result["a"].value)


def test_a_stamp_that_is_pushed_with_its_value_is_its_stamp():
    @graph
    def stamped(a: Stream[Scalar]):
        return {"s": stamp_of(a), "a": a}

    with Live(stamped.build(a=aperiodic())) as live:
        for k in range(1, 6):
            live.push(k * 1000 * MS, a=1.0 * k, **{"a.stamp": k * 1000 * MS - 500 * MS})
    assert live.result()["s"].value.tolist() == [k * 1000 * MS - 500 * MS for k in range(1, 6)]


def test_pushes_from_threads_stay_whole():
    built = two.build(a=aperiodic(), b=aperiodic())
    with Live(built, lateness="10s", queue=64) as live:

        def push(first):
            for k in range(first, 400, 4):
                live.push((k + 1) * MS, a=1.0 * k, b=1.0 * k)

        threads = [threading.Thread(target=push, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    result = live.result()
    assert len(result["a"]) == len(result["b"])
    np.testing.assert_array_equal(result["a"].time, result["b"].time)


def test_a_recording_is_played_forwards():
    with (
        Live(two.build(a=aperiodic(), b=aperiodic())) as live,
        pytest.raises(DataError, match="played forwards"),
    ):
        live.play({"a": scalars([0], [1.0])}, speed=0.0)


@pytest.mark.parametrize("queue", [2, 64])
def test_a_queue_that_is_too_small_for_the_lateness_is_a_note(queue):
    with Live(two.build(a=aperiodic(), b=aperiodic()), lateness="1s", queue=queue) as live:
        for k in range(1, 41):
            live.push(k * MS, a=1.0 * k)
    crowded = [n for n in live.result().notes if "a larger queue holds them" in n]
    assert len(crowded) == (queue == 2)
    assert len(live.result()["a"]) == 40


def test_who_pushes_makes_the_ticks_where_the_run_has_no_thread():
    seen: list[tuple[int, int]] = []

    def more(name: str, stamp: int, value: Any) -> None:
        seen.append((stamp, threading.get_ident()))
        if stamp < 3 * MS:
            live.push(stamp + MS, a=1.0)  # made when this tick is

    live = Live(SUMMED, on_output=more, thread=False)
    live.push(MS, a=1.0)
    assert seen == [(k * MS, threading.get_ident()) for k in (1, 2, 3)]
    assert live.close().ticks == 3
    with pytest.raises(DataError, match="this live run has ended"):
        live.push(9 * MS, a=1.0)


def test_what_goes_wrong_in_a_tick_is_raised_to_who_made_it():
    def wrong(name: str, stamp: int, value: Any) -> None:
        raise RuntimeError("no more")

    live = Live(SUMMED, on_output=wrong, thread=False)
    for act in (lambda: live.push(1, a=1.0), lambda: live.push(2, a=1.0), live.close):
        with pytest.raises(RuntimeError, match="no more"):
            act()


@pytest.mark.parametrize("thread", [True, False])
def test_what_is_late_at_the_end_of_a_run_without_a_thread_is_made_by_close(thread):
    live = Live(SUMMED, lateness="1000s", thread=thread)
    live.push(2, a=1.0)
    live.push(1, b=2.0)
    assert live.close().now["value"].tolist() == [2.0, 3.0]


def test_no_push_of_an_event_loop_overtakes_another():
    order: list[int] = []

    def slow(name: str, stamp: int, value: Any) -> None:
        time.sleep(0.001)
        order.append(stamp)

    async def pushes() -> None:
        await asyncio.gather(*(live.push_async(k, a=1.0) for k in range(1, 41)))

    with Live(SUMMED, queue=1, on_output=slow) as live:
        asyncio.run(pushes())
    assert order == list(range(1, 41))
    assert live.counts["a.late"] == 0


def test_nor_one_that_comes_just_when_another_may_go_on(monkeypatch):
    order: list[int] = []
    gate, in_thread = threading.Event(), asyncio.to_thread

    def slow(name: str, stamp: int, value: Any) -> None:
        assert gate.wait(60.0)
        order.append(stamp)

    async def until_there_is_room(put: Any, *event: Any) -> Any:
        taken = await in_thread(put, *event)
        while live._boxes.waiting:
            await asyncio.sleep(0.001)
        return taken

    async def first() -> None:
        await live.push_async(3, a=1.0)
        await live.push_async(5, a=1.0)  # nobody is in there, but one waits

    async def pushes() -> None:
        live.push(1, a=1.0)
        while live._boxes.waiting:
            await asyncio.sleep(0.001)
        live.push(2, a=1.0)
        both = asyncio.gather(first(), live.push_async(4, a=1.0))
        await asyncio.sleep(0)
        gate.set()
        await both

    monkeypatch.setattr(asyncio, "to_thread", until_there_is_room)
    with Live(SUMMED, queue=1, on_output=slow) as live:
        asyncio.run(pushes())
    assert order == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("thread", [True, False])
def test_a_tick_cannot_end_its_own_run(thread):
    refused: list[DataError] = []

    def ends(name: str, stamp: int, value: Any) -> None:
        with pytest.raises(DataError, match="a tick cannot end its own run") as caught:
            live.close()
        refused.append(caught.value)

    live = Live(SUMMED, on_output=ends, thread=thread)
    live.push(1, a=1.0)
    live.push(2, a=1.0)
    assert live.close().ticks == len(refused) == 2
    assert "where events are pushed" in str(refused[0])
