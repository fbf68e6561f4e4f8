"""How long tests take, so that the quick ones stay quick: CPU seconds a test, and the list of the slow ones.

`FLOWGRAPH_TEST_TIMES=DIR make test` writes what each test took into files of DIR, one a process;
`python -m tests.times DIR` adds what is beyond `LONGEST` to `tests/slow.txt`.
CPU time is that of the process and of those it started: what another process takes meanwhile does not count.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

LONGEST = 2.5
"""CPU seconds that a test of the default suite may take."""

LIST = Path(__file__).with_name("slow.txt")


def listed() -> frozenset[str]:
    """The names of the tests that are slow by this list."""
    return frozenset(line for line in LIST.read_text().splitlines() if line and not line.startswith("#"))


def note(folder: str, name: str, seconds: float) -> None:
    """Write down what a test took."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    with (Path(folder) / f"{os.getpid()}.txt").open("a") as file:
        file.write(f"{seconds:.2f} {name}\n")


def cpu() -> float:
    """Seconds that this process and its children have computed."""
    return sum(os.times()[:4])


def taken(folder: Path) -> Iterator[tuple[str, float]]:
    """Each test that was noted down, and what it took."""
    for file in sorted(folder.glob("*.txt")):
        for line in file.read_text().splitlines():
            seconds, _, name = line.partition(" ")
            yield name, float(seconds)


def main(args: Sequence[str]) -> None:
    """Add what takes too long to the list."""
    found = {name for folder in args for name, seconds in taken(Path(folder)) if seconds > LONGEST}
    head = f"# Tests of more than {LONGEST:g} CPU seconds; `python -m tests.times` adds to it."
    LIST.write_text("\n".join([head, *sorted(found | listed())]) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
