"""A run is for one thread: entered twice at once it refuses, and loses nothing."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import pytest

from flowgraph import DataError, Run, Scalar, Stream, delay, graph, sink, tap
from tests.support import scalars


@graph
def total(a: Stream[Scalar]):
    held = delay(0.0, name="held")
    made = a + held
    held.feed(made)
    return {"total": made}


class Gate:
    """A block that waits in the middle of a tick until it may go on."""

    def __init__(self) -> None:
        self.inside, self.go = threading.Event(), threading.Event()

    def __call__(self, x: Any) -> None:
        self.inside.set()
        assert self.go.wait(120)


def waiting(inputs: Any = None) -> tuple[Run, Gate]:
    gate = Gate()

    @graph
    def g(a: Stream[Scalar]):
        sink(a, gate)
        return {"a": a}

    return Run(g.build(), inputs), gate


@pytest.mark.parametrize("enter", ["push", "step", "to_end"])
@pytest.mark.parametrize("second", ["push", "step", "to_end", "state", "result", "set state"])
def test_a_second_thread_is_refused_by_name(enter, second):
    run, gate = waiting(None if enter == "push" else {"a": scalars([0, 1])})
    before = run.state
    calls: dict[str, Any] = {
        "push": lambda: run.push(5, a=1.0),
        "step": run.step,
        "to_end": run.to_end,
        "state": lambda: run.state,
        "result": run.result,
        "set state": lambda: setattr(run, "state", before),
    }
    first = threading.Thread(target=calls[enter])
    first.start()
    try:
        assert gate.inside.wait(120)
        with pytest.raises(DataError, match=f"Run.{second.split()[-1]} while this run is in a tick") as error:
            calls[second]()
        assert error.value.got == "another thread is in it"
        assert "queue" in str(error.value.fix)
        assert "one thread" in str(error.value.expected)
    finally:
        gate.go.set()
        first.join(120)
    assert len(run.result()["a"]) >= 1, "the first is not disturbed"
    if enter == "push":
        run.push(6, a=2.0)
        assert run.result()["a"].value.tolist() == [1.0, 2.0]


def test_a_block_that_enters_its_own_run_is_refused():
    found: list[Any] = []

    @graph
    def g(a: Stream[Scalar]):
        return {"a": tap(a, lambda x: found.append(run.push(9, a=x)))}

    run = Run(g.build())
    with pytest.raises(DataError, match="Run.push while this run is in a tick") as error:
        run.push(0, a=1.0)
    assert error.value.got == "a block of this run calls it"
    assert found == []


def test_a_block_may_look_at_its_own_run():
    seen: list[int] = []

    @graph
    def g(a: Stream[Scalar]):
        sink(a, lambda x: seen.append(len(run.result()["a"])))
        return {"a": a}

    run = Run(g.build())
    for k in range(3):
        run.push(k, a=1.0)
    assert len(seen) == 3
    assert run.state["sources"]["a"] == 2


def test_threads_that_push_lose_nothing_in_silence():
    """Each push has happened, or was refused; and all are there where those that were refused come again."""
    run = Run(total.build())
    stamps, lock = itertools.count(), threading.Lock()  # a refused push takes one, too
    pushed, refused = [0] * 3, [0] * 3

    def work(k: int) -> None:
        for _ in range(300):
            while True:
                try:
                    run.push(next_stamp(), a=1.0)
                except DataError:  # another is in it, or was later
                    refused[k] += 1
                    continue
                pushed[k] += 1
                break

    def next_stamp() -> int:
        with lock:
            return next(stamps)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert pushed == [300] * 3
    assert run.result()["total"].value.tolist() == [float(k) for k in range(1, 901)]
    assert run.ticks == 900


def test_sources_may_have_any_name():
    @graph
    def g(run: Stream[Scalar], args: Stream[Scalar]):
        return {"run_out": run, "args_out": args}

    live = Run(g.build())
    live.push(0, run=1.0, args=2.0)
    assert live.result()["run_out"].value.tolist() == [1.0]
