"""The package: what a wheel holds, what an import costs, which entry points it has."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.test_house import LINKED, MODULES, PACKAGES, ROOT

HEAVY = ("jax", "matplotlib", "cv2", "jsonschema", "scipy", "networkx")


@pytest.mark.parametrize("name", LINKED)
def test_links_are_relative(name: str) -> None:
    link = ROOT / "flowgraph" / name
    assert link.is_symlink()
    assert os.readlink(link) == f"../{name}"
    assert (ROOT / name).is_dir()
    assert not (ROOT / name).is_symlink()


def loaded(program: str, names: tuple[str, ...]) -> list[str]:
    """Which of the modules a fresh process has loaded after some lines."""
    code = f"import sys\n{program}\nprint(*[name for name in {names!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_import_is_light() -> None:
    """`import flowgraph` loads nothing that no name was asked of; to declare loads no library but NumPy."""
    assert loaded("import flowgraph", (*HEAVY, "numpy", "flowgraph.types", "flowgraph.language")) == []
    declare = "from flowgraph import Signal, Stream, block, graph, latest, real, window, zip, simulate"
    assert loaded(declare, HEAVY) == []
    assert loaded(declare, ("numpy", "flowgraph.language.graph"))  # the test can see what is loaded


def test_a_graph_brings_no_other_graph() -> None:
    others = ("flowgraph.graphs.ukf", "flowgraph.graphs.rbpf_indoor", "cv2")
    assert loaded("from flowgraph.graphs import ins_eskf", others) == []
    whole = (
        "from flowgraph.graphs import ekf, ins_eskf; import flowgraph.graphs.ekf; ekf.build, ins_eskf.build"
    )
    assert loaded(f"{whole}; from flowgraph.graphs import ekf; ekf.build", others) == []
    assert loaded("from flowgraph.graphs import ukf", others) == ["flowgraph.graphs.ukf"]


def test_a_study_starts_without_the_parts_of_scipy() -> None:
    """Each worker of a study imports flights, filters and scores: SciPy's parts take a second."""
    parts = ("scipy.spatial", "scipy.signal", "scipy.linalg", "scipy.special")
    code = (
        "import sys, flowgraph.study, flowgraph.blocks.flights, flowgraph.graphs.ekf;"
        f" print(*[name for name in {parts!r} if name in sys.modules])"
    )
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
        schemas = {
            path.relative_to(ROOT).as_posix() for path in (ROOT / "flowgraph/pipeline").rglob("*.json")
        }
        assert schemas, "flowgraph/pipeline/ holds no schema"
        assert schemas | {"flowgraph/py.typed"} <= set(entries)

        # The scripts of the pages with their licences, and not what they are made from.
        parts = ("diagram.js", "run.js", "live.js", "report.js", "style.css", "NOTICES.txt")
        assert {n.rpartition("/")[2] for n in entries if n.startswith("flowgraph/drawing/pages/")} == set(
            parts
        )
        for place in (f"flowgraph/drawing/pages/{part}" for part in parts):
            assert archive.read(place) == (ROOT / place).read_bytes()
        assert not [name for name in entries if "/front/" in name]
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
