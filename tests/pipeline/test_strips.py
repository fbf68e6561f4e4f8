"""Strips: a program played block by block of lanes gives what it gives whole, and little is left between."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowgraph import lower
from flowgraph.pipeline.evaluate import evaluate
from flowgraph.pipeline.optimise import ARRAYS, optimise
from flowgraph.pipeline.pipeline import work
from flowgraph.pipeline.program import Program, specialise
from flowgraph.pipeline.strips import Strip, slices, strips
from flowgraph.recorder.specs import Spec
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.trace import Trace
from flowgraph.types import dtype_name
from tests.graphs.library import library_case
from tests.recorder.test_symbolic import CASES, PAIRS

N = 12
CUTS = st.sets(st.integers(1, N - 1))


def program_of(function, arrays):
    """A program that makes of its registers what the function makes of these arrays."""
    trace = Trace()
    given = [trace.input(Spec(np.shape(a), dtype_name(a))) for a in arrays]
    made = function(namespace, *given)
    made = made if isinstance(made, tuple) else (made,)
    specs = {x.number: x.spec for x in given} | {i.out: i.spec for i in trace.instructions}
    specs |= {n: Spec(a.shape, dtype_name(a)) for n, a in trace.constants.items()}
    writes, reads = tuple(x.number for x in made), tuple(x.number for x in given)
    return Program(trace.constants, tuple(trace.instructions), (), writes, specs, reads)


def whole(program, arrays):
    values = {**program.constants, **dict(zip(program.reads, arrays, strict=True))}
    for i in program.instructions:
        values[i.out] = evaluate(i, *(values[a] for a in i.args))
    return [values[n] for n in program.writes]


def in_blocks(program, arrays, size, cuts):
    """The registers after the program, with each strip played from cut to cut, by what it says it needs."""
    found = strips(program, size)
    values = {**program.constants, **dict(zip(program.reads, arrays, strict=True))}
    bounds = [0, *sorted(cuts), size]
    for part in found.parts:
        if not isinstance(part, Strip):
            values[part.out] = evaluate(part, *(values[a] for a in part.args))
            continue
        slots = {n: [] for n in part.kept}
        for low, high in pairwise(bounds):
            own = {n: values[n] for n in part.whole}
            of_block = {n: cut(values[n], found.axes[n], low, high) for n in part.sliced}
            for i in part.instructions:
                j = found.narrowed(i, high - low)
                sliced = slices(i, program.specs, size)
                args = [of_block[a] if s else own[a] for a, s in zip(i.args, sliced, strict=True)]
                of_block[i.out] = evaluate(j, *args)
                assert of_block[i.out].shape == j.spec.shape, (i.op, i.attrs)
            for n, blocks in slots.items():
                blocks.append(of_block[n])
        values.update((n, np.concatenate(blocks, found.axes[n])) for n, blocks in slots.items())
    return [values[n] for n in program.writes]


def cut(array, axis, low, high):
    return array[(slice(None),) * axis + (slice(low, high),)]


def same(function, arrays, size, cuts):
    program = program_of(function, arrays)
    expected = whole(program, arrays)
    for a, b in zip(in_blocks(program, arrays, size, cuts), expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    return strips(program, size)


@pytest.mark.parametrize(("name", "k"), PAIRS)
def test_whatever_the_sizes_an_operation_in_strips_gives_what_it_gives_whole(name, k):
    function, arrays = CASES[name][k]
    for size in {n for a in arrays for n in np.shape(a) if n > 1}:
        same(function, arrays, size, {1, size - 1})


RNG = np.random.default_rng(1)
V, W = RNG.normal(size=N), RNG.normal(size=(3, N))
A, S = RNG.normal(size=(3, 3, N)), RNG.normal(size=(N, 3, 3)) + 4 * np.eye(3)
R, M = RNG.normal(size=(N, 3)), RNG.normal(size=(4, 3))
AT = RNG.integers(0, N, N).astype(np.int32)

LANEWISE = {
    "elementwise": (lambda xp, v, w: xp.where(v > 0.0, xp.exp(v) * w, w[:, :1] + w), (V, W)),
    "sums": (lambda xp, w, a: xp.sum(w, axis=0) + xp.max(a, axis=(0, 1)) + xp.mean(w, axis=-2), (W, A)),
    "kept axes": (lambda xp, w: w / xp.sum(w, axis=0, keepdims=True), (W,)),
    "which": (lambda xp, w: xp.argmax(w, axis=0), (W,)),
    "joined": (lambda xp, v, w: xp.concat([w, xp.reshape(v, (1, N))], axis=0), (V, W)),
    "stacked": (lambda xp, v: (xp.stack([v, -v], axis=0), xp.stack([v, -v], axis=1)), (V,)),
    "parts": (lambda xp, w, a: w[1:] * a[::-1, 1, :][:2], (W, A)),
    "turned": (lambda xp, a, s: xp.permute_dims(a, (2, 1, 0)) + s.mT, (A, S)),
    "reshaped": (lambda xp, a, r: (xp.reshape(a, (9, N)), xp.reshape(r, (N, 1, 3))), (A, R)),
    "spread": (lambda xp, w: xp.broadcast_to(xp.reshape(w, (3, 1, N)), (3, 2, N)), (W,)),
    "columns": (lambda xp, m, w: m @ w, (M, W)),
    "rows": (lambda xp, m, r, w: (r @ m.mT, r @ m[0], m[0] @ w), (M, R, W)),
    "matrices": (lambda xp, s, m: (s @ s, m @ s, s @ m[0], m[0] @ s), (S, M)),
    "factors": (lambda xp, s: xp.linalg.cholesky(s @ s.mT), (S,)),
    "solved": (lambda xp, s, r: xp.linalg.solve(s, xp.reshape(r, (N, 3, 1))), (S, R)),
    "solved for columns": (lambda xp, s, w: xp.linalg.solve(s[0], w), (S[:1], W)),
    "vectors": (lambda xp, r, m: (xp.linalg.cross(r, m[:1]), xp.linalg.vecdot(r, r)), (R, M)),
    "outer": (lambda xp, v, m: (xp.linalg.outer(v, m[0]), xp.linalg.outer(m[0], v)), (V, M)),
    "sorted": (lambda xp, w: (xp.sort(w, axis=0), xp.cumulative_sum(w, axis=0)), (W,)),
    "gathered": (lambda xp, w, at: (xp.take(w, at, axis=1), xp.take(w[:, :2], at % 3, axis=0)), (W, AT)),
    "gathered alike": (lambda xp, w: xp.take(w, np.array([2, 0]), axis=0), (W,)),
    "found": (lambda xp, v, m: xp.searchsorted(m[0], v), (V, np.sort(M))),
}


@pytest.mark.parametrize("name", LANEWISE)
@given(cuts=CUTS)
def test_what_is_done_for_each_lane_is_one_strip(name, cuts):
    found = same(*LANEWISE[name], N, cuts)
    assert sum(isinstance(part, Strip) for part in found.parts) == 1
    assert not any(N in part.spec.shape for part in found.parts if not isinstance(part, Strip))


ACROSS = {
    "all": (lambda xp, w: xp.sum(w), (W,)),
    "along": (lambda xp, w: xp.cumulative_sum(w, axis=1), (W,)),
    "sorted": (lambda xp, v: xp.sort(v), (V,)),
    "backwards": (lambda xp, v: v[::-1], (V,)),
    "shifted": (lambda xp, v: xp.roll(v, 1), (V,)),
    "product": (lambda xp, w, r: w @ r, (W, R)),
    "triangle": (lambda xp, w: xp.tril(w), (W,)),
    "joined": (lambda xp, w: xp.concat([w, w], axis=1)[:, :N], (W,)),
    "mixed": (lambda xp, w: xp.reshape(w, (N, 3)), (W,)),
    "square": (lambda xp, v: xp.linalg.outer(v, v) + v, (V,)),
    "solved": (lambda xp, m, v: xp.linalg.solve(m, v), (RNG.normal(size=(N, N)), V)),
}


@pytest.mark.parametrize("name", ACROSS)
@given(cuts=CUTS)
def test_what_needs_all_lanes_is_in_no_strip(name, cuts):
    found = same(*ACROSS[name], N, cuts)
    assert not any(isinstance(part, Strip) for part in found.parts)


STEPS = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=12)
KINDS = [
    lambda xp, a, b: a + b,
    lambda xp, a, b: xp.sin(a) * b,
    lambda xp, a, b: xp.where(a > b, a, -b),
    lambda xp, a, b: a - xp.sum(b, axis=0),
    lambda xp, a, b: a - xp.sum(b, axis=1, keepdims=True) / N,
    lambda xp, a, b: xp.sin(xp.cumulative_sum(a, axis=1)),
    lambda xp, a, b: (a @ b.mT) @ xp.sin(b),
    lambda xp, a, b: xp.concat([a[1:], b[:1]], axis=0),
    lambda xp, a, b: xp.take(a, xp.astype(xp.floor(N * xp.sin(b[0])), xp.int32) % N, axis=1),
    lambda xp, a, b: a[:, ::-1],
]


@given(STEPS, CUTS, st.integers(0, 1000))
def test_random_programs_in_strips_give_what_they_give_whole(steps, cuts, seed):
    def step(xp, *arrays):
        values = list(arrays)
        for kind, i, j in steps:
            values.append(xp.sin(KINDS[kind](xp, values[i % len(values)], values[j % len(values)])))
        return tuple(values[-2:])

    random = np.random.default_rng(seed)
    found = same(step, (random.normal(size=(3, N)), random.normal(size=(3, N))), N, cuts)
    across = sum(kind in (4, 5, 6, 8, 9) for kind, _, _ in steps)
    assert sum(isinstance(part, Strip) for part in found.parts) <= across + 1


def test_what_only_a_later_strip_uses_is_made_there():
    def step(xp, w):
        double = w + w  # of a register: needs not wait in memory for the second strip
        return double - xp.sum(w * w)

    (before, after) = [part for part in strips(program_of(step, (W,)), N).parts if isinstance(part, Strip)]
    assert [i.op for i in before.instructions] == ["multiply"]
    assert [i.op for i in after.instructions] == ["add", "subtract"]
    assert after.local == {after.instructions[0].out}


@pytest.mark.parametrize(
    ("name", "share"),
    [("rbpf_indoor", 0.9), ("rbpf_outdoor", 0.9), ("particle", 0.6), ("ins_particle", 0.9)],
)
def test_most_of_the_work_over_particles_lies_in_strips(name, share):
    pipeline = lower(library_case(name).graph)
    inside = over = 0
    for key in range(1, 2 ** len(pipeline.inputs)):
        program = optimise(specialise(pipeline, key), ARRAYS)
        (size,) = program.lanes
        for part in strips(program, size).parts:
            for i in part.instructions if isinstance(part, Strip) else (part,):
                if size in i.spec.shape:  # the others are sums and products over all particles
                    over += work(i, program.specs)
                    inside += work(i, program.specs) if isinstance(part, Strip) else 0
    assert inside / over > share, inside / over
