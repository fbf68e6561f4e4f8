"""The house: what a wheel holds, which way imports run, what an import costs, how long a module is."""

from __future__ import annotations

import ast
import importlib
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINKED = ("blocks", "graphs")
PACKAGES = ("flowgraph", *LINKED)
MAX_LINES = 450
HEAVY = ("jax", "matplotlib", "cv2", "jsonschema", "scipy", "networkx")


def modules(package: str) -> list[Path]:
    """The Python files of one of the three packages, relative to the root; links are not followed."""
    found: list[Path] = []
    for folder, subfolders, files in os.walk(ROOT / package, followlinks=False):
        subfolders[:] = [name for name in subfolders if not (Path(folder) / name).is_symlink()]
        found += [(Path(folder) / name).relative_to(ROOT) for name in files if name.endswith(".py")]
    return sorted(found)


MODULES = [path for package in PACKAGES for path in modules(package)]


def dotted(path: Path) -> str:
    """The name that users import a file by: blocks/a.py is flowgraph.blocks.a."""
    parts = path.with_suffix("").parts
    parts = parts if parts[0] == "flowgraph" else ("flowgraph", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(source: str, module: str, is_package: bool = False) -> Iterator[tuple[int, str]]:
    """Each (line, absolute name) that a module's text imports, wherever in the text that is.

    `from a import b` gives a.b, for b may be a module. An import by a literal string counts as well.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".") if is_package else module.split(".")[:-1]
                package = package[: len(package) - (node.level - 1)]
                base = ".".join([*package, base]) if base else ".".join(package)
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args:
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            first = node.args[0]
            literal = isinstance(first, ast.Constant) and isinstance(first.value, str)
            if called in ("import_module", "__import__") and literal:
                yield node.lineno, str(first.value)  # type: ignore[attr-defined]


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


# What a module of each package must not import. The short names would work in a checkout and fail in a wheel.
FORBIDDEN = {
    "flowgraph": ("flowgraph.blocks", "flowgraph.graphs", "blocks", "graphs"),
    "blocks": ("flowgraph.graphs", "blocks", "graphs"),
    "graphs": ("blocks", "graphs"),
}


def wrong_imports(path: Path, source: str) -> list[str]:
    return [
        f"{path}:{line} imports {name}"
        for line, name in imports(source, dotted(path), path.name == "__init__.py")
        if any(within(name, package) for package in FORBIDDEN[path.parts[0]])
    ]


def test_each_package_has_modules() -> None:
    for package in PACKAGES:
        assert ROOT / package / "__init__.py" in [ROOT / path for path in modules(package)]


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_imports_run_one_way(path: Path) -> None:
    assert wrong_imports(path, (ROOT / path).read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("flowgraph/a.py", "import flowgraph.blocks.sensors"),
        ("flowgraph/a.py", "from flowgraph import blocks"),
        ("flowgraph/a.py", "from . import graphs"),
        ("flowgraph/__init__.py", "from .blocks import Imu"),
        ("flowgraph/a.py", "def f():\n    from .blocks.sensors import Imu"),
        ("flowgraph/a.py", "importlib.import_module('flowgraph.graphs')"),
        ("flowgraph/a.py", "import blocks"),
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
        ("flowgraph/a.py", "from . import clock\nfrom .types import Stream\nimport numpy as np"),
        ("blocks/a.py", "from flowgraph import Stream\nfrom flowgraph.blocks import a\nfrom . import maths"),
        ("graphs/a.py", "from flowgraph import graph\nfrom flowgraph.blocks import Imu\nfrom . import base"),
    ],
)
def test_right_imports_pass(path: str, source: str) -> None:
    assert wrong_imports(Path(path), source) == []


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_module_is_one_chapter(path: Path) -> None:
    text = (ROOT / path).read_text(encoding="utf-8")
    assert ast.get_docstring(ast.parse(text)), f"{path} has no docstring"
    lines = text.count("\n")
    assert lines <= MAX_LINES, f"{path} has {lines} lines, more than {MAX_LINES}: split it"


@pytest.mark.parametrize("name", LINKED)
def test_links_are_relative(name: str) -> None:
    link = ROOT / "flowgraph" / name
    assert link.is_symlink()
    assert os.readlink(link) == f"../{name}"
    assert (ROOT / name).is_dir()
    assert not (ROOT / name).is_symlink()


def test_import_is_light() -> None:
    """`import flowgraph` loads no library that only some of its uses need."""
    code = f"import sys, flowgraph; print(*[name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_entry_points_exist() -> None:
    with open(ROOT / "pyproject.toml", "rb") as file:
        project = tomllib.load(file)["project"]
    for group in (project["scripts"], *project["entry-points"].values()):
        for target in group.values():
            module, name = target.split(":")
            assert getattr(importlib.import_module(module), name, None) is not None, target


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist and the wheel made from it. A copy of the tree is built, without leftovers."""
    source = tmp_path_factory.mktemp("source") / "tree"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    for name in PACKAGES:
        ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=ignore)
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (found,) = built.glob("*.whl")
    return found


@pytest.mark.slow
def test_wheel_holds_real_files_under_one_name(wheel: Path) -> None:
    assert wheel.name.startswith("flowgraph_filters-")
    with zipfile.ZipFile(wheel) as archive:
        entries = {info.filename: info for info in archive.infolist() if not info.is_dir()}
        assert {name.split("/")[0] for name in entries if ".dist-info/" not in name} == {"flowgraph"}
        links = [name for name, info in entries.items() if (info.external_attr >> 16) & 0o170000 == 0o120000]
        assert links == []

        # Python files: exactly those of the tree, with the same bytes.
        there = {path if path.parts[0] == "flowgraph" else "flowgraph" / path: path for path in MODULES}
        python = {name for name in entries if name.endswith(".py")}
        assert python == {path.as_posix() for path in there}
        for name, path in there.items():
            assert archive.read(name.as_posix()) == (ROOT / path).read_bytes()
        assert {"flowgraph/blocks/__init__.py", "flowgraph/graphs/__init__.py"} <= python

        # Data: the schemas, the marker of a typed package, the licence.
        schemas = {f"flowgraph/{path.name}" for path in (ROOT / "flowgraph").glob("*.json")}
        assert schemas, "flowgraph/ holds no schema"
        assert schemas | {"flowgraph/py.typed"} <= set(entries)
        assert any(name.endswith(".dist-info/licenses/LICENSE") for name in entries)


@pytest.mark.slow
def test_sdist_holds_what_the_wheel_needs(built: Path) -> None:
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    python = {f"flowgraph/{name}/__init__.py" for name in LINKED}
    assert python | {"pyproject.toml", "README.md", "LICENSE"} <= names


@pytest.mark.slow
def test_wheel_imports_away_from_the_checkout(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    names = ("flowgraph", *(f"flowgraph.{name}" for name in LINKED))
    code = f"import importlib; [print(importlib.import_module(name).__file__) for name in {names!r}]"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert all(Path(path).is_relative_to(tmp_path / "site") for path in done.stdout.splitlines())
