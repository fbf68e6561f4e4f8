"""Plain instructions: factorizations and powers written out, to the same numbers."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest

from flowgraph import LoweringError, Stream, block, graph, lower, real
from flowgraph.pipeline.plain import plain
from flowgraph.recorder.namespaces import solve_positive

TIMES = np.arange(4, dtype=np.int64) * 1_000_000


Three = Annotated[Any, real(3)]


def _played(function, values):
    """What a pipeline and its plain form give for three numbers, and the plain form."""

    @block
    def one(x: Three, *, xp) -> Three:
        return function(x, xp)

    @graph
    def whole(x: Stream[Three]):
        return {"y": one(x)}

    pipeline = lower(whole.build())
    return [p.run({"x": (TIMES, values)})["y"]["value"] for p in (pipeline, plain(pipeline))], plain(pipeline)


def _spd(x, xp):
    a = x[:, None] * x + 3.0 * xp.eye(3)
    return xp.linalg.solve(a, x)


def _lower(x, xp):
    a = x[:, None] * x + 3.0 * xp.eye(3)
    return xp.linalg.cholesky(a)[:, 0] + xp.linalg.cholesky(a)[2, :]


def _assumed(x, xp):
    a = xp.stack([x[:, None] * x + 3.0 * xp.eye(3), xp.eye(3)])
    one = solve_positive(a, xp.stack([x, x * x], axis=-1), xp)
    return one[0, :, 0] + one[1, :, 1] + solve_positive(a[0], x, xp)


FORMS = {
    "solve": _spd,
    "solve, positive": _assumed,
    "solve, one number": lambda x, xp: solve_positive(x[:1, None] ** 2 + 1.0, x[None, :], xp)[0],
    "solve, rows exchanged": lambda x, xp: xp.linalg.solve(
        xp.stack([x * xp.asarray([0.0, 1.0, 0.0]), x, x[::-1] ** 2]), x
    ),
    "cholesky": _lower,
    "pow": lambda x, xp: x**5,
    "mean": lambda x, xp: x * xp.mean(x),
    "cross": lambda x, xp: xp.linalg.cross(x, x[::-1]),
    "outer": lambda x, xp: xp.linalg.outer(x, x) @ x,
    "square": lambda x, xp: xp.square(x),
}


@pytest.mark.parametrize("name", FORMS)
def test_the_same_numbers_without_the_operation(name):
    values = np.random.default_rng(3).normal(size=(4, 3)) + 0.1
    (whole, written), pipeline = _played(FORMS[name], values)
    np.testing.assert_allclose(written, whole, rtol=1e-9, atol=1e-12)
    left = {i.op for i in pipeline.instructions}
    assert not left & {"solve", "cholesky", "pow", "mean", "cross", "outer", "square"}


def test_what_is_plain_stays_as_it_is():
    _, pipeline = _played(FORMS["solve"], np.ones((4, 3)))
    assert plain(pipeline).to_json() == pipeline.to_json()


def test_a_power_without_a_plain_form_names_its_line():
    with pytest.raises(LoweringError, match=r"(?s)test_plain:\d+.*whole number from 1 to 16.*2.5"):
        _played(lambda x, xp: xp.abs(x) ** 2.5, np.ones((4, 3)))


def test_a_positive_matrix_is_solved_without_exchange_of_rows():
    """Six entries and three quotients of the factor, a quotient an unknown, and no comparison."""

    ways = {"any": lambda a, b, xp: xp.linalg.solve(a, b), "positive": solve_positive}
    found = {}
    for name, way in ways.items():
        solved = lambda x, xp, way=way: way(x[:, None] * x + 3.0 * xp.eye(3), x, xp)
        _, made = _played(solved, np.ones((4, 3)))
        found[name] = {i.op for i in made.instructions}
        divided = sum(int(np.prod(i.spec.shape)) for i in made.instructions if i.op == "divide")
        assert divided == {"any": 12, "positive": 6}[name]
    assert {"argmax", "where"} <= found["any"]
    assert not {"argmax", "where", "abs"} & found["positive"]
