"""The reference: a page for each public package, made of the docstrings and signatures in the code.

Public is what stands in the `__all__` of a package. Each name has an entry, under its own heading and anchor,
with its arguments, what it raises, and its source. After the build, the anchors are counted: a name without
one fails it.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import flowgraph


def packages() -> list[ModuleType]:
    """The packages that say what in them is public, the first of all first."""
    found = [flowgraph]
    for info in pkgutil.walk_packages(flowgraph.__path__, "flowgraph."):
        if info.ispkg:
            module = importlib.import_module(info.name)
            if getattr(module, "__all__", None):
                found.append(module)
    return found


def names(package: ModuleType) -> list[str]:
    """The public names of a package, without its modules, which have pages or docstrings of their own."""
    modules = {info.name for info in pkgutil.iter_modules(package.__path__)}
    return [
        n for n in package.__all__ if n not in modules or not inspect.ismodule(getattr(package, n, package))
    ]


def place(package: ModuleType) -> str:
    """The page of a package."""
    return f"api/{package.__name__}.md"


def page(package: ModuleType) -> str:
    """The text of a package's page, which the docstrings are put into when it is built."""
    parts = [f"# {package.__name__}", inspect.getdoc(package) or ""]
    parts += [entry(package, name) for name in names(package)]
    return "\n\n".join(parts) + "\n"


def entry(package: ModuleType, name: str) -> str:
    """What stands for a name: its docstring, or of a constant and of the name of a type what it is."""
    thing, full = getattr(package, name), f"{package.__name__}.{name}"
    if str(getattr(thing, "__module__", "")).startswith("flowgraph") and hasattr(thing, "__name__"):
        return f"::: {full}"
    value = " ".join(repr(thing).split())
    return f"## {name} {{ #{full} }}\n\n```text\n{value if len(value) <= 300 else value[:300] + ' ...'}\n```"


def contents() -> str:
    """The first page: the packages, each with its names."""
    parts = ["# Reference", "Every public name, by the package that it is imported from."]
    for package in packages():
        first = (inspect.getdoc(package) or "").partition("\n")[0]
        links = ", ".join(f"[`{n}`]({package.__name__}.md#{package.__name__}.{n})" for n in names(package))
        parts += [f"## [{package.__name__}]({package.__name__}.md)", first, links]
    return "\n\n".join(parts) + "\n"


def pages() -> Iterator[tuple[str, str]]:
    """All pages of the reference, by place."""
    yield "api/index.md", contents()
    for package in packages():
        yield place(package), page(package)


def missing(site: Path) -> list[str]:
    """The public names that the built site has no entry for."""
    found = []
    for package in packages():
        file = site / "api" / package.__name__ / "index.html"
        text = file.read_text(encoding="utf-8") if file.exists() else ""
        there = set(re.findall(r'id="([\w.]+)"', text))
        found += [f"{package.__name__}.{n}" for n in names(package) if f"{package.__name__}.{n}" not in there]
    return found
