"""Steps must be pure: one that writes what outlives it, or gives another result each time, is refused.

Such a step counts on from tick to tick in Python, and is a constant once it is recorded. Both are seen when
it is wired: what it could write to is compared before and after, and it is recorded a second time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

from flowgraph.errors import DeclarationError, FlowgraphError, place
from flowgraph.language.block import Block
from flowgraph.language.freezing import Freezer
from flowgraph.recorder.refusals import is_machinery
from flowgraph.recorder.trace import Trace

_REMEDY = "keep it in a state: @block with @NAME.init; or, for the host alone, declare @block(host=True)"


def refuse_impure(
    freezer: Freezer, record: Callable[[Freezer], object], block: Block[Any], path: str
) -> None:
    """Refuse a step that was recorded if it wrote to what it reads, or reads what cannot be frozen.

    Args:
        freezer: that froze it.
        record: records it once more, frozen by another.
    """
    written = freezer.written()
    if written:
        refuse_write(path, ", ".join(dict.fromkeys(written)), _writing_line(record))
    if freezer.uncopied:
        name, what = freezer.uncopied[0]
        error = DeclarationError(
            f"{name!r}, which the step reads, can neither be copied nor change",
            path=path,
            expected="arrays, numbers, lists, dicts, objects of these: they are frozen when a step is wired",
            got=what,
            fix="pass what is needed of it as a setting, or declare @block(host=True)",
        )
        error.line = line_of_step(block)
        raise error


def refuse_write(path: str, what: str, line: str | None) -> NoReturn:
    """Refuse a step that writes to what outlives it."""
    error = DeclarationError(
        "the step writes what outlives it",
        path=path,
        expected="a step whose results follow from its inputs, its state and its settings",
        got=f"a write to {what}",
        fix=_REMEDY,
    )
    error.line = line
    raise error from None


def refuse_different(first: Trace, second: Trace, path: str) -> None:
    """Refuse a step of which two recordings are not the same."""
    if first.instructions == second.instructions and first.values == second.values:
        return
    pairs = list(zip(first.values, second.values, strict=False))
    changed = {n for (key, n), (other, _) in pairs if key != other}
    line = next(
        (
            a.line
            for a, b in zip(first.instructions, second.instructions, strict=False)
            if a != b or changed & {*a.args}
        ),
        first.instructions[-1].line if first.instructions else None,
    )
    error = DeclarationError(
        "the step is another each time it is run",
        path=path,
        expected="a step whose results follow from its inputs, its state and its settings",
        got="a clock, a random number or a counter of its own",
        fix=f"take draw for random numbers and t for the time; {_REMEDY}",
    )
    error.line = line
    raise error


def line_of_step(block: Block[Any]) -> str | None:
    """module:line of a block's function."""
    code = getattr(block.step, "__code__", None)
    return None if code is None else place(block.step.__globals__, code.co_firstlineno)


def _writing_line(record: Callable[[Freezer], object]) -> str | None:
    """The line of the user's that first writes to what was frozen: found by recording line by line."""
    freezer, found, last = Freezer(), None, None

    def watch(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal found, last
        module = frame.f_globals.get("__name__", "?")
        if is_machinery(module) or module.startswith("flowgraph.language"):
            return watch
        if found is None and last is not None and freezer.written():
            found = last
        last = place(frame.f_globals, frame.f_lineno)
        return watch

    before = sys.gettrace()
    sys.settrace(watch)
    try:
        record(freezer)
    except FlowgraphError:
        pass  # it was recorded before; here only its line is asked for
    finally:
        sys.settrace(before)
    return found or last
