"""Executors: the same protocol, and what they do when workers die."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import socket
import threading

import pytest

from flowgraph import DeclarationError
from flowgraph.study import InProcess, OnDask, ProcessPool
from tests.study import deeds


def finished(executor):
    return {done.task: done for done in executor.as_completed()}


@pytest.fixture(params=["inprocess", "pool", "dask"])
def executor(request):
    if request.param == "dask":
        pytest.importorskip("distributed")
    made = {"inprocess": InProcess, "pool": lambda: ProcessPool(2), "dask": lambda: OnDask(workers=2)}
    with made[request.param]() as found:
        yield found


def test_each_task_ends_with_its_value_or_its_error(executor):
    for x in range(5):
        executor.submit(f"double {x}", deeds.double, x)
    executor.submit("fail", deeds.fail, 7)
    done = finished(executor)
    assert {n: d.value for n, d in done.items() if n != "fail"} == {f"double {x}": 2 * x for x in range(5)}
    assert "no 7" in str(done["fail"].error)
    executor.submit("later", deeds.double, 21)
    assert finished(executor)["later"].value == 42


def test_tasks_may_be_submitted_while_others_end(executor):
    executor.submit("0", deeds.double, 0)
    seen = []
    for done in executor.as_completed():
        seen.append(done.task)
        if len(seen) < 4:
            executor.submit(f"{len(seen)}", deeds.double, 1)
    assert sorted(seen) == ["0", "1", "2", "3"]


@pytest.mark.parametrize(("kind", "workers"), [(ProcessPool, 2), (OnDask, 2), (OnDask, 1)])
def test_a_task_that_kills_its_workers_is_given_up_and_the_rest_end(kind, workers):
    """Also where those that wait behind it are on the same worker, each time that it dies."""
    if kind is OnDask:
        pytest.importorskip("distributed")
    with kind(workers=workers, deaths=2) as pool:
        pool.submit("poison", deeds.die, 0)
        for x in range(6):
            pool.submit(f"{x}", deeds.slow, x)
        done = finished(pool)
    assert len(done) == 7
    assert done["poison"].lost
    assert "2" in done["poison"].lost or kind is OnDask
    assert all(done[f"{x}"].value == x for x in range(6))


def test_a_cluster_closes_while_its_worker_is_started_anew():
    """A worker that is about to be there cannot be told to go, and no process is left behind."""
    pytest.importorskip("distributed")
    pool = OnDask(workers=1)
    os.kill(pool.pids()[0], signal.SIGKILL)
    pool.close()
    assert not [p for p in multiprocessing.active_children() if "Dask" in p.name]


def test_a_death_is_forgiven_once(tmp_path):
    with ProcessPool(2, deaths=2) as pool:
        pool.submit("weak", deeds.die_once, str(tmp_path / "dead"), 5)
        assert finished(pool)["weak"].value == 5


def test_a_worker_killed_from_outside_loses_nothing():
    with ProcessPool(2) as pool:
        for x in range(20):
            pool.submit(f"{x}", deeds.slow, x)
        values, killed = [], False
        for done in pool.as_completed():
            values.append(done.value)
            if not killed:
                os.kill(pool.pids()[0], signal.SIGKILL)
                killed = True
    assert sorted(values) == list(range(20))


@pytest.mark.parametrize("kind", [ProcessPool, OnDask])
@pytest.mark.parametrize("workers", [0, -1, 1.5, True])
def test_a_number_of_workers_that_cannot_be_is_refused(kind, workers):
    with pytest.raises(DeclarationError, match="so many workers"):
        kind(workers=workers)


def test_a_scheduler_that_does_not_answer_is_an_error():
    pytest.importorskip("distributed")
    with pytest.raises(DeclarationError, match="no scheduler answers") as caught:
        OnDask("tcp://127.0.0.1:9", patience=0.5)
    assert "no answer within 0.5 s" in str(caught.value.got)


def test_a_scheduler_is_asked_from_within_an_event_loop_too():
    """As in a notebook."""
    pytest.importorskip("distributed")

    async def cell() -> None:
        OnDask("tcp://127.0.0.1:9", patience=0.5)

    with pytest.raises(DeclarationError, match="no scheduler answers") as caught:
        asyncio.run(cell())
    assert "event loop" not in str(caught.value)


@pytest.mark.parametrize("address", ["nonsense", "http://127.0.0.1:9", "127.0.0.1", "tcp://"])
def test_an_address_that_is_none_is_an_error_at_once(address):
    pytest.importorskip("distributed")
    with pytest.raises(DeclarationError, match="no scheduler answers") as caught:
        OnDask(address)
    assert address in str(caught.value.got)


@pytest.mark.parametrize("said", [b"HTTP/1.0 400 Bad Request\r\n\r\nnothing here", b"", None])
def test_what_is_no_scheduler_is_told_from_one(said):
    """A web server, one that hangs up, and one that listens and says nothing."""
    pytest.importorskip("distributed")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    caller = server.accept()[0]
                    if said is None:
                        kept.append(caller)
                        continue
                    with caller, contextlib.suppress(OSError):
                        caller.sendall(said)

        kept: list[socket.socket] = []
        threading.Thread(target=serve, daemon=True).start()
        with pytest.raises(DeclarationError, match="no scheduler answers"):
            OnDask(f"tcp://127.0.0.1:{server.getsockname()[1]}", patience=0.5)
        for caller in kept:
            caller.close()
