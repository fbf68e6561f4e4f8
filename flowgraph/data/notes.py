"""Notes: what was assumed, bridged, passed over or refused, a sentence each, said where the user sees it.

A note begins with the word of its kind, so that a person and a program can tell a remark from a warning. A
flight has those of its loader, a result those of its run; both are shown on the terminal and by `--json`.
"""

from __future__ import annotations

from collections.abc import Iterable

from flowgraph.errors import DeclarationError

WORDS = {
    "info": "what was done as asked: shifted, simulated",
    "assumed": "what nobody said: a heading, a noise, a unit, a column",
    "bridged": "a gap that was filled",
    "skipped": "what was passed over: rows, topics, extrinsics",
    "refused": "what a gate or a range turned away",
    "counted": "saturations, expired pairs",
    "warning": "a figure that is not as it should be",
    "diverged": "an estimate that is no longer finite",
}
"""The kinds of notes, and what each is for."""


def note(word: str, sentence: str) -> str:
    """A note of a kind: `note("assumed", "the heading is 0")` is "assumed: the heading is 0".

    Raises:
        DeclarationError: for a word that is not in `WORDS`.
    """
    if word not in WORDS:
        raise DeclarationError(
            "a note begins with the word of its kind",
            path="note",
            expected="one of " + ", ".join(WORDS),
            got=repr(word),
            fix="choose the word that fits best",
        )
    return f"{word}: {sentence}"


def said(notes: Iterable[str]) -> tuple[str, ...]:
    """Notes without repetition, in order.

    Raises:
        DeclarationError: for one that does not begin with a word of `WORDS`.
    """
    found = tuple(dict.fromkeys(notes))
    for one in found:
        note(one.partition(":")[0], "")
    return found
