"""Settings of graphs on flights, each declared once: its default, what it may be, and what it means.

A group of settings that several graphs share is a frozen dataclass under `Settings`. Where the function that
makes a case of a flight has a keyword-only parameter of such a class, the group's fields stand in its place:
they are settings of the graph, known to the command line, to studies and to `help`, and the function is given
them as one object. A field that is added to a group is a setting of every graph that has the group.

    @dataclass(frozen=True)
    class Gated(Settings):
        gate: Positive | None = None

    def for_flight(on: OnFlight, *, gated: Gated, still: NotNegative = 0.0) -> Case: ...

What a setting may be is said by its annotation, and checked before the function is called.
"""

from __future__ import annotations

import functools
import inspect
import operator
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.checks import need_count, need_numbers

__all__ = [
    "Check",
    "NotNegative",
    "Positive",
    "Settings",
    "Spliced",
    "above_one",
    "count",
    "left_out_or",
    "named",
    "not_negative",
    "one_of",
    "positive",
    "spliced",
]

Check = Callable[[str, str, Any], None]
"""`(graph, name, value)`: refuses what the setting may not be, naming both."""


def positive(graph: str, name: str, value: object) -> None:
    """Refuse what is no positive number; None passes."""
    need_numbers(graph, positive={name: value})


def not_negative(graph: str, name: str, value: object) -> None:
    """Refuse what is negative or no number; None passes."""
    need_numbers(graph, not_negative={name: value})


def share(graph: str, name: str, value: object) -> None:
    """Refuse what is no number from 0 to 1; None passes."""
    need_numbers(graph, not_negative={name: value})
    if isinstance(value, (int, float)) and value > 1.0:
        raise DeclarationError(
            f"setting {name!r} is no part of a whole",
            path=f"{graph}.{name}",
            expected="a number from 0 to 1",
            got=repr(value),
            fix=f"write {name}=0.5",
        )


def above_one(graph: str, name: str, value: object) -> None:
    """Refuse what is no number above 1; None passes."""
    need_numbers(graph, positive={name: value})
    if isinstance(value, (int, float)) and value <= 1.0:
        raise DeclarationError(
            f"setting {name!r} is too small",
            path=f"{graph}.{name}",
            expected="a number above 1",
            got=repr(value),
            fix=f"write {name}=50",
        )


Positive = Annotated[float, positive]
NotNegative = Annotated[float, not_negative]
Share = Annotated[float, share]


def count(least: int, most: int) -> Check:
    """Refuse what is no whole number between these."""

    def check(graph: str, name: str, value: object) -> None:
        need_count(graph, name, value, least=least, most=most)

    return check


def one_of(*words: str) -> Check:
    """Refuse what is none of a few words."""

    def check(graph: str, name: str, value: object) -> None:
        if value not in words:
            raise DeclarationError(
                f"setting {name!r} has no such value",
                path=f"{graph}.{name}",
                expected=" or ".join(words),
                got=repr(value),
                fix=f"write {name}={words[-1]}",
            )

    return check


def left_out_or(check: Check) -> Check:
    """A check that None passes."""
    return lambda graph, name, value: None if value is None else check(graph, name, value)


def named(kind: str, words: Iterable[str]) -> Check:
    """Refuse what is no name of this kind of thing, with the nearest that is."""
    valid = tuple(words)

    def check(graph: str, name: str, value: object) -> None:
        if value not in valid:
            raise UnknownNameError(kind, value, valid, path=f"{graph}.{name}")

    return check


@dataclass(frozen=True)
class Settings:
    """A group of settings. A class of several groups has the settings of all, from left to right.

    Where a class says `judges = True`, its own settings change how a run is scored, and not the run: they are
    no parameters of a filter, and are not tuned.
    """

    judges = False

    @classmethod
    def names(cls) -> list[str]:
        """The settings: a class's own first, then those of its bases."""
        return list(dict.fromkeys(n for c in cls.__mro__ for n in inspect.get_annotations(c)))

    @classmethod
    def scoring(cls) -> frozenset[str]:
        """Those of the settings that change how a run is scored."""
        return frozenset(n for c in cls.__mro__ if vars(c).get("judges") for n in inspect.get_annotations(c))


@dataclass(frozen=True)
class Spliced:
    """The settings of a function, with those of its groups in the place of these.

    Args:
        parameters: keyword-only, in order; their annotations are plain types.
        checks: by setting, in the same order.
        groups: the class by the name of its parameter.
        documentation: the function's, with what its groups say of their settings.
    """

    parameters: tuple[inspect.Parameter, ...]
    checks: Mapping[str, tuple[Check, ...]]
    groups: Mapping[str, type[Settings]]
    documentation: str

    @property
    def scoring(self) -> frozenset[str]:
        """The settings that change how a run is scored, and not the run."""
        return frozenset[str]().union(*(group.scoring() for group in self.groups.values()))

    def check(self, graph: str, values: Mapping[str, Any]) -> None:
        """Refuse values that settings may not have.

        Raises:
            DeclarationError, UnknownNameError: naming the graph and the setting.
        """
        for name, checks in self.checks.items():
            for check in checks:
                check(graph, name, values[name])

    def grouped(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The values as the function takes them: those of a group in one object."""
        left = dict(values)
        made = {name: group(**{n: left.pop(n) for n in group.names()}) for name, group in self.groups.items()}
        return left | made


def spliced(function: Callable[..., Any], **more: type[Settings]) -> Spliced:
    """What a function of keyword-only settings and groups of settings takes, all told.

    Args:
        function: with keyword-only settings.
        more: groups that are settings, too, and no parameters of the function.

    Raises:
        DeclarationError: where a setting is declared twice.
    """
    kinds = typing.get_type_hints(function, include_extras=True) | more
    added = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in more]
    found: dict[str, tuple[Any, Any, str]] = {}
    groups: dict[str, type[Settings]] = {}
    for p in [*inspect.signature(function).parameters.values(), *added]:
        if p.kind is not p.KEYWORD_ONLY:
            continue
        kind = kinds[p.name]
        mine = {p.name: (kind, p.default, p.name)}
        if inspect.isclass(kind) and issubclass(kind, Settings):
            groups[p.name] = kind
            inner = typing.get_type_hints(kind, include_extras=True)
            held = kind() if p.default is p.empty else p.default
            mine = {n: (inner[n], getattr(held, n), p.name) for n in kind.names()}
        for name in (n for n in mine if n in found):
            raise DeclarationError(
                f"setting {name!r} is declared twice",
                path=f"{function.__module__}.{function.__qualname__}",
                expected="each setting in one group, or beside the groups",
                got=f"it is in {found[name][2]} and in {p.name}",
                fix="leave it out of one, or take one group that derives from both",
            )
        found.update(mine)
    return Spliced(
        tuple(
            inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=_plain(kind))
            for n, (kind, default, _) in found.items()
        ),
        {n: tuple(_checks(kind)) for n, (kind, _, _) in found.items()},
        groups,
        _documented(inspect.getdoc(function) or "", groups.values()),
    )


def _plain(annotation: Any) -> Any:
    """An annotation without what `Annotated` adds to it or to the parts of a union."""
    if typing.get_origin(annotation) is Annotated:
        return annotation.__origin__
    parts = typing.get_args(annotation)
    return functools.reduce(operator.or_, map(_plain, parts)) if parts else annotation


def _checks(annotation: Any) -> Iterator[Check]:
    """Those of an annotation, or of the parts of a union."""
    if typing.get_origin(annotation) is Annotated:
        yield from annotation.__metadata__
    else:
        for part in typing.get_args(annotation):
            yield from _checks(part)


_ENTRY = re.compile(r"^ {4}(\w+(?:, \w+)*): .*\n?(?: {5,}.*\n?)*", re.MULTILINE)
"""What a docstring says of one argument or a few."""


def _documented(text: str, groups: Iterable[type[Settings]]) -> str:
    """A docstring whose Args end with those of the groups, but for what it says itself."""
    before, args, after = text.partition("\nArgs:\n")
    own = re.match(f"(?:{_ENTRY.pattern})*", after, re.MULTILINE) if args else None
    kept = own.group() if own else ""
    said = {name for entry in _ENTRY.finditer(kept) for name in entry[1].split(", ")}
    entries = [kept.rstrip("\n")] if kept else []
    for cls in dict.fromkeys(c for group in groups for c in group.__mro__ if issubclass(c, Settings)):
        for entry in _ENTRY.finditer(inspect.cleandoc(cls.__doc__ or "").partition("\nArgs:\n")[2]):
            names = entry[1].split(", ")
            if not said & set(names):
                said |= set(names)
                entries.append(entry.group().rstrip("\n"))
    rest = after[len(kept) :].lstrip("\n")
    told = f"{before.rstrip()}\n\nArgs:\n" + "\n".join(entries) if entries else before.rstrip()
    return f"{told}\n\n{rest}" if rest else told
