"""Rows of many particles: what puts them together is taken apart, nothing else, and what is dear is kept."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.pipeline.optimise.rows import LEAST_LANES, take_rows
from tests.pipeline.optimise.programs import counts, record, same

N = LEAST_LANES
RNG = np.random.default_rng(1)
SIGNS = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def turned(xp, x):
    """Each column with its rows in turn."""
    return xp.concat([x[1:], x[:1]], axis=0)


def cross(xp, a, b):
    return turned(xp, a * turned(xp, b) - b * turned(xp, a))


CASES = {
    "cross": (cross, (3, N), (3, N)),
    "signs": (lambda xp, x, y: (SIGNS @ (x * y)) * 2.0, (3, N), (3, N)),
    "both": (lambda xp, x, y: cross(xp, SIGNS.T @ x, y) + y, (2, N), (3, N)),
    "functions": (lambda xp, x, y: xp.exp(turned(xp, x)) * xp.sum(turned(xp, y) * x, axis=0), (3, N), (3, N)),
    "repeated": (lambda xp, x, y: turned(xp, xp.broadcast_to(x[None], (3, N))) * y, (N,), (3, N)),
    "grid": (lambda xp, x, y: xp.stack([x * y, turned(xp, x)], axis=1)[:, 0, :], (3, N), (N,)),
    "sums": (lambda xp, x, y: turned(xp, x) @ turned(xp, y).mT, (3, N), (3, N)),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_in_rows_it_gives_the_same(name):
    step, *shapes = CASES[name]
    program = record(step, *shapes, lanes=(N,))
    rows = take_rows(program)
    assert rows.instructions != program.instructions
    same(program, rows, *(RNG.normal(size=s) for s in shapes))


def test_a_cross_product_is_arithmetic_on_rows():
    rows = take_rows(record(cross, (3, N), (3, N), lanes=(N,)))
    assert counts(rows)["concat"] == 0
    assert counts(rows)["stack"] == 1
    assert {i.spec.shape for i in rows.instructions if i.op in ("multiply", "subtract")} == {(N,)}


@pytest.mark.parametrize(
    ("step", "size"),
    [
        (lambda xp, x: xp.sqrt(x * x + 1.0), N),  # the same for each element
        (cross, N - 1),  # few particles
        (lambda xp, x: np.full((2, 3), 0.5) @ x, N),  # a matrix of other numbers
        (lambda xp, x: xp.concat([x, x], axis=-1), N),  # along the particles
    ],
)
def test_what_is_no_rearrangement_of_many_stays_whole(step, size):
    program = record(lambda xp, x: step(xp, x, x) if step is cross else step(xp, x), (3, size), lanes=(size,))
    assert take_rows(program).instructions == program.instructions


def test_a_register_that_the_tick_reads_again_is_kept_and_made_once():
    def step(xp, x, y):
        after = cross(xp, x, y)
        return xp.sum(xp.exp(after), axis=0), after

    program = record(step, (3, N), (3, N), memory=(0,), lanes=(N,))
    rows = take_rows(program)
    assert counts(rows)["materialise"] == 3
    kept = {i.out for i in rows.instructions if i.op == "materialise"}
    whole = next(i for i in rows.instructions if i.out == rows.writes[0])
    assert set(whole.args) == kept
    same(program, rows, *(RNG.normal(size=(3, N)) for _ in range(2)))


def test_dear_rows_that_are_needed_again_are_kept_and_others_are_not():
    def dear(times):
        def step(xp, x, y):
            z = x
            for _ in range(times):
                z = cross(xp, z, y)
            return z * z + turned(xp, z)

        return counts(take_rows(record(step, (3, N), (3, N), lanes=(N,))))["materialise"]

    assert dear(1) == 0
    assert dear(3) > 0
