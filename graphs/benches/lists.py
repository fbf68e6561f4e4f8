"""Settings of a bench that list names or numbers with commas between."""

from __future__ import annotations

from collections.abc import Iterable

from flowgraph import DeclarationError, UnknownNameError


def parts(text: str) -> list[str]:
    """What stands between the commas."""
    return [part.strip() for part in text.split(",") if part.strip()]


def names(text: str, valid: Iterable[str], *, what: str, path: str) -> list[str]:
    """Some of `valid`, in the order of the text; all of them where it is empty or "all".

    Raises:
        UnknownNameError: for another name, which is `what` in its message.
    """
    offered = list(valid)
    chosen = parts(text)
    for name in chosen if chosen != ["all"] else ():
        if name not in offered:
            raise UnknownNameError(what, name, offered, path=path)
    return offered if chosen in ([], ["all"]) else chosen


def numbers(text: str, path: str) -> list[int]:
    """Whole numbers from 1 on, each once, the smallest first.

    Raises:
        DeclarationError: where there is none, or something else.
    """
    given = parts(text)
    if not given or not all(part.isdecimal() and int(part) for part in given):
        raise DeclarationError(
            "these are no whole numbers",
            path=path,
            expected="numbers from 1 on, between commas",
            got=repr(text),
            fix=f"write --set {path.split('.')[-1]}=10,100",
        )
    return sorted({int(part) for part in given})
