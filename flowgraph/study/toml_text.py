"""TOML as studies are written in it, read in a time that does not depend on what somebody made of it."""

from __future__ import annotations

import re
import tomllib
from typing import Any

__all__ = ["MOST_DOTS", "toml_of"]

MOST_DOTS = 64
"""In a key: Python's reader of TOML takes time with the square of their number."""

_WORD = r"(?:[A-Za-z0-9_-]+|\"[^\"\n]*\"|'[^'\n]*')"
_DOTTED = re.compile(rf"{_WORD}(?:[ \t]*\.[ \t]*{_WORD})*")


def toml_of(content: str) -> Any:
    """TOML, but for keys of so many parts that only a reader's time is meant.

    Raises:
        ValueError: where it is none; RecursionError: where it is nested too deeply.
    """
    for match in _DOTTED.finditer(content):
        if match[0].count(".") > MOST_DOTS:
            raise ValueError(f"a key of {match[0].count('.') + 1} parts: {match[0][:40]}...")
    return tomllib.loads(content)
