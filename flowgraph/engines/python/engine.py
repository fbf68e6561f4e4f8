"""Python's engine behind the contract of engines: the blocks themselves, in plain NumPy, event by event."""

from __future__ import annotations

from flowgraph.data.inputs import Inputs
from flowgraph.data.result import Result
from flowgraph.engines.contract import BlockEngine
from flowgraph.engines.options import RunOptions
from flowgraph.engines.python.run import Run
from flowgraph.errors import DeclarationError
from flowgraph.language.graph import Graph


class PythonEngine(BlockEngine):
    """Runs the blocks of a graph, so that a person can step through them with a debugger."""

    name = "python"
    dtypes = ("float64",)

    def check(self, options: RunOptions) -> None:
        if options.dtype != "float64":
            raise DeclarationError(
                "the Python engine computes in float64",
                path='engine="python"',
                expected="float64",
                got=options.dtype,
                fix='use engine="reference" or "xla" for float32',
            )
        if options.passes is not None:
            raise DeclarationError(
                "the Python engine runs the blocks themselves",
                path="passes",
                expected="no passes, or an engine that plays the instructions",
                got='engine="python"',
                fix='use engine="reference" or "xla"',
            )

    def run(self, graph: Graph, inputs: Inputs, options: RunOptions) -> Result:
        run = Run(graph, inputs, init=options.init, state=options.state, seed=options.seed)  # type: ignore[arg-type]
        return run.to_end(options.progress).result()


ENGINE = PythonEngine()
