"""Errors that teach: where it happened, what was expected, what came, and how to mend it.

Every error that flowgraph raises on purpose derives from `FlowgraphError`. It carries its parts as
attributes, so that a program can act on them, and prints them in one fixed layout, so that a person
finds the same thing in the same place each time.
"""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

_MOST = 2000
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def plain(words: str) -> str:
    """Text that steers no terminal: characters that would are spelled out, but for ends of lines and tabs."""
    return _CONTROL.sub(lambda m: m[0].encode("unicode_escape").decode(), words)


def _bounded(words: str) -> str:
    """What a person can read of a part of an error: of a list of thousands its start and its end."""
    left_out = len(words) - _MOST
    return words if left_out <= 0 else f"{words[: _MOST - 300]} ({left_out:,} characters) {words[-300:]}"


class FlowgraphError(Exception):
    """An error with the place, what was expected, what came and the fix.

    Args:
        message: one sentence that says what is wrong.
        path: where: a graph path (`rbpf/resample/weights`), a port, or a file and row.
        expected: what would have been right.
        got: what came instead.
        fix: what to write or do.

    Attributes:
        line: module:line of the declaration that is wrong, where an error is due to one.
    """

    line: str | None = None

    def __init__(
        self,
        message: str,
        *,
        path: str | None = None,
        expected: object = None,
        got: object = None,
        fix: str | None = None,
    ) -> None:
        self.message, self.path, self.expected, self.got, self.fix = message, path, expected, got, fix
        super().__init__(message)

    def __str__(self) -> str:
        lines = [f"{self.path}: {self.message}" if self.path else self.message]
        parts = {"at": self.line, "expected": self.expected, "got": self.got, "fix": self.fix}
        for label, part in parts.items():
            if part is not None:
                lines.append(f"  {label + ':':<10}{_bounded(str(part))}")
        return plain("\n".join(lines))


class DeclarationError(FlowgraphError):
    """A graph or block is declared wrongly: a port, a name, a setting, an unfed delay."""


class TypeMismatchError(DeclarationError):
    """Two ends of a wire differ in shape, dtype, unit, frame or signal type."""


class ClockError(FlowgraphError):
    """Clocks that a join needs to be related are not, or data break the clock that was declared."""


class CycleError(DeclarationError):
    """A cycle of ports that passes through no delay."""


class LoweringError(FlowgraphError):
    """A block's step does something that a fixed-size pipeline cannot hold; names the source line.

    `in_every_engine` is true for what no engine allows, such as an in-place write or shapes that do not fit:
    it is refused at build.
    """

    in_every_engine = False


class PipelineError(FlowgraphError):
    """A pipeline description is malformed, of an unknown version, or is given the wrong inputs."""


class DataError(FlowgraphError):
    """Input data are missing, malformed, out of order or not finite; names file and row, or the source."""


class OutputError(FlowgraphError):
    """A file cannot be written; names it."""


class RunError(FlowgraphError):
    """A run cannot go on.

    Attributes:
        time: of the tick that is to blame, in ns.
        result: the `Result` of the ticks before it, where a whole run was asked for.
    """

    time: int | None = None
    result: Any = None


class FifoOverflowError(RunError):
    """A bounded queue of a join was full when a value arrived; names the join, its bound and the time."""


class DivergedError(RunError):
    """A number that was finite is not any more; names the block, the time and the last good tick.

    Attributes:
        last: the time of the last good tick in ns, or None.
    """

    last: int | None = None


class UnknownNameError(FlowgraphError):
    """A name that is not there; lists the valid ones."""

    def __init__(self, kind: str, name: object, valid: Iterable[str], *, path: str | None = None) -> None:
        names = sorted(valid)
        said = str(name) if len(str(name)) <= 200 else f"{str(name)[:200]}..."
        stream = said.rpartition(".")[0] or "STREAM"  # "STREAM.lever" is there for any stream
        near = difflib.get_close_matches(said, [n.replace("STREAM.", f"{stream}.") for n in names], n=1)
        super().__init__(
            f"no {kind} is called {said!r}",
            path=path,
            expected="one of " + ", ".join(names) if names else f"no {kind} exists here",
            got=repr(said),
            fix=f"did you mean {near[0]!r}?" if near else "use one of the names above",
        )
        self.valid = names


class MissingDependencyError(FlowgraphError):
    """An optional package or program is absent; says what to install."""


class PluginError(FlowgraphError):
    """What an installed package offers cannot be imported; names it, its package and why.

    What went wrong there is its `__cause__`.
    """


@contextmanager
def naming_lines(whole: str | None = None) -> Iterator[None]:
    """What is refused while a declaration runs gets the line of it that asked, the innermost of the user's.

    What is seen only at its end gets `whole`, where the declaration begins. A `LoweringError` names a line
    of the block's step already.
    """
    try:
        yield
    except FlowgraphError as error:
        if error.line is None and not isinstance(error, LoweringError):
            error.line = declaring_line(error) or whole
        raise


def place(around: Mapping[str, Any], line: int) -> str:
    """module:line of code with these globals; of a program that is run as a file, file:line."""
    module, file = str(around.get("__name__", "?")), around.get("__file__")
    return f"{Path(file).name if module == '__main__' and file else module}:{line}"


def asking_line() -> str | None:
    """The line of a declaration that is being run, the innermost of the user's."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and not _declares(frame):
        frame = frame.f_back
    return None if frame is None else place(frame.f_globals, frame.f_lineno)


def _declares(frame: FrameType) -> bool:
    package, _, rest = str(frame.f_globals.get("__name__", "?")).partition(".")
    return package not in ("numpy", "contextlib", "functools") and (
        package != "flowgraph" or rest.partition(".")[0] in ("blocks", "graphs")
    )


def declaring_line(error: BaseException) -> str | None:
    """The innermost line of the user's in an error's traceback."""
    found, step = None, error.__traceback__
    while step is not None:
        if _declares(step.tb_frame):
            found = place(step.tb_frame.f_globals, step.tb_lineno)
        step = step.tb_next
    return found


@contextmanager
def writes(file: str | Path) -> Iterator[None]:
    """What the system says against writing `file` or making its folder becomes an `OutputError`."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            "this cannot be written",
            path=str(file),
            expected="a folder in which files can be made",
            got=f"{type(error).__name__}: {error.strerror or error}",
            fix="choose another file or folder, or make the folder first",
        ) from error
