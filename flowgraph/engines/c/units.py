"""A large source in several files, which are compiled beside each other.

The reactions of the patterns of present inputs call none of each other. So each file has some of them, after
all that any may need, of which a compiler leaves out what is not used; reset and entry are with the first.
"""

from __future__ import annotations

from flowgraph.engines.c.source import Source

MOST, LARGE = 4, 2_000
"""Into how many files, and with how many lines to each at least: what they share is read for each."""

_HIDDEN = '__attribute__((visibility("hidden")))'


def units(source: Source) -> dict[str, str]:
    """The text by file name: one file where it is small or has one reaction."""
    module, text, names = source.names.module, source.source, source.reactions
    count = min(MOST, len(names), text.count("\n") // LARGE)
    if count < 2:
        return {f"{module}.c": text}
    start = text.index(f"static uint64_t {names[0]}(")
    shared, rest = text[:start], text[start:]
    made: dict[str, str] = {}
    for name in names:
        reaction, rest = _function(rest)
        made[name] = reaction.replace("static", _HIDDEN, 1)
    declared = "".join(f"{text[: text.index('{')].rstrip()};\n" for text in made.values())
    parts: list[list[str]] = [[] for _ in range(count)]
    for name in sorted(names, key=lambda n: -len(made[n])):
        min(parts, key=lambda part: sum(len(made[n]) for n in part)).append(name)
    first, *others = ("\n".join([shared, *(made[n] for n in part)]) for part in parts)
    files = {f"{module}.c": f"{declared.join(_after_includes(first))}\n{rest}"}
    return files | {f"{module}_part_{n}.c": other for n, other in enumerate(others, 1)}


def _function(text: str) -> tuple[str, str]:
    """The function at the start of a text, and what comes after it."""
    end = text.index("\n}\n") + 3
    return text[:end], text[end:]


def _after_includes(text: str) -> tuple[str, str]:
    """A text, cut behind the line of its last include: types are declared there."""
    end = text.index("\n", text.rindex("#include")) + 1
    return text[:end], text[end:]
