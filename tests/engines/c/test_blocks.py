"""Products over particles go block by block with the loop that fills their factors, and to the same bits."""

import numpy as np
import pytest

from flowgraph import Array, Scalar, Series, Signal, Stream, aperiodic, block, graph, lower, real, simulate
from flowgraph.engines.c.blocks import BLOCK
from flowgraph.engines.c.library import Compiled, State
from flowgraph.engines.c.source import generate
from flowgraph.engines.c.statements import Writer
from tests.engines.c.support import replays, written


def cloud(n: int, rows: int = 9, *, also: bool = False):
    """A filter whose output is the second moment of n points that move."""

    class Moment(Signal):
        value: Array = real(rows, rows)

    @block
    def moment(state, x: Scalar, *, xp) -> tuple[Scalar, Moment]:
        moved = xp.sin(state * x + 0.1)
        outer = xp.matmul(moved * xp.exp(-x), xp.matrix_transpose(xp.cos(moved)))
        if also:
            outer = outer + xp.sum(moved * moved) * outer[0, 0]
        return moved, Moment(outer)

    @moment.init
    def _(x):
        return np.arange(rows * n).reshape(rows, n) % 17 / 17.0

    @graph
    def moments(x: Stream[Scalar]):
        return moment(x)

    return moments.build(x=aperiodic())


GIVEN = {"x": Series(np.arange(3) * 10, [0.5, -1.0, 2.0])}


@pytest.mark.parametrize("n", [4 * BLOCK, 5 * BLOCK + 1, 7 * BLOCK - 1])
def test_blocks_give_the_bits_of_the_whole(n, monkeypatch):
    built = cloud(n)
    pipeline = lower(built)
    assert "int32_t block" in generate(pipeline).source
    right = simulate(built, GIVEN, engine="python").output.leaves["value"]
    found = simulate(built, GIVEN, engine="c").output.leaves["value"]
    np.testing.assert_allclose(found, right, rtol=1e-11)
    monkeypatch.setattr(Writer, "blocks", False)
    monkeypatch.setattr("flowgraph.engines.c.library.kept_text", lambda p, stem, asked, write: write())
    assert "int32_t block" not in generate(pipeline).source
    whole = Compiled(pipeline, np.float64, [1])
    cells = [c.reset for r in pipeline.registers for c in r.cells]
    rows = whole.rows([[np.array([0.5, -1.0, 2.0])]])
    state = State(whole, cells, np.zeros(2, np.uint32))
    (piece,) = whole.play(state, GIVEN["x"].time, np.ones(3, np.int64), rows)
    assert np.array_equal(piece.outputs[0][1][0], found)


def test_factors_take_a_block_of_memory():
    """Twice 9 rows of 100,000 numbers would be 14 MB."""
    header = generate(lower(cloud(100_000))).header
    sizes = [int(line.split("[")[1].split("]")[0]) for line in header.splitlines() if "fg_work" in line]
    assert sum(sizes) < 50 * BLOCK


def test_what_is_read_elsewhere_stays_whole():
    """Few points, few rows, or a loop that also sums, are left as they were, and right."""
    for built in (cloud(4 * BLOCK - 1), cloud(4 * BLOCK, 3), cloud(4 * BLOCK, also=True)):
        right = simulate(built, GIVEN, engine="python").output.leaves["value"]
        np.testing.assert_allclose(
            simulate(built, GIVEN, engine="c").output.leaves["value"], right, rtol=1e-11
        )


def test_a_program_of_its_own_has_blocks_too(tmp_path):
    built = cloud(4 * BLOCK + 7)
    done = replays(written(built, tmp_path), "0,x,0.5\n10,x,-1\n20,x,2\n")
    found = np.array([[float(x) for x in line.split(",")[2:]] for line in done.stdout.splitlines()])
    right = simulate(built, GIVEN, engine="python").output.leaves["value"].reshape(3, -1)
    np.testing.assert_allclose(found, right, rtol=1e-11)
