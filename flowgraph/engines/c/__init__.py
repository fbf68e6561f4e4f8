"""C99 from a pipeline: generated, compiled, and called in-process."""

from __future__ import annotations

from flowgraph.engines.c.compile import FLAGS, CompileError, build, cache_folder
from flowgraph.engines.c.harness import write_c, write_events
from flowgraph.engines.c.source import Source, generate

__all__ = ["FLAGS", "CompileError", "Source", "build", "cache_folder", "generate", "write_c", "write_events"]
