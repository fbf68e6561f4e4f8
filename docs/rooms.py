"""The rooms of flowgraph as a graph, for the picture of the architecture page.

Each block is a room, and its ports are what it is given and what it makes. The values are nothing; what
counts is the wiring, which is checked as that of any graph.
"""

from __future__ import annotations

from flowgraph import Array, Graph, Signal, Stream, block, graph, real


class Made(Signal):
    """What rooms hand on to each other: a stand-in, of one number."""

    it: Array = real()


class Problem(Made): ...


class Step(Made): ...


class Declaration(Made): ...


class Recording(Made): ...


class Instructions(Made): ...


class FrozenGraph(Made): ...


class Diagram(Made): ...


class Pipeline(Made): ...


class Ticks(Made): ...


class Result(Made): ...


class Source(Made): ...


class Table(Made): ...


@block
def blocks(problem: Problem) -> tuple[Step, Recording]:
    return Step(problem.it), Recording(problem.it)


@block
def graphs(problem: Problem, step: Step) -> Declaration:
    return Declaration(problem.it + step.it)


@block
def recorder(step: Step) -> Instructions:
    return Instructions(step.it)


@block
def language(declaration: Declaration, instructions: Instructions) -> FrozenGraph:
    return FrozenGraph(declaration.it + instructions.it)


@block
def drawing(graph: FrozenGraph) -> Diagram:
    return Diagram(graph.it)


@block
def data(recording: Recording) -> Ticks:
    return Ticks(recording.it)


@block
def pipeline(graph: FrozenGraph) -> Pipeline:
    return Pipeline(graph.it)


@block
def engines(graph: FrozenGraph, pipeline: Pipeline, ticks: Ticks) -> tuple[Result, Source]:
    return Result(graph.it + pipeline.it + ticks.it), Source(pipeline.it)


@block
def study(result: Result) -> Table:
    return Table(result.it)


@graph
def flowgraph(problem: Stream[Problem]):
    """What each room makes, and of what."""
    step, recording = blocks(problem)
    made = language(graphs(problem, step), recorder(step))
    result, source = engines(made, pipeline(made), data(recording))
    return {"diagram": drawing(made), "result": result, "source": source, "table": study(result)}


def house() -> Graph:
    """The picture's graph."""
    return flowgraph.build()
