"""Settings as texts: what `--set KEY=VALUE` gives to the keyword-only parameters of a function."""

from __future__ import annotations

import inspect
import math
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = [
    "keyword_types",
    "need_settings_taken",
    "of_any_stream",
    "parsed_settings",
    "setting_names",
    "text",
]


def setting_names(function: Callable[..., Any]) -> list[str]:
    """The keyword-only arguments of a function."""
    return [p.name for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]


def keyword_types(function: Callable[..., Any]) -> dict[str, Any]:
    """What each keyword-only parameter takes: as annotated, else as its default is, else a text."""
    try:
        hints = typing.get_type_hints(function)
    except (NameError, TypeError):  # annotations for readers only
        hints = {}
    own = [p for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    return {p.name: hints.get(p.name, _of_default(p.default)) for p in own}


def _of_default(default: object) -> Any:
    return type(default) if isinstance(default, bool | int | float) else str


def parsed_settings(
    function: Callable[..., Any], given: Mapping[str, str], *, also: Sequence[str], path: str
) -> tuple[dict[str, Any], dict[str, str]]:
    """Split `--set` texts into keyword arguments of `function`, as its annotations say, and those of `also`.

    Raises:
        UnknownNameError: for a key that is in neither; DeclarationError: for a text that is no such value.
    """
    need_settings_taken(function, given, path)
    types = keyword_types(function)
    own = list(types)
    mine: dict[str, Any] = {}
    rest: dict[str, str] = {}
    for key, word in given.items():
        name = key.replace(".", "_")  # start.heading is the argument start_heading
        if key in also:
            rest[key] = word
        elif name in own:
            mine[name] = _parse(word, types[name], f"{path}.{key}")
        elif of_any_stream(key, also):
            rest[key] = word
        else:
            raise UnknownNameError("setting", key, [*own, *also], path=path)
    return mine, rest


def need_settings_taken(function: Callable[..., Any], given: Iterable[str], path: str) -> None:
    """Refuse settings that others of its kind have and a function cannot, with the reason that it gives: its
    attribute `refused`, by name.

    Raises:
        DeclarationError: naming the setting.
    """
    refused: Mapping[str, str] = getattr(function, "refused", {})
    for key in given:
        if key in refused:
            raise DeclarationError(
                refused[key], path=f"{path}.{key}", expected="no such setting", got=key,
                fix=f"leave {key} out, or choose another graph",
            )  # fmt: skip


def of_any_stream(key: str, also: Sequence[str]) -> bool:
    """Whether a kind of flight has a setting for streams of any name: STREAM.time_offset, STREAM.FIELD."""
    of_any = "STREAM." + key.rpartition(".")[2] in also
    return of_any or ("STREAM.FIELD" in also and key.count(".") == 1)


def text(value: Any) -> str:
    """A value as `--set` writes it; a float to its last bit, rows of an array with semicolons between."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, np.ndarray | list | tuple):
        array = np.asarray(value, dtype=float)
        rows = [",".join(map(repr, row)) for row in np.atleast_2d(array).tolist()]
        return ";".join(rows)
    return repr(float(value)) if isinstance(value, float) else str(value)


def _parse(text: str, annotation: Any, path: str) -> Any:
    kinds = [k for k in (typing.get_args(annotation) or (annotation,)) if k is not type(None)]
    if text.lower() == "none" and type(None) in typing.get_args(annotation):
        return None
    words = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
    try:
        value = words[text.lower()] if kinds[0] is bool else kinds[0](text)
        if kinds[0] in (int, float) and ("_" in text or not math.isfinite(value)):
            raise ValueError
        return value
    except (KeyError, OverflowError, TypeError, ValueError):
        raise DeclarationError(
            "this setting cannot be read",
            path=path,
            expected=" or ".join(("finite " if k is float else "") + k.__name__ for k in kinds),
            got=repr(text),
            fix=f"write --set {path.rsplit('.', 1)[-1]}=VALUE",
        ) from None
