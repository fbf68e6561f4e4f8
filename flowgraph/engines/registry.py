"""Finding engines by name: nothing but this registry knows which there are."""

from __future__ import annotations

from flowgraph.data.registry import entry_names, find_entry, installed
from flowgraph.engines.contract import Engine, PipelineEngine
from flowgraph.errors import DeclarationError, UnknownNameError

GROUP = "flowgraph.engines"


def engine_names() -> list[str]:
    """The names of all installed engines."""
    return entry_names(GROUP)


def find_engine(name: str) -> Engine:
    """The installed engine of that name.

    Raises:
        UnknownNameError: listing the names that exist; PluginError: if its package cannot be imported.
        DeclarationError: where what is installed under the name is no engine.
    """
    found = find_entry(GROUP, name)
    if not isinstance(found, Engine):
        raise DeclarationError(
            "what is installed under this name is no engine",
            path=f"{GROUP}, {name}",
            expected="an object of a subclass of PipelineEngine or BlockEngine",
            got=repr(found)[:80],
            fix="let the entry point name an instance, such as toy = 'package.module:ENGINE'",
        )
    return found


def find_pipeline_engine(name: str) -> PipelineEngine:
    """The installed engine of that name, which must be one that plays pipelines.

    Raises:
        UnknownNameError: listing those that do.
    """
    found = find_engine(name) if name in engine_names() else None
    if not isinstance(found, PipelineEngine):
        raise UnknownNameError("engine of a pipeline", name, _pipeline_engines())
    return found


def writers() -> dict[str, PipelineEngine]:
    """The engines that write pipelines as source text, by name."""
    return {n: e for n, e in _pipeline_engines().items() if e.writes}


def _pipeline_engines() -> dict[str, PipelineEngine]:
    found, _ = installed(GROUP)
    return {n: e for n, e in found.items() if isinstance(e, PipelineEngine)}
