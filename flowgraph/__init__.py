"""Declare a filter once as a graph; draw it, simulate it, and lower it to a fixed-size pipeline."""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING

from flowgraph.moved import lead as _lead
from flowgraph.verbs import provide as _provide

if _TYPE_CHECKING:
    from flowgraph.data.arrival import batched, delayed, reorder, replayed, timeouts
    from flowgraph.data.batch import Batch
    from flowgraph.data.export.text import write_table, write_tum
    from flowgraph.data.flight import Flight
    from flowgraph.data.inputs import arrays, clocks_of, ticks, timing_of
    from flowgraph.data.progress import ProgressBar
    from flowgraph.data.reading import read_pieces
    from flowgraph.data.registry import Case, Report, find_graph, load_flight
    from flowgraph.data.result import Result
    from flowgraph.data.series import Series
    from flowgraph.drawing.live import LiveView
    from flowgraph.engines.live import Live
    from flowgraph.engines.many import simulate_many
    from flowgraph.engines.options import Checkpoint
    from flowgraph.engines.python.run import Run
    from flowgraph.engines.simulate import simulate
    from flowgraph.engines.state import load_state, save_state
    from flowgraph.engines.streaming import Streamed, simulate_to_parquet
    from flowgraph.errors import (
        ClockError,
        CycleError,
        DataError,
        DeclarationError,
        DivergedError,
        FifoOverflowError,
        FlowgraphError,
        LoweringError,
        MissingDependencyError,
        OutputError,
        PipelineError,
        PluginError,
        TypeMismatchError,
        UnknownNameError,
    )
    from flowgraph.language.block import Block, block, when
    from flowgraph.language.clock import aperiodic, periodic
    from flowgraph.language.declare import delay, graph
    from flowgraph.language.graph import Graph
    from flowgraph.language.joins import collect, every, latest, merge, sink
    from flowgraph.language.late import absent_for, label_data, resample_at, zip_last
    from flowgraph.language.moore import moore
    from flowgraph.language.operations import drop, group_by, scan, take_while, tap, until, unzip
    from flowgraph.language.pairs import match, zip, zip_latest, zip_latest_right
    from flowgraph.language.stamps import stamp_of
    from flowgraph.language.stream import Held, Stream, apply
    from flowgraph.language.timed import delta_time, high_pass, integrate, low_pass
    from flowgraph.language.typed import Namespace, typed_block
    from flowgraph.language.windows import batch, flat_map, padded, reduce, stacked, window
    from flowgraph.pipeline.lowering import lower
    from flowgraph.pipeline.pipeline import Pipeline
    from flowgraph.recorder.derivatives import jacobian
    from flowgraph.types import Array, Scalar, Signal, Tick, boolean, integer, real

# A name is imported when it is first asked for: who declares a graph pays for no engine, and who asks for a
# version pays for neither.
_LATER = {
    "ClockError": "flowgraph.errors",
    "CycleError": "flowgraph.errors",
    "DataError": "flowgraph.errors",
    "DeclarationError": "flowgraph.errors",
    "DivergedError": "flowgraph.errors",
    "FifoOverflowError": "flowgraph.errors",
    "FlowgraphError": "flowgraph.errors",
    "LoweringError": "flowgraph.errors",
    "MissingDependencyError": "flowgraph.errors",
    "OutputError": "flowgraph.errors",
    "PipelineError": "flowgraph.errors",
    "PluginError": "flowgraph.errors",
    "TypeMismatchError": "flowgraph.errors",
    "UnknownNameError": "flowgraph.errors",
    "Block": "flowgraph.language.block",
    "block": "flowgraph.language.block",
    "when": "flowgraph.language.block",
    "aperiodic": "flowgraph.language.clock",
    "periodic": "flowgraph.language.clock",
    "delay": "flowgraph.language.declare",
    "graph": "flowgraph.language.declare",
    "Graph": "flowgraph.language.graph",
    "collect": "flowgraph.language.joins",
    "every": "flowgraph.language.joins",
    "latest": "flowgraph.language.joins",
    "merge": "flowgraph.language.joins",
    "sink": "flowgraph.language.joins",
    "absent_for": "flowgraph.language.late",
    "label_data": "flowgraph.language.late",
    "resample_at": "flowgraph.language.late",
    "zip_last": "flowgraph.language.late",
    "moore": "flowgraph.language.moore",
    "drop": "flowgraph.language.operations",
    "group_by": "flowgraph.language.operations",
    "scan": "flowgraph.language.operations",
    "take_while": "flowgraph.language.operations",
    "tap": "flowgraph.language.operations",
    "until": "flowgraph.language.operations",
    "unzip": "flowgraph.language.operations",
    "match": "flowgraph.language.pairs",
    "zip": "flowgraph.language.pairs",
    "zip_latest": "flowgraph.language.pairs",
    "zip_latest_right": "flowgraph.language.pairs",
    "stamp_of": "flowgraph.language.stamps",
    "Held": "flowgraph.language.stream",
    "Stream": "flowgraph.language.stream",
    "apply": "flowgraph.language.stream",
    "delta_time": "flowgraph.language.timed",
    "high_pass": "flowgraph.language.timed",
    "integrate": "flowgraph.language.timed",
    "low_pass": "flowgraph.language.timed",
    "Namespace": "flowgraph.language.typed",
    "typed_block": "flowgraph.language.typed",
    "batch": "flowgraph.language.windows",
    "flat_map": "flowgraph.language.windows",
    "padded": "flowgraph.language.windows",
    "reduce": "flowgraph.language.windows",
    "stacked": "flowgraph.language.windows",
    "window": "flowgraph.language.windows",
    "Array": "flowgraph.types",
    "Scalar": "flowgraph.types",
    "Signal": "flowgraph.types",
    "Tick": "flowgraph.types",
    "boolean": "flowgraph.types",
    "integer": "flowgraph.types",
    "real": "flowgraph.types",
    "batched": "flowgraph.data.arrival",
    "delayed": "flowgraph.data.arrival",
    "reorder": "flowgraph.data.arrival",
    "replayed": "flowgraph.data.arrival",
    "timeouts": "flowgraph.data.arrival",
    "Batch": "flowgraph.data.batch",
    "write_table": "flowgraph.data.export.text",
    "write_tum": "flowgraph.data.export.text",
    "arrays": "flowgraph.data.inputs",
    "clocks_of": "flowgraph.data.inputs",
    "ticks": "flowgraph.data.inputs",
    "timing_of": "flowgraph.data.inputs",
    "ProgressBar": "flowgraph.data.progress",
    "Case": "flowgraph.data.registry",
    "Report": "flowgraph.data.registry",
    "find_graph": "flowgraph.data.registry",
    "load_flight": "flowgraph.data.registry",
    "read_pieces": "flowgraph.data.reading",
    "Result": "flowgraph.data.result",
    "Flight": "flowgraph.data.flight",
    "Series": "flowgraph.data.series",
    "LiveView": "flowgraph.drawing.live",
    "simulate_many": "flowgraph.engines.many",
    "Live": "flowgraph.engines.live",
    "Checkpoint": "flowgraph.engines.options",
    "Run": "flowgraph.engines.python.run",
    "simulate": "flowgraph.engines.simulate",
    "simulate_to_parquet": "flowgraph.engines.streaming",
    "Streamed": "flowgraph.engines.streaming",
    "load_state": "flowgraph.engines.state",
    "save_state": "flowgraph.engines.state",
    "lower": "flowgraph.pipeline.lowering",
    "Pipeline": "flowgraph.pipeline.pipeline",
    "jacobian": "flowgraph.recorder.derivatives",
}

_import_module("flowgraph.engines")  # watches for forks from here on
_provide(
    {
        "Block.__call__": "flowgraph.language.wiring:wire",
        "Stream.delay": "flowgraph.language.declare:delay",
        "Stream.drop": "flowgraph.language.operations:drop",
        "Stream.every": "flowgraph.language.joins:every",
        "Stream.take_while": "flowgraph.language.operations:take_while",
        "Stream.tap": "flowgraph.language.operations:tap",
        "Graph.draw": "flowgraph.drawing.draw:draw",
        "Graph.text": "flowgraph.drawing.text:draw_text",
        "Graph.to_networkx": "flowgraph.drawing.text:to_networkx",
        "Batch._repr_html_": "flowgraph.drawing.notebook:batch_cell",
        "Case._repr_html_": "flowgraph.drawing.notebook:case_cell",
        "Case.page": "flowgraph.drawing.notebook:case_page",
        "Flight._repr_html_": "flowgraph.drawing.notebook:flight_cell",
        "Graph._repr_mimebundle_": "flowgraph.drawing.notebook:graph_cell",
        "Result._repr_html_": "flowgraph.drawing.notebook:result_cell",
        "Series._repr_html_": "flowgraph.drawing.notebook:series_cell",
        "Result.plot": "flowgraph.drawing.plot:plot_result",
        "Pipeline.from_json": "flowgraph.pipeline.description:from_json",
        "Pipeline.to_json": "flowgraph.pipeline.description:to_json",
        "Pipeline.listing": "flowgraph.pipeline.listing:listing",
        "Pipeline.run": "flowgraph.engines.playback:run_pipeline",
    }
)


def __getattr__(name: str) -> object:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(_import_module(_LATER[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))


__all__ = [
    "Array",
    "Batch",
    "Block",
    "Case",
    "Checkpoint",
    "ClockError",
    "CycleError",
    "DataError",
    "DeclarationError",
    "DivergedError",
    "FifoOverflowError",
    "Flight",
    "FlowgraphError",
    "Graph",
    "Held",
    "Live",
    "LiveView",
    "LoweringError",
    "MissingDependencyError",
    "Namespace",
    "OutputError",
    "Pipeline",
    "PipelineError",
    "PluginError",
    "ProgressBar",
    "Report",
    "Result",
    "Run",
    "Scalar",
    "Series",
    "Signal",
    "Stream",
    "Streamed",
    "Tick",
    "TypeMismatchError",
    "UnknownNameError",
    "absent_for",
    "aperiodic",
    "apply",
    "arrays",
    "batch",
    "batched",
    "block",
    "boolean",
    "clocks_of",
    "collect",
    "delay",
    "moore",
    "delayed",
    "delta_time",
    "drop",
    "every",
    "find_graph",
    "flat_map",
    "graph",
    "group_by",
    "high_pass",
    "integer",
    "integrate",
    "jacobian",
    "label_data",
    "latest",
    "load_flight",
    "load_state",
    "low_pass",
    "lower",
    "match",
    "merge",
    "padded",
    "periodic",
    "read_pieces",
    "real",
    "reduce",
    "reorder",
    "replayed",
    "resample_at",
    "save_state",
    "scan",
    "simulate",
    "simulate_many",
    "simulate_to_parquet",
    "sink",
    "stacked",
    "stamp_of",
    "take_while",
    "tap",
    "ticks",
    "timeouts",
    "timing_of",
    "typed_block",
    "until",
    "unzip",
    "when",
    "window",
    "write_table",
    "write_tum",
    "zip",
    "zip_last",
    "zip_latest",
    "zip_latest_right",
]

_lead(_import_module(__name__))
