"""The command: damages, reads, watches memory and time, and counts."""

from __future__ import annotations

import argparse
import json
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from random import Random
from time import perf_counter
from typing import Any

from flowgraph.errors import FlowgraphError
from tests.fuzz.damage import damaged
from tests.fuzz.samples import Sample, is_flight, made

MOST_SECONDS = 4.0
"""Of processor time for one small file."""

MOST_STUCK = 60.0
"""Seconds until what waits, computing nothing, is given up."""

MOST_MEMORY, TIMES = 96 * 2**20, 40
"""Bytes beyond those before, and how many times the file's size on top."""


class Late(BaseException):
    """The time is over."""


def _peak() -> int:
    """Bytes of the most memory since `_forget_peak`."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _forget_peak() -> int:
    with suppress(OSError):  # else it can only grow, and what is below an earlier peak is not seen
        Path("/proc/self/clear_refs").write_text("5")
    return _peak()


@contextmanager
def _limited() -> Iterator[None]:
    def late(*_: object) -> None:
        raise Late

    before = [signal.signal(s, late) for s in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
    signal.setitimer(signal.ITIMER_REAL, MOST_STUCK)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in zip((signal.SIGPROF, signal.SIGALRM), before, strict=True):
            signal.signal(number, handler)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def tried(sample: Sample, content: bytes) -> str | None:
    """What is wrong with how the reading of a damaged file ends; None where nothing is."""
    file = sample.folder / sample.file
    whole = file.read_bytes()
    file.write_bytes(content)
    before = _forget_peak()
    try:
        with _limited(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = sample.read(sample.folder)
        wrong = None if is_flight(found) else "stamps that do not increase"
    except FlowgraphError as error:
        wrong = None if error.path and error.fix else f"no place or remedy: {error}"
        if any(isinstance(e, MemoryError) for e in _chain(error)):
            wrong = f"memory was taken before its size was known: {error}"
        str(error).encode()
    except Late:
        wrong = f"over {MOST_SECONDS:g} s of processor time, or {MOST_STUCK:g} s"
    except Exception as error:
        *way, place = traceback.extract_tb(error.__traceback__)
        ours = [f for f in [*way, place] if "/flowgraph/" in f.filename or "/blocks/" in f.filename]
        first = (ours or [place])[-1]
        wrong = (
            f"{type(error).__name__}: {str(error)[:100]} at {place.filename}:{place.lineno} by {first.name}"
        )
    finally:
        file.write_bytes(whole)
    more = _peak() - before
    if wrong is None and more > MOST_MEMORY + TIMES * len(content):
        wrong = f"{more / 2**20:.0f} MiB for a file of {len(content)} bytes"
    return wrong


def run(seed: int, count: int, *, first: int = 0, only: str = "", limit: bool = True) -> dict[str, Any]:
    """Inputs `first` to `first + count` of a seed: how many there were, how many failed, and which."""
    start = perf_counter()
    failed: list[dict[str, Any]] = []
    by_kind: dict[str, int] = {}
    kept = resource.getrlimit(resource.RLIMIT_AS)
    if limit:
        room = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + 8 * 2**30
        resource.setrlimit(resource.RLIMIT_AS, (room, kept[1]))
    try:
        with tempfile.TemporaryDirectory() as folder:
            samples = [s for s in made(Path(folder)) if only in s.name]
            contents = [(s.folder / s.file).read_bytes() for s in samples]
            for sample, content in zip(samples, contents, strict=True):
                wrong = tried(sample, content)  # whole ones are read, and what is imported late is there
                assert wrong is None, f"{sample.name}: {wrong}"
            for number in range(first, first + count):
                rng = Random(f"{seed}-{number}")
                at = number % len(samples)
                sample = samples[at]
                by_kind[sample.name] = by_kind.get(sample.name, 0) + 1
                wrong = tried(sample, damaged(contents[at], sample.file, rng))
                if wrong is not None:
                    failed.append({"seed": seed, "input": number, "kind": sample.name, "wrong": wrong})
    finally:
        resource.setrlimit(resource.RLIMIT_AS, kept)
    seconds = perf_counter() - start
    return {
        "count": count,
        "failed": len(failed),
        "seeds": [seed],
        "seconds": round(seconds, 1),
        "kinds": by_kind,
        "failures": failed[:50],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="inputs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--only", default="", help="kinds with this in their name")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args(arguments)
    found = run(given.seed, given.count, first=given.first, only=given.only)
    if given.json:
        print(json.dumps(found, indent=1))
    else:
        for one in found["failures"]:
            print(f"{one['kind']}, input {one['input']}: {one['wrong']}")
        print(f"{found['count']} inputs, {found['failed']} failed, {found['seconds']} s, seed {given.seed}")
    return int(found["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
