"""Damage to bytes, to text, to JSON and to the arrays of an archive."""

from __future__ import annotations

import io
import json
import re
import zipfile
from random import Random
from typing import Any

HOSTILE = [
    *("", "nan", "-inf", "1e400", "1e999999999", "-1e999999999", "1e-400", "NaN", "9" * 30, "9" * 5000),
    *("-1", "0", "0.0", "1_0", "0x10", "2147483648", "9223372036854775808", "-9223372036854775809"),
    *("true", "null", '"', "'", "[", "{", "[" * 3000, "[]", "{}", "#", "&a", "*a", "~", "|", ",", ";", "="),
    *("\x00", "\x1b[31m", "\r", "\n", "\t", "\ufeff", "\ud800", "../../x", "<img onerror=x>"),
    *("a." * 3000 + "a", "1:2:3:4", "2001-99-99", "!!python/object:os.system"),
]
"""What a field is put in place of, and what lies in wait in others' files."""

VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1.5, 1e308, float("nan"), float("inf"), 2**31, 2**63, 2**64, 10**30),
    *("", "x", "../x", "nan", "\ud800", "a" * 5000, [], {}, [[]], [0] * 100, {"a": 1}),
]
_FIELD = re.compile(r"[-+]?[0-9][0-9.eE+-]*|[A-Za-z_]\w*")


def damaged(content: bytes, name: str, rng: Random) -> bytes:
    """Damage once to four times, each of a kind that fits the name's ending."""
    kinds = [_flip, _cut, _repeat, _grow, _zero, _swap]
    if name.endswith((".csv", ".tum", ".yaml", ".toml", ".txt", ".json")):
        kinds += [_field, _field, _field, _line]
    if name.endswith(".json"):
        kinds += [_node] * 6
    if name.endswith(".npz"):
        kinds += [_member] * 6
    for _ in range(rng.choice((1, 1, 2, 4))):
        content = rng.choice(kinds)(content, rng)
    return content


def _flip(content: bytes, rng: Random) -> bytes:
    made = bytearray(content)
    for _ in range(rng.choice((1, 1, 3, 20)) if made else 0):
        place = rng.randrange(len(made)) if rng.random() < 0.5 else rng.randrange(min(len(made), 256))
        made[place] = rng.randrange(256) if rng.random() < 0.5 else made[place] ^ (1 << rng.randrange(8))
    return bytes(made)


def _cut(content: bytes, rng: Random) -> bytes:
    place = rng.randrange(len(content) + 1)
    return content[:place] if rng.random() < 0.7 else content[place:]


def _part(content: bytes, rng: Random) -> tuple[int, int]:
    first = rng.randrange(len(content) + 1)
    return first, min(len(content), first + rng.choice((1, 4, 8, 64, 500)))


def _repeat(content: bytes, rng: Random) -> bytes:
    first, last = _part(content, rng)
    return content[:last] + content[first:last] * rng.choice((1, 2, 50)) + content[last:]


def _grow(content: bytes, rng: Random) -> bytes:
    place = rng.randrange(len(content) + 1)
    more = rng.randbytes(rng.choice((1, 8, 300))) if rng.random() < 0.5 else bytes(rng.choice((1, 8, 5000)))
    return content[:place] + more + content[place:]


def _zero(content: bytes, rng: Random) -> bytes:
    first, last = _part(content, rng)
    return content[:first] + rng.choice((b"\x00", b"\xff", b"\x7f")) * (last - first) + content[last:]


def _swap(content: bytes, rng: Random) -> bytes:
    (a, b), (c, d) = sorted((_part(content, rng), _part(content, rng)))
    return content if b > c else content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]


def _field(content: bytes, rng: Random) -> bytes:
    """A number or a word becomes something else."""
    text = content.decode("utf-8", "surrogateescape")
    places = list(_FIELD.finditer(text))
    if not places:
        return content
    at = rng.choice(places)
    text = text[: at.start()] + rng.choice(HOSTILE) + text[at.end() :]
    return text.encode("utf-8", "surrogatepass")


def _line(content: bytes, rng: Random) -> bytes:
    """A line is left out, moved, or comes many times."""
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    line = lines.pop(rng.randrange(len(lines)))
    place = rng.randrange(len(lines) + 1)
    return b"".join(lines[:place] + [line] * rng.choice((0, 1, 2, 30)) + lines[place:])


def _node(content: bytes, rng: Random) -> bytes:
    """A value of JSON becomes another, or is missing."""
    try:
        tree = json.loads(content)
    except (ValueError, RecursionError):
        return content
    place: Any = tree
    for _ in range(rng.randrange(1, 8)):
        if not isinstance(place, list | dict) or not place:
            break
        key = rng.choice(list(place)) if isinstance(place, dict) else rng.randrange(len(place))
        if not isinstance(place[key], list | dict) or not place[key] or rng.random() < 0.25:
            if rng.random() < 0.2:
                del place[key]
            elif rng.random() < 0.2 and isinstance(place[key], int) and not isinstance(place[key], bool):
                place[key] = place[key] * 10 ** rng.randrange(1, 9) - rng.randrange(2)
            else:
                place[key] = rng.choice(VALUES)
            break
        place = place[key]
    return json.dumps(tree).encode()


def _member(content: bytes, rng: Random) -> bytes:
    """An array of an archive is damaged, missing, twice or another's, and the archive is whole."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(m.filename, archive.read(m)) for m in archive.infolist()]
    except Exception:  # it was damaged before
        return content
    if not members:
        return content
    at = rng.randrange(len(members))
    name, array = members[at]
    kind = rng.randrange(5)
    if kind == 0:
        del members[at]
    elif kind == 1:
        members[at] = (rng.choice((name + "x", "a", "../" + name, "\n\n.npy", ".npy")), array)
    elif kind == 2:
        members[at] = (name, rng.choice(members)[1])
    elif kind == 3:
        size = rng.choice(
            ("(-1,)", "(10000000000,)", "(9999, 9999, 9999)", "(0,)", "()", "(None,)", "(1e3,)")
        )
        members[at] = (name, re.sub(rb"\([^)]*\)", size.encode(), array, count=1))
    else:
        members[at] = (name, _flip(array, rng))
    made = io.BytesIO()
    members = list(dict(members).items())
    with zipfile.ZipFile(made, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, array in members:
            archive.writestr(name, array)
    return made.getvalue()
