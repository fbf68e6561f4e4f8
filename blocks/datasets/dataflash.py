"""The DataFlash format of ArduPilot's logs: messages that the log itself describes.

    A3 95 kind body      kind 128 describes a kind: its length, name, codes of its fields and their names

Each field is a number of fixed size, some scaled, or a text. A log whose power went ends within a message,
and what is written as a card fails is no message: bytes between messages are passed over up to a share, and
counted.

Source: ArduPilot, AP_Logger, LogStructure.h; the developers' wiki, "Downloading and analyzing data logs".
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flowgraph.data.files import content_of
from flowgraph.errors import DataError

__all__ = ["Log", "read_dataflash"]

_HEAD = b"\xa3\x95"
_FORMAT, _FORMAT_SIZE = 128, 89
_CODES: Mapping[str, tuple[str, float]] = {
    "b": ("i1", 1.0), "B": ("u1", 1.0), "M": ("u1", 1.0), "h": ("<i2", 1.0), "H": ("<u2", 1.0),
    "i": ("<i4", 1.0), "I": ("<u4", 1.0), "q": ("<i8", 1.0), "Q": ("<u8", 1.0),
    "f": ("<f4", 1.0), "d": ("<f8", 1.0), "g": ("<f2", 1.0),
    "c": ("<i2", 0.01), "C": ("<u2", 0.01), "e": ("<i4", 0.01), "E": ("<u4", 0.01), "L": ("<i4", 1e-7),
    "n": ("S4", 0.0), "N": ("S16", 0.0), "Z": ("S64", 0.0), "a": ("V64", 0.0),
}  # fmt: skip
"""By its letter, how a field is stored, and what one of it is worth; 0 of what is no number."""
_MOST_LOST = 0.02


class Log(NamedTuple):
    """What a log holds.

    Args:
        messages: by kind and field, numbers (n,), integers where they are stored so and not scaled.
        kinds: how many messages of each kind there are, read or not.
        passed: bytes that are of no message. cut: those of a message that the end cuts off.
    """

    messages: dict[str, dict[str, np.ndarray]]
    kinds: dict[str, int]
    passed: int
    cut: int


class _Kind(NamedTuple):
    name: str
    size: int
    codes: str
    fields: tuple[str, ...]


def read_dataflash(file: Path, *wanted: str) -> Log:
    """The messages of the kinds `wanted`, those that are there.

    Raises:
        DataError: the file cannot be read or is no such log, describes a kind in a way that does not fit its
            size, or holds too much that is no message.
    """
    try:
        content = content_of(file, most=2**40)
    except OSError as error:
        raise _broken(file, "it cannot be read", str(error)) from None
    if content[:3] != _HEAD + bytes([_FORMAT]):
        raise DataError(
            "this is no log of ArduPilot",
            path=str(file),
            expected="a file that begins with A3 95 80, the description of a message",
            got=content[:8].hex(" ") or "an empty file",
            fix="choose the .bin itself",
        )
    kinds, places, passed, cut = _walk(file, content)
    if passed > _MOST_LOST * len(content):
        raise _broken(file, "much of it is no message", f"{passed} of {len(content)} bytes between messages")
    raw = np.frombuffer(content, dtype=np.uint8)
    found: dict[str, dict[str, np.ndarray]] = {}
    counted: dict[str, int] = {}
    for number, kind in kinds.items():
        at = np.array(places.get(number, ()), dtype=np.int64)
        counted[kind.name] = counted.get(kind.name, 0) + len(at)
        if kind.name in wanted and len(at):
            found[kind.name] = _decoded(file, kind, raw, at)
    return Log(found, counted, passed, cut)


def _walk(file: Path, content: bytes) -> tuple[dict[int, _Kind], dict[int, list[int]], int, int]:
    """The kinds by number, where the body of each message stands, and the bytes that are of none."""
    kinds: dict[int, _Kind] = {}
    sizes = [0] * 256
    sizes[_FORMAT] = _FORMAT_SIZE
    places: dict[int, list[int]] = {}
    at, passed, end = 0, 0, len(content)
    while at + 3 <= end:
        number = content[at + 2]
        size = sizes[number]
        if content[at : at + 2] != _HEAD or not size:
            after = content.find(_HEAD, at + 1)
            passed += (after if after >= 0 else end) - at
            at = after if after >= 0 else end
            continue
        if at + size > end:
            return kinds, places, passed, end - at
        if number == _FORMAT:
            told, kind = _described(file, content, at)
            if told != _FORMAT:
                kinds[told], sizes[told] = kind, kind.size
        else:
            places.setdefault(number, []).append(at + 3)
        at += size
    return kinds, places, passed, end - at


def _described(file: Path, content: bytes, at: int) -> tuple[int, _Kind]:
    """The number and the kind that a description tells of."""
    number, size = content[at + 3], content[at + 4]
    parts = (
        content[a:b].split(b"\0")[0] for a, b in ((at + 5, at + 9), (at + 9, at + 25), (at + 25, at + 89))
    )
    name, codes, fields = (part.decode("latin-1") for part in parts)
    if size < 3:
        raise _broken(file, f"byte {at}: a kind of message has no size", f"{name!r} of {size} bytes")
    return number, _Kind(name, size, codes, tuple(fields.split(",")) if fields else ())


def _decoded(file: Path, kind: _Kind, raw: np.ndarray, at: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of messages whose bodies stand at (n,) bytes."""
    unknown = [c for c in kind.codes if c not in _CODES]
    stored = None
    if not unknown and len(kind.codes) == len(kind.fields) == len(set(kind.fields)):
        stored = np.dtype([(n, _CODES[c][0]) for n, c in zip(kind.fields, kind.codes, strict=True)])
    if stored is None or stored.itemsize != kind.size - 3:
        said = f"{kind.name}: {kind.codes} for {', '.join(kind.fields)}, of {kind.size - 3} bytes"
        raise _broken(file, "the description of a message does not fit its size", said)
    rows = raw[at[:, None] + np.arange(stored.itemsize)].view(stored)[:, 0]
    found = {}
    for name, code in zip(kind.fields, kind.codes, strict=True):
        scale = _CODES[code][1]
        if scale:
            found[name] = rows[name] if scale == 1.0 else rows[name] * scale
    return found


def _broken(file: Path, what: str, got: str) -> DataError:
    return DataError(
        f"this is no whole log of ArduPilot: {what}",
        path=str(file),
        expected="messages, each of a kind that the log describes",
        got=got,
        fix="copy the log from the card again",
    )
