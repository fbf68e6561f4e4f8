"""Packages of others that only some ways out need, and what to install where one is missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from flowgraph.errors import MissingDependencyError


def needed(package: str, who: str, extra: str) -> Any:
    """An optional package, imported when it is first asked for.

    Args:
        package: what to import: "mcap.writer".
        who: asks for it, for the message.
        extra: the extra of this distribution that installs it.

    Raises:
        MissingDependencyError: where it cannot be imported.
    """
    try:
        return import_module(package)
    except ImportError:
        raise MissingDependencyError(
            f"{who} needs {extra}",
            expected=f"the Python package {package.partition('.')[0]}",
            got="it cannot be imported",
            fix=f'pip install "flowgraph-filters[{extra}]"',
        ) from None
