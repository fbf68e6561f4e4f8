"""Settings that are declared once and shared: signatures, checks and documentation."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Annotated, Any

import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.blocks.scoring.settings import (
    NotNegative,
    Positive,
    Settings,
    count,
    named,
    one_of,
    positive,
    spliced,
)


@dataclass(frozen=True)
class Noise(Settings):
    """How noisy it is.

    Args:
        near, far: deviations, m, of what is near
            and of what is far.
    """

    near: Positive | None = None
    far: Positive = 2.0


@dataclass(frozen=True)
class End(Settings):
    """When it ends.

    Args:
        last: s.
    """

    last: NotNegative = 1.0


@dataclass(frozen=True)
class Both(Noise, End):
    """Both, and how many.

    Args:
        many: how many.
    """

    many: Annotated[int, count(1, 9)] = 3


def taken(function: Any) -> dict[str, tuple[Any, Any]]:
    return {p.name: (p.annotation, p.default) for p in spliced(function).parameters}


def test_a_group_stands_for_its_settings():
    def function(on: int, *, first: bool = True, noise: Noise, mean: str = "left", end: End) -> None: ...

    assert taken(function) == {
        "first": (bool, True),
        "near": (float | None, None),
        "far": (float, 2.0),
        "mean": (str, "left"),
        "last": (float, 1.0),
    }


def test_a_class_of_several_groups_has_all_settings_from_left_to_right():
    def function(*, both: Both) -> None: ...

    assert Both.names() == ["many", "near", "far", "last"]
    assert list(taken(function)) == Both.names()


def test_a_function_may_have_defaults_of_its_own():
    own = Both(near=0.5, many=7)

    def function(*, both: Both = own) -> None: ...

    assert {n: d for n, (_, d) in taken(function).items()} == {
        "many": 7,
        "near": 0.5,
        "far": 2.0,
        "last": 1.0,
    }


def test_the_function_is_given_a_group_as_one_object():
    def function(*, both: Both, mean: str = "left") -> None: ...

    values = {"many": 1, "near": None, "far": 3.0, "last": 0.0, "mean": "right"}
    both = Both(many=1, near=None, far=3.0, last=0.0)
    assert spliced(function).grouped(values) == {"both": both, "mean": "right"}


def test_a_setting_of_two_groups_is_none():
    def function(*, noise: Noise, both: Both) -> None: ...

    with pytest.raises(DeclarationError, match=r"(?s)setting 'near' is declared twice.*noise.*both"):
        spliced(function)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"near": 0.0}, r"toy\.near: setting 'near' is out of range[\s\S]*a positive number"),
        ({"far": None, "last": -1.0}, r"toy\.last: setting 'last' is out of range[\s\S]*not negative"),
        ({"last": float("nan")}, r"toy\.last: setting 'last' is out of range"),
        ({"many": 10}, r"toy needs a whole number as 'many'[\s\S]*many from 1 to 9"),
        ({"samples": -2}, r"toy\.samples: setting 'samples' is out of range"),
        (
            {"mean": "middle"},
            r"toy\.mean: setting 'mean' has no such value[\s\S]*left or right",
        ),
    ],
)
def test_values_are_refused_by_what_the_annotation_says(setting, message):
    def function(
        *,
        both: Both,
        mean: Annotated[str, one_of("left", "right")] = "left",
        samples: Annotated[int, positive] = 1,
    ) -> None: ...

    known = spliced(function)
    values = {p.name: p.default for p in known.parameters}
    known.check("toy", values)
    with pytest.raises(DeclarationError, match=message):
        known.check("toy", values | setting)


def test_a_name_that_is_not_there_is_refused_with_those_that_are():
    def function(*, order: Annotated[str, named("order", ("zxy", "zyx"))] = "zxy") -> None: ...

    with pytest.raises(UnknownNameError, match=r"toy\.order: no order is called 'zxz'[\s\S]*zxy, zyx"):
        spliced(function).check("toy", {"order": "zxz"})


def test_the_documentation_has_that_of_the_groups():
    def function(on: int, *, both: Both, own: int = 1) -> None:
        """Do it.

        Args:
            flight: which.
            own: number; more than
                one line.

        Raises:
            DataError: now and then.
        """

    assert spliced(function).documentation == inspect.cleandoc(
        """Do it.

        Args:
            flight: which.
            own: number; more than
                one line.
            many: how many.
            near, far: deviations, m, of what is near
                and of what is far.
            last: s.

        Raises:
            DataError: now and then.
        """
    )


def test_what_the_function_says_of_a_setting_stands_instead_of_what_the_group_says():
    def function(*, noise: Noise, end: End) -> None:
        """Do it.

        Args:
            near, far: otherwise.
        """

    def silent(*, end: End) -> None:
        """Do it."""

    assert spliced(function).documentation == "Do it.\n\nArgs:\n    near, far: otherwise.\n    last: s."
    assert spliced(silent).documentation == "Do it.\n\nArgs:\n    last: s."
