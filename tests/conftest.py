"""What holds for all tests: without a C compiler, those that need one are skipped, and say so; those that
`tests/slow.txt` names are slow.

And what several of them need: a package of somebody else's, installed for one test.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from flowgraph import MissingDependencyError
from tests import times
from tests.support import Install

_PATIENT: dict[str, Any] = {  # a machine that is busy is no fault of a law
    "deadline": None, "suppress_health_check": [HealthCheck.too_slow],
}  # fmt: skip
settings.register_profile("same", derandomize=True, database=None, **_PATIENT)
settings.register_profile("other", derandomize=False, **_PATIENT)
settings.load_profile("same")  # each time the same examples; --hypothesis-profile=other looks for more

COMPILER = shutil.which(os.environ.get("CC") or "cc")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, Any, Any]:
    try:
        return (yield)
    except MissingDependencyError as error:
        if COMPILER is None and "C compiler" in str(error):
            pytest.skip("needs a C compiler")
        raise


@pytest.hookimpl(tryfirst=True)  # before those that are slow are left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    slow = times.listed()
    for item in items:
        if item.nodeid in slow:
            item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    before = times.cpu()
    done = yield
    folder = os.environ.get("FLOWGRAPH_TEST_TIMES")
    if folder:
        times.note(folder, item.nodeid, times.cpu() - before)
    return done


@pytest.fixture(autouse=True)
def same_numbers(request: pytest.FixtureRequest) -> None:
    """A test draws the same numbers whatever was run before it: `RNG` of its module begins anew."""
    generator = getattr(request.module, "RNG", None)
    if generator is not None:
        begun = request.module.__dict__.setdefault("_begun", generator.bit_generator.state)
        generator.bit_generator.state = begun


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Put a distribution on the path, with its modules and its entry points, until the test ends."""
    imported: set[str] = set()

    def written(name: str, modules: Mapping[str, str], groups: Mapping[str, Mapping[str, str]]) -> None:
        for module, text in modules.items():
            (tmp_path / f"{module}.py").write_text(text)
        info = tmp_path / f"{name.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = [f"[{g}]\n" + "".join(f"{k} = {v}\n" for k, v in of.items()) for g, of in groups.items()]
        (info / "entry_points.txt").write_text("\n".join(lines))
        imported.update(modules)
        monkeypatch.syspath_prepend(str(tmp_path))  # now, for names are looked up once for a path

    yield written
    for module in imported:
        sys.modules.pop(module, None)
