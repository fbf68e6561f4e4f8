"""Each pass by itself, on a few lines that show what it is for and where it must hold back."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Stream, UnknownNameError, block, delay, graph, lower, real
from flowgraph.pipeline.optimise import DEFAULT, PASSES, RELYING, check_passes, optimise, usable, without
from flowgraph.pipeline.optimise.algebra import simplify
from flowgraph.pipeline.optimise.loops import gather, loops
from flowgraph.pipeline.optimise.simple import drop, share
from flowgraph.pipeline.optimise.sparse import mirror_products, tell_zeros
from flowgraph.pipeline.optimise.structure import split_products
from flowgraph.pipeline.optimise.symmetry import halve_products
from flowgraph.pipeline.optimise.unroll import unroll
from tests.pipeline.optimise.programs import counts, play, record, same

RNG = np.random.default_rng(0)


def numbers(*shape: int) -> np.ndarray:
    return RNG.normal(size=shape)


# -- fold, share, drop ----------------------------------------------------------------------------------


def test_fold_computes_what_depends_on_constants_alone():
    program = record(lambda xp, x: xp.exp(0.0 * x + 1.0) * x, ())
    folded = optimise(program, ("algebra", "fold", "drop"))
    assert counts(folded) == {"multiply": 1}
    same(program, folded, 2.0, exact=True)


def test_fold_makes_no_large_constant():
    program = record(lambda xp, x: x + xp.broadcast_to(x * 0.0, (100, 100)), ())
    folded = optimise(program, ("algebra", "fold"))
    assert max(a.size for a in folded.constants.values()) == 1
    same(program, folded, 2.0, exact=True)


def test_share_knows_equal_arguments_in_either_order():
    program = record(lambda xp, x, y: (x + y) * (y + x) - (x - y) * (y - x), (), ())
    shared = share(program)
    assert counts(shared)["add"] == 1
    assert counts(shared)["subtract"] == 3  # x - y is not y - x
    same(program, shared, 2.0, 3.0, exact=True)


def test_share_keeps_apart_what_differs_in_an_attribute():
    program = record(lambda xp, x: xp.sum(x, axis=0) + xp.sum(x, axis=1), (3, 3))
    assert counts(share(program))["sum"] == 2


def test_drop_leaves_out_what_nobody_needs():
    def step(xp, x):
        xp.exp(x)
        return x + 1.0

    dropped = drop(record(step, ()))
    assert counts(dropped) == {"add": 1}


# -- algebra --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "step",
    [
        lambda xp, x: x + 0.0,
        lambda xp, x: 1.0 * x,
        lambda xp, x: x / 1.0,
        lambda xp, x: x - np.zeros(3),
        lambda xp, x: xp.negative(xp.negative(x)),
        lambda xp, x: xp.reshape(xp.reshape(x, (3, 1)), (3,)),
        lambda xp, x: xp.where(x > 0.0, x, x),
        lambda xp, x: xp.concat([x, 2.0 * x])[:3],
        lambda xp, x: xp.stack([2.0 * x, x])[1],
        lambda xp, x: x**1.0,
    ],
)
def test_algebra_leaves_nothing_of_what_has_no_effect(step):
    program = record(step, (3,))
    simple = drop(simplify(simplify(program)))
    assert not simple.instructions
    same(program, simple, numbers(3), exact=True)


def test_algebra_keeps_what_broadcasts():
    program = record(lambda xp, x: (x + np.zeros((2, 3))) * np.ones((2, 3)), (3,))
    assert play(simplify(program), numbers(3))[0].shape == (2, 3)


def test_a_structural_zero_has_no_opinion_of_nan():
    program = record(lambda xp, x: 0.0 * x, ())
    assert play(simplify(program), np.nan)[0] == 0.0


@pytest.mark.parametrize(("low", "high"), [(0, 3), (1, 3), (3, 5), (2, 4), (-2, None)])
def test_algebra_looks_a_slice_up_in_its_piece(low, high):
    program = record(lambda xp, x, y: xp.concat([x + 1.0, y + 1.0], axis=-1)[:, low:high], (2, 3), (2, 2))
    same(program, drop(simplify(program)), numbers(2, 3), numbers(2, 2), exact=True)


# -- structural zeros and identities --------------------------------------------------------------------


def transition(xp, dt):
    """F = [[I, dt I], [0, I]] of six states."""
    return np.eye(6) + np.eye(6, k=3) * dt


def work(program):
    return sum(
        program.specs[i.args[0]].shape[-1] * np.prod(i.spec.shape)
        for i in program.instructions
        if i.op == "matmul"
    )


def test_identity_blocks_need_no_products():
    program = record(lambda xp, dt, P: transition(xp, dt) @ P, (), (6, 6))
    split = drop(split_products(program))
    assert work(program) == 216
    assert work(split) == 0
    (scaled,) = [i for i in split.instructions if i.op == "multiply" and i.spec.shape == (3, 6)]
    assert 0 in scaled.args  # dt itself, not an element of dt I
    same(program, split, 0.1, numbers(6, 6))


def test_structure_on_the_right_is_found_too():
    program = record(lambda xp, dt, P: P @ transition(xp, dt).mT, (), (4, 6))
    split = drop(split_products(program))
    assert work(split) == 0
    same(program, split, 0.1, numbers(4, 6))


def test_dense_blocks_stay_products_and_zero_rows_nothing():
    def step(xp, A, P):
        zeros = 0.0 * A
        top = xp.concat([A, zeros, A @ A], axis=-1)
        return xp.concat([top, xp.concat([zeros, zeros, zeros], axis=-1)], axis=-2) @ P

    program = record(step, (3, 3), (9, 5))
    split = drop(split_products(program))
    assert work(split) == 27 + 2 * 3 * 3 * 5
    same(program, split, numbers(3, 3), numbers(9, 5))


def test_a_dense_product_stays_whole():
    program = record(lambda xp, A, P: A @ P, (6, 6), (6, 6))
    assert split_products(program).instructions == program.instructions


@pytest.mark.parametrize("size", [5, 7, 15])
def test_sizes_that_no_block_divides(size):
    program = record(
        lambda xp, dt, P: (np.eye(size) + np.eye(size, k=2) * dt) @ P @ np.eye(size, k=1).T, (), (size, size)
    )
    split = drop(split_products(program))
    assert work(split) < work(program)
    same(program, split, 0.1, numbers(size, size))


# -- symmetric products ---------------------------------------------------------------------------------


def predict(xp, A, P):
    """A covariance carried on, kept symmetric, and written back."""
    Q = A @ P @ A.mT
    return Q, 0.5 * (Q + Q.mT)


def covariance(n: int) -> np.ndarray:
    root = numbers(n, n)
    return root @ root.T


@pytest.mark.parametrize("n", [2, 6, 7, 15])
def test_half_of_a_symmetric_product_is_computed(n):
    program = record(predict, (n, n), (n, n), memory=(1,), symmetric=(1,))
    halved = drop(halve_products(program))
    if n > 3:
        assert work(halved) < 0.9 * work(program)
    values = numbers(n, n), covariance(n)
    same(program, halved, *values)
    full = play(halved, *values)[0]
    np.testing.assert_allclose(full, full.T, rtol=1e-12)


def test_without_bands_a_large_product_stays_whole():
    program = record(predict, (15, 15), (15, 15), memory=(1,), symmetric=(1,))
    assert halve_products(program, banded=False).instructions == program.instructions


def test_marked_and_unrolled_it_needs_a_triangle():
    program = record(predict, (6, 6), (6, 6), memory=(1,), symmetric=(1,))
    passes = ("symmetry", "unroll", "algebra", "fold", "share", "drop")
    halved, whole = optimise(program, passes), optimise(program, without("symmetry", passes=passes))
    assert counts(whole)["multiply"] - counts(halved)["multiply"] >= 6 * 15  # 15 elements of 6 products
    same(program, halved, numbers(6, 6), covariance(6))


@pytest.mark.parametrize("symmetric", [(), (1,)])
def test_without_a_proof_nothing_is_halved(symmetric):
    def unsymmetric(xp, A, P):
        Q = A @ P @ A.mT
        return Q, Q + A  # written back without symmetry, so that the next P has none

    program = record(unsymmetric, (4, 4), (4, 4), memory=(1,), symmetric=symmetric)
    assert halve_products(program).instructions == program.instructions


def test_a_product_of_two_different_matrices_is_not_halved():
    program = record(lambda xp, A, B, P: A @ (P + P.mT) @ B.mT, (4, 4), (4, 4), (4, 4))
    assert halve_products(program).instructions == program.instructions


# -- zeros of larger factors ----------------------------------------------------------------------------


def carried(xp, dt, P):
    """A covariance carried on by F = [[I, dt I], [0, I]], kept symmetric, and written back."""
    F = transition(xp, dt)
    Q = F @ P @ F.mT
    return Q, 0.5 * (Q + Q.mT)


def test_a_factor_is_told_element_by_element():
    program = tell_zeros(record(carried, (), (6, 6), memory=(1,)))
    tables = {n: t.tolist() for n, t in program.elements.items()}
    left, right = [i for i in program.instructions if i.op == "matmul"]
    assert set(tables) == {left.args[0], right.args[1]}
    dt = program.instructions[0].args[1]  # the number of the first argument
    assert dt == 0
    first = [1.0, 0.0, 0.0, dt, 0.0, 0.0]
    assert tables[left.args[0]][0] == first
    assert [row[0] for row in tables[right.args[1]]] == first
    assert [type(e) for e in tables[left.args[0]][0]] == [float] * 3 + [int] + [float] * 2


def test_what_no_scalar_is_named_after_is_left_open():
    program = tell_zeros(record(lambda xp, x, P: (np.eye(6) * x) @ P, (6,), (6, 6)))
    (table,) = program.elements.values()
    assert [table[k, k] for k in range(6)] == [None] * 6
    assert table[0, 1] == 0.0


def test_a_dense_or_small_factor_is_not_told():
    dense = record(lambda xp, x, P: x @ P, (6, 6), (6, 6))
    small = record(lambda xp, dt, P: (np.eye(3) * dt) @ P, (), (3, 3))
    assert not tell_zeros(dense).elements
    assert not tell_zeros(small).elements


def test_a_symmetric_product_is_mirrored_where_the_factor_has_zeros():
    program = record(carried, (), (6, 6), memory=(1,), symmetric=(1,))
    mirrored = drop(mirror_products(program))
    sides = {i.args[0] for i in tell_zeros(mirrored).instructions if i.op == "matmul"}
    assert sides <= set(tell_zeros(mirrored).elements)  # the zeros are at the left of both
    same(program, mirrored, 0.3, covariance(6))
    skew = numbers(6, 6)  # what the proof excludes is where the two differ
    assert not np.allclose(play(program, 0.3, skew)[0], play(mirrored, 0.3, skew)[0])


def test_without_a_proof_nothing_is_mirrored():
    program = record(carried, (), (6, 6), memory=(1,))
    assert mirror_products(program).instructions == program.instructions


def test_a_run_that_begins_without_symmetry_goes_without_what_relies_on_it():
    @block
    def carry(z: real(6), P: real(6, 6), *, xp):  # type: ignore[valid-type]
        return 0.5 * (P + P.mT) + xp.eye(6) * z

    @graph
    def g(z: Stream[real(6)]):  # type: ignore[valid-type]
        before = delay(np.eye(6), name="P")
        after = carry(z, before)
        before.feed(after)
        return after

    pipeline = lower(g.build())
    cells = [c.reset for r in pipeline.registers for c in r.cells]
    assert usable(pipeline, DEFAULT, cells) == DEFAULT
    odd = [np.triu(np.ones((6, 6))) if np.shape(c) == (6, 6) else c for c in cells]
    assert usable(pipeline, DEFAULT, odd) == without(*RELYING)


# -- unrolling ------------------------------------------------------------------------------------------


CASES = {
    "matmul": (lambda xp, x, y: x @ y, (3, 4), (4, 2)),
    "matvec": (lambda xp, x, y: x @ y, (3, 4), (4,)),
    "batched": (lambda xp, x, y: x @ y, (2, 3, 4), (4, 2)),
    "dot": (lambda xp, x, y: x @ y, (4,), (4,)),
    "vecdot": (lambda xp, x, y: xp.linalg.vecdot(x, y), (2, 4), (4,)),
    "outer": (lambda xp, x, y: xp.linalg.outer(x, y), (3,), (2,)),
    "cross": (lambda xp, x, y: xp.linalg.cross(x, y), (2, 3), (3,)),
    "sums": (lambda xp, x, y: xp.sum(x, axis=0) + xp.max(y, axis=-1, keepdims=True), (3, 4), (2, 4)),
    "all": (lambda xp, x, y: xp.where(xp.all(x > 0.0) | xp.any(y > 0.0, axis=0), 1.0, 2.0), (3,), (3, 3)),
    "moves": (
        lambda xp, x, y: xp.permute_dims(xp.concat([x, y], axis=1), (1, 0))[::-1, 1:],
        (3, 2),
        (3, 4),
    ),
    "roll": (lambda xp, x, y: xp.roll(xp.flip(x, axis=0), 1, axis=1) + y, (3, 3), (3,)),
    "triangle": (lambda xp, x, y: xp.triu(x, k=1) + xp.tril(y), (3, 3), (3, 3)),
    "solve": (lambda xp, x, y: xp.linalg.solve(x @ x.mT + np.eye(3), y) * 2.0, (3, 3), (3, 2)),
    "lanes": (lambda xp, x, y: (np.eye(2, 4) @ x) * y[:, None] + xp.sum(x, axis=0), (4, 50), (2,)),
    "reduced lanes": (lambda xp, x, y: xp.sum(x[1:] * y, axis=-1), (4, 50), (50,)),
    "uniform lanes": (lambda xp, x, y: xp.broadcast_to(y[:, None], (4, 50)) * 2.0 + 0.0 * x, (4, 50), (4,)),
    "into lanes": (
        lambda xp, x, y: xp.concat([x, xp.broadcast_to(y[:, None], (2, 50))]) @ x.mT,
        (4, 50),
        (2,),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_unrolled_it_gives_the_same(name):
    step, *shapes = CASES[name]
    program = record(step, *shapes, lanes=(50,))
    unrolled = unroll(program)
    same(program, unrolled, *(numbers(*s) for s in shapes))
    same(program, optimise(program), *(numbers(*s) for s in shapes))


def test_unrolled_arrays_are_scalars_and_lanes_stay_rows():
    flat = unroll(record(CASES["matmul"][0], (3, 4), (4, 2)))
    assert counts(flat)["matmul"] == 0
    assert all(i.spec.shape == () for i in flat.instructions if i.op in ("add", "multiply"))
    rows = unroll(record(CASES["lanes"][0], (4, 50), (2,), lanes=(50,)))
    assert {i.spec.shape for i in rows.instructions if i.op in ("add", "multiply")} == {(50,)}


def test_large_arrays_and_large_work_stay_whole():
    big = record(lambda xp, x: x @ x, (7, 7))
    assert unroll(big).instructions == big.instructions
    product = record(lambda xp, x: x @ x, (6, 6))
    assert counts(unroll(product, largest=100))["matmul"] == 1


def test_rearranging_alone_is_not_taken_apart():
    program = record(lambda xp, x: xp.linalg.cholesky(x.mT), (3, 3))
    assert counts(unroll(program)) == {"matrix_transpose": 1, "cholesky": 1}


# -- loops ----------------------------------------------------------------------------------------------


def test_work_over_the_same_axis_comes_together():
    def step(xp, x, y):
        a = x + 1.0
        b = y * 2.0  # of another shape, between two of one
        c = a * 3.0
        return c, b + 1.0

    program = record(step, (50,), (3,))
    assert len(loops(program)) == 4
    gathered = gather(program)
    groups = loops(gathered)
    assert [g.shape for g in groups] == [(50,), (3,)]
    assert [len(g.local) for g in groups] == [1, 1]
    same(program, gathered, numbers(50), numbers(3), exact=True)


def test_a_value_used_outside_its_loop_is_not_local():
    program = gather(record(lambda xp, x: xp.sum(x + 1.0) * ((x + 1.0) * 2.0), (50,)))
    for group in loops(program):
        inside = {program.instructions[n].out for n in range(group.start, group.stop)}
        others = [i for n, i in enumerate(program.instructions) if not group.start <= n < group.stop]
        outside = {a for i in others for a in i.args}
        assert group.local <= inside - outside


# -- choosing -------------------------------------------------------------------------------------------


def test_passes_are_chosen_by_name():
    program = record(CASES["matmul"][0], (3, 4), (4, 2))
    assert optimise(program, ()) is program
    assert check_passes(["drop", "fold"]) == ("fold", "drop")
    assert without("unroll") == tuple(n for n in PASSES if n != "unroll")
    assert set(DEFAULT) == set(PASSES)


@pytest.mark.parametrize("names", [["fuse"], "fold_all", ["fold", "unrol"]])
def test_an_unknown_pass_is_refused_with_those_there_are(names):
    with pytest.raises(UnknownNameError, match="one of algebra, drop, fold"):
        check_passes(names)
    with pytest.raises(UnknownNameError, match="pass"):
        without(*([names] if isinstance(names, str) else names))
