"""Where tasks run: here, in a pool of processes that outlives its workers, or on a Dask cluster.

The protocol is small. `submit(task, function, *arguments)` takes a task's name and what to call;
`as_completed()` yields a `Finished` for each submitted task, in the order in which they end, and more may be
submitted while it does. A task whose worker dies is given to another; one that has killed its cap of workers
ends with `lost`, and the rest go on.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, NoReturn, Protocol

from flowgraph.errors import DeclarationError, MissingDependencyError

_Work = tuple[str, Callable[..., Any], tuple[Any, ...]]
"""A task: its name, and what to call."""

DEATHS = 3
"""So many workers may one task take with it before it is given up."""

GRACE = 1.0
"""Seconds that a worker has to end by itself."""

PATIENCE = 5.0
"""Seconds that a Dask scheduler may take to answer."""


@dataclass(frozen=True)
class Finished:
    """The end of a task.

    Args:
        task: its name.
        value: what the function returned; None where it did not.
        error: what it raised.
        lost: why it could not be run to its end: its workers died.
    """

    task: str
    value: Any = None
    error: Exception | None = None
    lost: str | None = None


class Executor(Protocol):
    """What a study needs of a place to run."""

    workers: int

    def submit(self, task: str, function: Callable[..., Any], *arguments: Any) -> None:
        """Take a task; its name must be new. Function and arguments must be picklable."""

    def as_completed(self) -> Iterator[Finished]:
        """Each task that ends, until none is left."""

    def close(self) -> None:
        """Stop, without waiting for what still runs."""

    def __enter__(self) -> Executor: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class _Closing:
    def close(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Any:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class InProcess(_Closing):
    """One task after the other in this process."""

    workers = 1

    def __init__(self) -> None:
        self._waiting: deque[_Work] = deque()

    def submit(self, task: str, function: Callable[..., Any], *arguments: Any) -> None:
        self._waiting.append((task, function, arguments))

    def as_completed(self) -> Iterator[Finished]:
        while self._waiting:
            task, function, arguments = self._waiting.popleft()
            try:
                done = Finished(task, function(*arguments))
            except Exception as error:
                done = Finished(task, error=error)
            yield done

    def close(self) -> None:
        self._waiting.clear()


class _Worker:
    """A process that runs what it is sent, one task at a time."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            program = (
                f"import json, sys; sys.path[:] = json.loads({json.dumps(json.dumps(sys.path))});"
                f" from flowgraph.study.executors import serve; serve({theirs.fileno()})"
            )
            self.process = subprocess.Popen(
                [sys.executable, "-c", program],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=_one_thread(os.environ),
                process_group=0,  # a terminal's Ctrl-C is for the process that leads, not for these
            )
        self.connection = Connection(ours.detach())
        self.task: str | None = None

    def stop(self) -> None:
        """End it; first asked, since it may have to end a compiler, and then made to."""
        self.connection.close()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=GRACE)
        self.process.kill()
        self.process.wait()


class ProcessPool(_Closing):
    """Processes of our own, each with one task at a time, so that it is known which task a death is due to.

    Not `concurrent.futures`: its pool breaks as a whole when one process dies, and cannot tell which task
    was to blame. The processes are started anew, not forked (JAX has threads), and do not import the main
    program.

    Args:
        workers: how many processes.
        deaths: how many workers a task may take with it.
    """

    def __init__(self, workers: int, *, deaths: int = DEATHS) -> None:
        _need_workers(workers)
        self.workers, self._deaths = workers, deaths
        self._waiting: deque[str] = deque()
        self._work: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {}
        self._died: dict[str, int] = {}
        self._crew: list[_Worker] = []

    def submit(self, task: str, function: Callable[..., Any], *arguments: Any) -> None:
        self._work[task] = (function, arguments)
        self._waiting.append(task)

    def pids(self) -> list[int]:
        """The processes at work now."""
        return [w.process.pid for w in self._crew]

    def as_completed(self) -> Iterator[Finished]:
        while self._work:
            self._assign()
            ready = wait([w.connection for w in self._crew])
            for worker in [w for w in self._crew if w.connection in ready]:
                done = self._heard(worker)
                if done is not None:
                    del self._work[done.task]
                    self._assign()  # before what follows from it is worked on
                    yield done

    def _assign(self) -> None:
        """Give each idle worker a task, and start workers while there are tasks for them."""
        while self._waiting:
            idle = next((w for w in self._crew if w.task is None), None)
            if idle is None and len(self._crew) >= self.workers:
                return
            if idle is None:
                idle = _Worker()
                self._crew.append(idle)
            idle.task = self._waiting.popleft()
            try:
                idle.connection.send((idle.task, *self._work[idle.task]))
            except OSError:  # it died while it had nothing to do, which is not the task's fault
                self._waiting.appendleft(idle.task)
                self._dismiss(idle)

    def _heard(self, worker: _Worker) -> Finished | None:
        """What a worker has to say; where it has died, its task waits again or is lost."""
        try:
            task, value, error = worker.connection.recv()
            worker.task = None
            return Finished(task, value, error)
        except (EOFError, OSError):
            dead, code = worker.task, self._dismiss(worker)
        if dead is None:
            return None
        self._died[dead] = self._died.get(dead, 0) + 1
        if self._died[dead] < self._deaths:
            self._waiting.appendleft(dead)
            return None
        return Finished(dead, lost=f"{self._died[dead]} workers died of it, the last with {_cause(code)}")

    def _dismiss(self, worker: _Worker) -> int:
        self._crew.remove(worker)
        worker.connection.close()
        try:
            return worker.process.wait(timeout=10)
        except subprocess.TimeoutExpired:  # it closed its end and lives on
            worker.process.kill()
            return worker.process.wait()

    def close(self) -> None:
        for worker in self._crew:
            worker.process.terminate()
        for worker in self._crew:
            worker.stop()
        self._crew, self._work = [], {}
        self._waiting.clear()


def serve(descriptor: int) -> NoReturn:
    """What a worker process does: run tasks from its connection until that is closed.

    It ends there and then, for taking all that it has loaded apart would keep its study waiting.
    """
    code = 0
    try:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        sys.unraisablehook = _leave
        _serve(descriptor)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = 1
    with suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def _leave(swallowed: Any) -> None:
    """An exit that was asked for within a callback of the interpreter, which takes no exception further."""
    if isinstance(swallowed.exc_value, SystemExit):
        os._exit(128 + signal.SIGTERM)
    sys.__unraisablehook__(swallowed)


def _serve(descriptor: int) -> None:
    with Connection(descriptor) as connection:
        while True:
            try:
                task, function, arguments = connection.recv()
            except (EOFError, OSError):
                return
            answer: tuple[str, Any, Exception | None]
            try:
                answer = (task, function(*arguments), None)
            except Exception as error:
                answer = (task, None, RuntimeError(f"{type(error).__name__}: {error}"))
            try:
                connection.send(answer)
            except OSError:
                return


class OnDask(_Closing):
    """A Dask cluster: one that is there, or a local one of processes.

    Dask gives several tasks to a worker at once, and holds its death against all of them. So a task that is
    said to have killed its workers is run again by itself when there is nothing else to do, and lost only
    then.

    Args:
        scheduler: its address, such as "tcp://host:8786"; None starts a local cluster.
        workers: of the local cluster.
        deaths: how many workers a task may take with it; a cluster that is there has its own number.
        patience: s, how long a scheduler may take to answer.

    Raises:
        MissingDependencyError: without `distributed`.
        DeclarationError: where no scheduler answers.
    """

    def __init__(
        self,
        scheduler: str | None = None,
        *,
        workers: int = 2,
        deaths: int = DEATHS,
        patience: float = PATIENCE,
    ) -> None:
        _need_workers(workers)
        try:
            import dask  # optional, with what follows
            import distributed as found
        except ImportError as error:
            raise MissingDependencyError(
                "a cluster needs dask.distributed",
                path="executor dask",
                expected="an installed distributed",
                got=str(error),
                fix='pip install "flowgraph-filters[distributed]"',
            ) from None
        distributed: Any = found  # it has no types of its own
        self._distributed = distributed
        self._cluster: Any = None
        with dask.config.set({"distributed.scheduler.allowed-failures": deaths - 1}):
            if scheduler is None:
                self._cluster = distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None,
                    env=dict(_THREADS),
                )  # fmt: skip
            else:
                _ask(distributed, scheduler, patience)
            self._client = distributed.Client(self._cluster or scheduler, set_as_default=False)
        self.workers = max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))
        self._futures: dict[Any, tuple[_Work, bool]] = {}
        self._suspects: deque[_Work] = deque()
        self._done = distributed.as_completed(loop=self._client.loop)

    def pids(self) -> list[int]:
        """The worker processes of the cluster."""
        return list(self._client.run(os.getpid).values())

    def submit(self, task: str, function: Callable[..., Any], *arguments: Any) -> None:
        self._send((task, function, arguments), alone=False)

    def _send(self, work: _Work, *, alone: bool) -> None:
        _, function, arguments = work
        future = self._client.submit(function, *arguments, pure=False)
        self._futures[future.key] = work, alone
        self._done.add(future)

    def as_completed(self) -> Iterator[Finished]:
        for future in self._done:
            work, alone = self._futures.pop(future.key)
            task, error = work[0], future.exception()
            if isinstance(error, self._distributed.KilledWorker) and not alone:
                self._suspects.append(work)
            elif isinstance(error, self._distributed.KilledWorker):
                yield Finished(task, lost=str(error).partition("\n")[0])
            elif future.status == "cancelled":
                yield Finished(task, lost="the cluster has gone away")
            elif error is not None:
                yield Finished(task, error=error)
            else:
                yield Finished(task, future.result())
            future.release()
            if self._suspects and not self._futures:
                self._send(self._suspects.popleft(), alone=True)

    def close(self) -> None:
        if self._cluster is not None:
            with suppress(Exception):  # one that is just being started again cannot be told to go
                self._client.wait_for_workers(self.workers, timeout=10)
        with suppress(TimeoutError):  # what has been done is there, however long they take to go
            self._client.close(timeout=5)
        if self._cluster is not None:
            with suppress(TimeoutError, AssertionError):  # its keepers trip over a worker that died unseen
                self._cluster.close(timeout=10)


def _ask(distributed: Any, address: str, patience: float) -> None:
    """Have a scheduler say who it is, before a client is made, which would try for long and close badly.

    Raises:
        DeclarationError: where it does not, or is none.
    """

    async def ask() -> Any:
        secured = distributed.Security().get_connection_args("client")
        comm = await distributed.core.connect(address, timeout=patience, **secured)
        try:
            await comm.write({"op": "identity", "reply": True})
            return await comm.read()
        finally:
            comm.abort()

    try:
        with ThreadPoolExecutor(1) as apart:  # a notebook has an event loop of its own in this thread
            answer = apart.submit(asyncio.run, asyncio.wait_for(ask(), patience + 1.0)).result()
        if isinstance(answer, Mapping) and answer.get("type") == "Scheduler":
            return
        said = f"what answers is {answer.get('type') if isinstance(answer, Mapping) else answer!r}"
    except Exception as error:  # whatever else listens there may say anything
        late = isinstance(error, TimeoutError | OSError)
        why = str(error.__cause__ or error)
        said = f"no answer within {patience:g} s" if late else f"{type(error).__name__}"
        said += f" ({why})" if why else ""
    raise DeclarationError(
        "no scheduler answers here",
        path="--scheduler",
        expected="the address of a running scheduler, such as tcp://host:8786",
        got=f"{address}: {said}",
        fix="start one with `dask scheduler`, and workers with `dask worker ADDRESS`",
    )


_THREADS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NPROC": "1",  # the threads of XLA
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}


def _one_thread(environment: Any) -> dict[str, str]:
    """Processes share the cores, so each computes in one thread unless the user says otherwise."""
    return {**_THREADS, **environment}


def _cause(code: int) -> str:
    try:
        return signal.Signals(-code).name if code < 0 else f"exit status {code}"
    except ValueError:
        return f"signal {-code}"


def _need_workers(workers: object) -> None:
    if type(workers) is not int or not 1 <= workers <= 4096:
        raise DeclarationError(
            "so many workers there cannot be",
            path="workers",
            expected="a whole number from 1 to 4096",
            got=repr(workers),
            fix="write --workers 2",
        )
