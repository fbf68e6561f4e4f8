"""How things are written in C: names, comments, numbers, kinds of number.

Names and texts of a graph are a user's, so nothing of them reaches C as it stands: an identifier keeps
letters, digits and underscores only, and a comment plain characters that can neither end it nor continue a
line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

KEYWORDS = frozenset(
    [
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
        "for",
        "goto",
        "if",
        "inline",
        "int",
        "long",
        "register",
        "restrict",
        "return",
        "short",
        "signed",
        "sizeof",
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
        "bool",
        "true",
        "false",
        "asm",
        "typeof",
        "main",
        "errno",
        "NULL",
        "NAN",
        "INFINITY",
        "EOF",
        "FILE",
        "alignas",
        "alignof",
        "and",
        "and_eq",
        "bitand",
        "bitor",
        "catch",
        "class",
        "compl",
        "concept",
        "const_cast",
        "constexpr",
        "decltype",
        "delete",
        "dynamic_cast",
        "explicit",
        "export",
        "friend",
        "mutable",
        "namespace",
        "new",
        "noexcept",
        "not",
        "not_eq",
        "nullptr",
        "operator",
        "or",
        "or_eq",
        "private",
        "protected",
        "public",
        "reinterpret_cast",
        "requires",
        "static_assert",
        "static_cast",
        "template",
        "this",
        "thread_local",
        "throw",
        "try",
        "typeid",
        "typename",
        "using",
        "virtual",
        "wchar_t",
        "xor",
        "xor_eq",
        "char8_t",
        "char16_t",
        "char32_t",
        "co_await",
        "co_return",
        "co_yield",
        "consteval",
        "constinit",
        "typeof_unqual",
        "complex",
        "imaginary",
        "stdin",
        "stdout",
        "stderr",
        "linux",
        "unix",
        "i386",
        "near",
        "far",
    ]
)
"""Words that cannot be names in C or in C++, or that compilers and their headers define as macros."""

CTYPES = {
    "bool": "bool",
    "int32": "int32_t",
    "int64": "int64_t",
    "uint32": "uint32_t",
    "uint64": "uint64_t",
}


def ctype(dtype: str, real: str) -> str:
    """The type in C; `real` is "double" or "float"."""
    return real if dtype == "real" else CTYPES[dtype]


def identifier(text: str) -> str:
    """A name that C takes, near to `text`."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_")[:60] or "x"
    if name[0].isdigit() or name in KEYWORDS or name.startswith("fg_"):
        name = f"g_{name}"
    return name


def unique(texts: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Identifiers for texts, each once."""
    seen, made = {t.lower() for t in taken}, []
    for text in texts:
        base = name = identifier(text)
        k = 2
        while name.lower() in seen:
            name, k = f"{base}_{k}", k + 1
        seen.add(name.lower())
        made.append(name)
    return made


def comment(text: str) -> str:
    """Text that can stand inside a comment: printable, on one line, unable to end it."""
    plain = "".join(c if " " <= c <= "~" and c != "\\" else " " if c.isspace() else "." for c in text)
    plain = re.sub(r" +", " ", plain).replace("*/", "* /").replace("/*", "/ *")
    return re.sub(r"\?(?=\?)", "? ", plain).strip()


def string(text: str) -> str:
    """A string literal of a text, in UTF-8."""
    plain = frozenset(
        b" _-.,:;()[]|&<>=+@" + bytes(range(48, 58)) + bytes(range(65, 91)) + bytes(range(97, 123))
    )
    return (
        '"' + "".join(chr(b) if b in plain else f"\\{b:03o}" for b in text.encode("utf-8", "replace")) + '"'
    )


def number(value: Any, dtype: str, real: str) -> str:
    """A literal."""
    if dtype == "bool":
        return "true" if value else "false"
    if dtype == "real":
        if math.isnan(value):
            return "NAN"
        if math.isinf(value):
            return "INFINITY" if value > 0 else "(-INFINITY)"
        if real == "float":
            single = np.float32(value)
            if np.isinf(single):
                return "INFINITY" if value > 0 else "(-INFINITY)"
            text = _pointed(str(single)) + "f"
        else:
            text = _pointed(repr(float(value)))
        return f"({text})" if text[0] == "-" else text
    if dtype == "int32":
        return "INT32_MIN" if value == -(2**31) else f"({value})" if value < 0 else str(value)
    if dtype == "int64":
        return "INT64_MIN" if value == -(2**63) else f"INT64_C({value})"
    return f"UINT32_C({value})" if dtype == "uint32" else f"UINT64_C({value})"


def _pointed(text: str) -> str:
    return text if any(c in text for c in ".en") else f"{text}.0"
