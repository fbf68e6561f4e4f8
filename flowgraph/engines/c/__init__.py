"""C99 from a pipeline: generated, compiled, and called in-process, or written out as a product of its own.

`source` puts a file together out of expressions, statements and loops, whose order and memory `schedule` and
`nodes` know; `harness` writes it with a header, a replay program and a Makefile. `compile` keeps what the
compiler made, `library` calls it, `batch` on as many threads as there are processors; `engine` is its face.
"""

from __future__ import annotations

from flowgraph.engines.c.compile import FLAGS, CompileError, build, cache_folder
from flowgraph.engines.c.harness import write_c, write_events
from flowgraph.engines.c.source import Source, generate

__all__ = ["FLAGS", "CompileError", "Source", "build", "cache_folder", "generate", "write_c", "write_events"]
