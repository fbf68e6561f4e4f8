"""The house: which way imports run, that none run in a circle, how long a module is, how many lie where.

The rooms and their order stand once, in the layers contract of pyproject.toml, which `lint-imports` holds.
The tests read the text of the modules and go further: imports by a literal string, circles of modules and
of packages, and the reason of each import that waits inside a function.
"""

from __future__ import annotations

import ast
import itertools
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import networkx as nx
import pytest

ROOT = Path(__file__).resolve().parents[1]
LINKED = ("blocks", "graphs")
PACKAGES = ("flowgraph", *LINKED)
MAX_LINES = 450
MAX_ROOMS = 12
(CONTRACT,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
LAYERS: list[str] = CONTRACT["layers"][::-1]  # bottom up


def modules(package: str) -> list[Path]:
    """The Python files of one of the three packages, relative to the root; links are not followed."""
    found: list[Path] = []
    for folder, subfolders, files in os.walk(ROOT / package, followlinks=False):
        subfolders[:] = [name for name in subfolders if not (Path(folder) / name).is_symlink()]
        found += [(Path(folder) / name).relative_to(ROOT) for name in files if name.endswith(".py")]
    return sorted(found)


MODULES = [path for package in PACKAGES for path in modules(package)]
SOURCES = {path: (ROOT / path).read_text(encoding="utf-8") for path in MODULES}


def dotted(path: Path) -> str:
    """The name that users import a file by: blocks/a.py is flowgraph.blocks.a."""
    parts = path.with_suffix("").parts
    parts = parts if parts[0] == "flowgraph" else ("flowgraph", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


class Import(NamedTuple):
    """An import as the text of a module has it.

    `from a import b` gives the name a.b, for b may be a module. An import by a literal string counts as well.
    """

    line: int
    name: str
    local: bool  # it stands in a function, and runs when that is called
    typing: bool  # it is there for type checkers only, and never runs


def imports(path: Path, source: str) -> Iterator[Import]:
    """Each import of a module, wherever in its text that is."""
    package = dotted(path).split(".")
    package = package if path.name == "__init__.py" else package[:-1]

    def visit(node: ast.AST, local: bool, typing: bool) -> Iterator[Import]:
        if isinstance(node, ast.Import):
            yield from (Import(node.lineno, alias.name, local, typing) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package[: len(package) - (node.level - 1)] if node.level else []
            parts += [node.module] if node.module else []
            yield from (Import(node.lineno, ".".join([*parts, a.name]), local, typing) for a in node.names)
        elif isinstance(node, ast.Call) and node.args:
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            first = node.args[0]
            if called in ("import_module", "__import__") and isinstance(first, ast.Constant):
                yield Import(node.lineno, str(first.value), local, typing)
        inside = local or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            for child in node.body:
                yield from visit(child, inside, True)
            for child in node.orelse:
                yield from visit(child, inside, typing)
            return
        for part in ast.iter_child_nodes(node):
            yield from visit(part, inside, typing)

    yield from visit(ast.parse(source), False, False)


# Which way imports run.


def room(name: str) -> str | None:
    """The room of a module, by its name; nothing for the package itself, which opens all of them to users."""
    parts = name.split(".")
    return parts[1] if parts[0] == "flowgraph" and len(parts) > 1 and parts[1] in LAYERS else None


def wrong_imports(path: Path, source: str) -> list[str]:
    """What a module imports of a room above its own; of blocks and graphs, for type checking as well.

    The short names `blocks` and `graphs` would work in a checkout and fail in a wheel.
    """
    own = room(dotted(path))
    height = LAYERS.index(own) if own else LAYERS.index("blocks") - 1
    found = []
    for line, name, _, typing in imports(path, source):
        other = room(name)
        above = other is not None and LAYERS.index(other) > height and (not typing or other in LINKED)
        if above or name.split(".")[0] in LINKED:
            found.append(f"{path}:{line} imports {name}")
    return found


def test_each_package_has_modules() -> None:
    for package in PACKAGES:
        assert ROOT / package / "__init__.py" in [ROOT / path for path in modules(package)]


def test_each_room_is_in_the_contract() -> None:
    there = {name.split(".")[1] for name in map(dotted, MODULES) if "." in name}
    assert there == set(LAYERS)
    assert LAYERS[-2:] == list(LINKED)


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_imports_run_one_way(path: Path) -> None:
    assert wrong_imports(path, SOURCES[path]) == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("flowgraph/data/a.py", "import flowgraph.blocks.sensors"),
        ("flowgraph/data/a.py", "from flowgraph import blocks"),
        ("flowgraph/data/a.py", "from .. import graphs"),
        ("flowgraph/__init__.py", "from .blocks import Imu"),
        ("flowgraph/data/a.py", "def f():\n    from ..blocks.sensors import Imu"),
        ("flowgraph/data/a.py", "importlib.import_module('flowgraph.graphs')"),
        ("flowgraph/data/a.py", "if TYPE_CHECKING:\n    from flowgraph.blocks.signals import Imu"),
        ("flowgraph/cli/a.py", "import blocks"),
        ("flowgraph/errors.py", "from flowgraph.types import Array"),
        ("flowgraph/language/a.py", "def f():\n    from flowgraph.engines.simulate import simulate"),
        ("flowgraph/data/__init__.py", "from ..study import tasks"),
        ("flowgraph/engines/c/a.py", "import flowgraph.cli"),
        ("blocks/a.py", "from ..graphs import ins_eskf"),
        ("blocks/deep/a.py", "from flowgraph.graphs.ins_eskf import ins_eskf"),
        ("graphs/a.py", "from blocks import sensors"),
    ],
)
def test_wrong_imports_are_found(path: str, source: str) -> None:
    assert len(wrong_imports(Path(path), source)) == 1


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("flowgraph/data/a.py", "from . import series\nfrom ..types import Array\nimport numpy as np"),
        ("flowgraph/data/a.py", "if typing.TYPE_CHECKING:\n    from flowgraph.study.spec import Study"),
        ("flowgraph/__init__.py", "from flowgraph.engines.simulate import simulate"),
        ("blocks/a.py", "from flowgraph import Stream\nfrom flowgraph.blocks import a\nfrom . import maths"),
        ("graphs/a.py", "from flowgraph import graph\nfrom flowgraph.blocks import Imu\nfrom . import base"),
    ],
)
def test_right_imports_pass(path: str, source: str) -> None:
    assert wrong_imports(Path(path), source) == []


def test_the_contract_is_held_by_the_linter(tmp_path: Path) -> None:
    """An import inside a function of the lowest room is named, as one through the package itself is."""
    for name in PACKAGES:
        shutil.copytree(ROOT / name, tmp_path / name, symlinks=True, ignore=shutil.ignore_patterns("*.pyc"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    with open(tmp_path / "flowgraph" / "errors.py", "a") as file:
        file.write("\n\ndef planted():\n    from flowgraph.cli.app import app\n")
    with open(tmp_path / "flowgraph" / "recorder" / "ops.py", "a") as file:
        file.write("\n\ndef planted():\n    from flowgraph import simulate\n")
    linter = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", linter, "--no-cache"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    said = " ".join(done.stdout.split())
    assert "flowgraph.errors -> flowgraph.cli.app" in said
    assert "flowgraph.recorder.ops -> flowgraph (" in said


# Circles.


def edges(sources: Mapping[Path, str]) -> nx.DiGraph:
    """Which module imports which, by their names, but for type checking.

    A name that is no module is one that its package defines.
    """
    found = nx.DiGraph()
    found.add_nodes_from(map(dotted, sources))
    for path, source in sources.items():
        for _, name, _, typing in imports(path, source):
            target = name if name in found else name.rpartition(".")[0]
            if target in found and not typing:
                found.add_edge(dotted(path), target)
    return found


def circles(sources: Mapping[Path, str]) -> list[list[str]]:
    """Modules that import each other, and of each package the parts that do, in whatever of their modules."""
    found = edges(sources)
    views = [("", found)]
    for package in sorted({name.rpartition(".")[0] for name in found if "." in name}):
        parts = nx.DiGraph()
        for pair in found.edges:
            if all(name.startswith(package + ".") for name in pair):
                ours = [name.removeprefix(package + ".").partition(".")[0] for name in pair]
                parts.add_edges_from([ours] if ours[0] != ours[1] else [])
        views.append((package + ".", parts))
    rings = [
        [prefix + name for name in sorted(ring)]
        for prefix, view in views
        for ring in nx.strongly_connected_components(view)
        if len(ring) > 1
    ]
    return [ring for ring, _ in itertools.groupby(sorted(rings))]


def planted(**sources: str) -> dict[Path, str]:
    """Modules of the package by their place, with __ for /; the packages around them are empty."""
    files = {Path("flowgraph", *name.split("__")).with_suffix(".py"): text for name, text in sources.items()}
    folders = {folder for path in files for folder in path.parents if folder.parts}
    return {**{folder / "__init__.py": "" for folder in folders}, **files}


def test_nothing_imports_in_a_circle() -> None:
    assert circles(SOURCES) == []


@pytest.mark.parametrize(
    ("sources", "ring"),
    [
        (
            planted(data__a="from flowgraph.data import b", data__b="import flowgraph.data.a"),
            ["flowgraph.data.a", "flowgraph.data.b"],
        ),
        (
            planted(
                data__a="from . import b",
                data__b="def f():\n    from .c import x",
                data__c="from .a import y",
            ),
            ["flowgraph.data.a", "flowgraph.data.b", "flowgraph.data.c"],
        ),
        (
            planted(data__a="import_module('flowgraph.data.b')", data__b="from .a import x"),
            ["flowgraph.data.a", "flowgraph.data.b"],
        ),
        (  # rooms, though no module needs itself
            planted(
                data__a="from ..types.b import x", data__c="", types__b="", types__d="from ..data import c"
            ),
            ["flowgraph.data", "flowgraph.types"],
        ),
        (  # packages within a room
            planted(
                engines__c__a="from ..xla.b import x",
                engines__c__d="",
                engines__xla__b="",
                engines__xla__e="from flowgraph.engines.c.d import y",
            ),
            ["flowgraph.engines.c", "flowgraph.engines.xla"],
        ),
        (  # what opens a package, and a module that asks it
            {
                **planted(data__a="from flowgraph import x"),
                Path("flowgraph/__init__.py"): "from .data.a import x",
            },
            ["flowgraph", "flowgraph.data.a"],
        ),
    ],
)
def test_circles_are_found(sources: Mapping[Path, str], ring: list[str]) -> None:
    assert circles(sources) == [ring]


@pytest.mark.parametrize(
    "sources",
    [
        planted(data__a="from . import b\nfrom .c import x", data__b="from .c import y", data__c=""),
        planted(data__a="from . import b", data__b="if TYPE_CHECKING:\n    from .a import x"),
        planted(data__a="from flowgraph.types import b", types__b="import numpy.data.a"),
    ],
)
def test_what_is_no_circle_passes(sources: Mapping[Path, str]) -> None:
    assert circles(sources) == []


# Imports inside functions.


def unexplained(path: Path, source: str) -> list[str]:
    """The imports inside functions, but for those of the standard library, that do not say why they wait.

    The reason is a comment on the line of an import, or above it, or of the import that it follows, or of the
    condition that it stands under.
    """
    lines = source.splitlines()

    def comment(line: str) -> str:
        said = line.partition("#")[2].strip()
        return "" if said.startswith(("noqa", "type:")) and not said.partition("  ")[2] else said

    found = []
    waiting = [i for i in imports(path, source) if i.local and not i.typing]
    starts = {i.line for i in waiting}
    for line, name, _, _ in waiting:
        if name.partition(".")[0] in sys.stdlib_module_names:
            continue
        first = line
        while first - 1 in starts:
            first -= 1
        above = lines[first - 2].strip()
        said = [comment(text) for text in lines[first - 1 : line]]
        if above.startswith("#") or above.partition("#")[0].rstrip().endswith(":"):
            said.append(comment(above))
        if not any(said):
            found.append(f"{path}:{line} imports {name}")
    return list(dict.fromkeys(found))


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_imports_inside_functions_say_why(path: Path) -> None:
    assert unexplained(path, SOURCES[path]) == []


@pytest.mark.parametrize(
    ("body", "count"),
    [
        ("from flowgraph.data import series", 1),
        ("import jax", 1),
        ("import jax  # noqa: F401", 1),
        ("import jax  # optional", 0),
        ("# JAX is optional.\n    import jax\n    import jax.numpy as jnp", 0),
        ("# JAX is optional.\n    x = 1\n    import jax", 1),
        ("import json", 0),
        ("import jax  # optional, with what follows\n    import jaxlib", 0),
        ("if fast:  # only then\n        import jax", 0),
        ("if fast:\n        import jax", 1),
        ("x = 1  # one\n    import jax", 1),
        ("importlib.import_module('jax')", 1),
    ],
)
def test_imports_without_a_reason_are_found(body: str, count: int) -> None:
    assert len(unexplained(Path("flowgraph/data/a.py"), f"def f():\n    {body}\n")) == count


# Sizes.


def lying_in(folder: Path, files: Iterable[Path]) -> set[str]:
    """The modules and packages directly in a folder."""
    return {path.relative_to(folder).parts[0] for path in files if path.is_relative_to(folder)} - {
        "__init__.py"
    }


def test_few_things_lie_in_the_hall() -> None:
    there = lying_in(Path("flowgraph"), MODULES)
    assert {"errors.py", "language"} <= there
    assert len(there) <= MAX_ROOMS, f"flowgraph/ holds {sorted(there)}: make a room of some"


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_module_is_one_chapter(path: Path) -> None:
    text = SOURCES[path]
    assert ast.get_docstring(ast.parse(text)), f"{path} has no docstring"
    lines = text.count("\n")
    assert lines <= MAX_LINES, f"{path} has {lines} lines, more than {MAX_LINES}: split it"
