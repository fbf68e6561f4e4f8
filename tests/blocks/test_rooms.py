"""The rooms of the block library: which way imports run, and where its public names are found."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import flowgraph.blocks
from flowgraph import Signal
from flowgraph.blocks import signals
from tests.test_house import SOURCES, imports

ROOMS: list[str] = list(flowgraph.blocks.__all__)  # bottom up
BLOCKS = Path(flowgraph.blocks.__file__).parent
MODULES_PUBLIC = ("models", "flights", "datasets")
"""The rooms of which the modules are public, not their names."""


def modules() -> Iterator[ModuleType]:
    for info in pkgutil.walk_packages(flowgraph.blocks.__path__, "flowgraph.blocks."):
        yield importlib.import_module(info.name)


MODULES = {module.__name__: module for module in modules()}


def imported(module: ModuleType) -> Iterator[str]:
    """The modules of the library that a module imports, in functions too."""
    assert module.__file__ is not None
    path = Path("blocks", Path(module.__file__).relative_to(BLOCKS))
    for _, name, _, typing in imports(path, SOURCES[path]):
        target = name if name in MODULES else name.rpartition(".")[0]
        if target.startswith("flowgraph.blocks.") and not typing:
            yield target


def room_of(name: str) -> str:
    return name.split(".")[2]


def test_every_folder_is_a_room_and_every_module_is_in_one() -> None:
    folders = {path.parent.name for path in BLOCKS.glob("*/__init__.py")}
    assert folders == set(ROOMS)
    assert [path.name for path in BLOCKS.glob("*.py")] == ["__init__.py"]


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_rooms_below_it(room: str) -> None:
    for name, module in MODULES.items():
        if room_of(name) == room:
            upwards = [t for t in imported(module) if ROOMS.index(room_of(t)) > ROOMS.index(room)]
            assert not upwards, name


def test_the_rooms_stand_in_the_chapter_in_their_order() -> None:
    text = flowgraph.blocks.__doc__ or ""
    places = [text.index(f"\n      {room} ") for room in ROOMS]
    assert places == sorted(places)


@pytest.mark.parametrize("room", ROOMS)
def test_what_a_room_calls_public_is_there_and_it_opens_with_a_chapter(room: str) -> None:
    module = MODULES[f"flowgraph.blocks.{room}"]
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        assert hasattr(module, name) or f"{module.__name__}.{name}" in MODULES
    assert len((module.__doc__ or "").split()) > 30


@pytest.mark.parametrize("room", [room for room in ROOMS if room not in MODULES_PUBLIC])
def test_the_public_names_of_a_rooms_modules_are_those_of_the_room(room: str) -> None:
    package = MODULES[f"flowgraph.blocks.{room}"]
    for name, module in MODULES.items():
        own = name.rpartition(".")[2]
        if name.startswith(f"{package.__name__}.") and own not in package.__all__:
            assert set(module.__all__) <= set(package.__all__), name


def signal_types(base: type[Signal] = Signal) -> Iterator[type[Signal]]:
    for kind in base.__subclasses__():
        yield kind
        yield from signal_types(kind)


def test_every_signal_type_of_the_library_is_importable_from_signals() -> None:
    found = {
        kind
        for kind in signal_types()
        if kind.__module__.startswith("flowgraph.blocks.")
        and vars(sys.modules[kind.__module__]).get(kind.__name__) is kind  # not made for one graph
    }
    assert len(found) > 50
    for kind in found:
        assert getattr(signals, kind.__name__) is kind
        assert kind.__name__ in signals.__all__
        assert kind.__module__.startswith("flowgraph.blocks.signals."), "and is defined there"


def test_the_two_orientation_beliefs_have_two_names() -> None:
    from flowgraph.blocks.orientation import OrientationBelief, accelerometer, heading

    assert OrientationBelief is accelerometer.OrientationBelief is signals.AttitudeRateBelief
    assert heading.OrientationBelief is signals.AttitudeBiasBelief
    assert not hasattr(signals, "OrientationBelief")
