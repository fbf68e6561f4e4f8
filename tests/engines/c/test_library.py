"""What a run remembers in C: read where it lies, copied when asked, the same whatever the stretches."""

from __future__ import annotations

import numpy as np

from flowgraph import Scalar, Stream, graph, lower, scan
from flowgraph.engines.c.library import Compiled, State


@graph
def summed(x: Stream[Scalar]):
    return {"sum": scan(x, lambda s, x: s + x, init=0.5)}


def played(library: Compiled, chunk: int) -> tuple[State, list[float]]:
    library.chunk = chunk
    cells = [c.reset for r in library.pipeline.registers for c in r.cells]
    state = State(library, cells, np.zeros(2, np.uint32))
    rows = library.rows([[np.arange(5.0)]])
    pieces = list(library.play(state, np.arange(5), np.ones(5, np.int64), rows))
    assert [p.ticks for p in pieces] == [chunk] * (5 // chunk) + [5 % chunk] * (5 % chunk > 0)
    return state, [float(v) for p in pieces for v in p.outputs[0][1][0]]


def test_a_run_goes_on_from_stretch_to_stretch_and_its_cells_are_copied_once():
    library = Compiled(lower(summed.build()), np.float64, [1])
    ends = []
    for chunk in (1, 2, 5):
        state, found = played(library, chunk)
        assert found == [0.5, 1.5, 3.5, 6.5, 10.5]
        ends.append([cell.tolist() for cell in state.after()])
        (there, *_), (copied, *_) = state.now(), state.after()
        there += 1.0  # a view of what the run has: so the copy is behind it
        assert state.now()[0] == copied + 1.0
    assert ends[0] == ends[1] == ends[2]
    assert 10.5 in ends[0]
