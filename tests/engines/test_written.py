"""Steps written out, at random: to the bit what calling them gives, and what their recorded lists give.

A step is one straight expression over vectors and matrices of three, numbers, draws and constants. It has an
optional input, and which constants and which axes it takes hangs on whether that is there: so it is written
out twice, alike in many places and not in others.
"""

from __future__ import annotations

import random
import re
from typing import Any

import numpy as np
import pytest

from flowgraph import Scalar, Stream, aperiodic, block, graph, latest, simulate
from flowgraph.engines.python import run as runs
from flowgraph.engines.python.loop import Loop
from tests.support import same, scalars

TICKS = np.arange(0, 120, 2)
INPUTS = {
    "x": scalars(TICKS.tolist(), (np.sin(TICKS) * 3.0).tolist()),
    "z": scalars([*range(0, 60, 3), *range(60, 120, 2)], np.cos(np.arange(50.0)).tolist()),
}
CONSTANTS = {
    "A": np.array([0.5, -1.25, 3.0]),
    "B": np.array([[2.0, 0.1, 0.3], [0.2, 1.7, -0.4], [-0.3, 0.6, 2.2]]),
    "C": np.array([1e-3, 0.7, 11.0]),
    "D": np.array([[1.1, -0.2, 0.9], [0.0, 3.1, 0.8], [0.4, -0.7, 1.9]]),
}
KINDS: dict[str, tuple[str, ...]] = {
    "number": (
        "x", "z0", "{c}", "({number} + {number})", "({number} * {number})", "({number} - {c})",
        "xp.where({number} > {number}, {number}, {number})", "xp.sin({number})", "{vector}[{i}]",
        "xp.sum({vector})", "xp.max({vector})", "({vector} @ {vector})", "xp.abs({number})",
        "xp.linalg.vecdot({vector}, {vector})", 'draw.uniform("u", ())',
        "xp.minimum({number}, {c})",
    ),
    "vector": (
        "({v} * x)", "({vector} + {number})", "({vector} * {vector})", "({matrix} @ {vector})",
        "xp.sum({matrix}, axis={i})", "{matrix}[{i}]", "{matrix}[:, {i}]", 'draw.normal("n", (3,))',
        "xp.where({number} > {number}, {vector}, {vector})", "xp.cumulative_sum({vector}, axis=0)",
        "xp.linalg.solve(xp.asarray({m}), {vector})", "xp.stack([{number}, {number}, x])",
        "xp.where({number} > {c}, {vector}, {c})", "xp.concat([{vector}[:2], {vector}[2:]])",
        "xp.take({vector}, xp.argsort({vector}))",
    ),
    "matrix": (
        "({m} * x)", "({matrix} @ {matrix})", "{matrix}.mT", "({vector}[:, None] * {vector})",
        "xp.flip({matrix}, axis={i})", "xp.cumulative_sum({matrix}, axis={i})", "({matrix} * {number})",
        'draw.normal("m", (3, 3))', "xp.stack([{vector}, {vector}, xp.asarray({v})], axis={i})",
        "(xp.asarray({m}) @ {matrix})", "xp.where({number} > {number}, {matrix}, {matrix})",
        "({matrix} - {vector})",
    ),
}  # fmt: skip
"""What an expression may be, by its kind; `c` is a number, `v` and `m` are constants, `i` is an axis."""

_PLAIN = {"number": 3, "vector": 1, "matrix": 1}  # the first of them have nothing below them


def expression(r: random.Random, kind: str, depth: int) -> str:
    """A random expression of a kind."""
    forms = KINDS[kind][: _PLAIN[kind]] if depth == 0 else KINDS[kind]
    text = r.choice(forms)
    atoms: dict[str, Any] = {
        "c": [round(r.uniform(-2.0, 2.0), 2) for _ in range(4)], "v": "AC", "m": "BD", "i": (0, 1)
    }  # fmt: skip
    while (hole := re.search(r"\{(\w+)\}", text)) is not None:
        name = hole[1]
        found = either(r, atoms[name]) if name in atoms else expression(r, name, depth - 1)
        text = text[: hole.start()] + found + text[hole.end() :]
    return text


def either(r: random.Random, choices: Any) -> str:
    """One of two, for both variants or for each its own."""
    a, b = r.choice(choices), r.choice(choices)
    return f"({a}, {b})[z is None]" if r.random() < 0.6 else str(a)


def drawn_graph(seed: int) -> Any:
    """A graph of two random steps, with how they are written."""
    r = random.Random(seed)
    names: dict[str, Any] = dict(CONSTANTS)
    blocks = []
    for k in range(2):
        body = f"xp.sum({expression(r, 'matrix', 4)}) + xp.sum({expression(r, 'vector', 3)})"
        text = f"def step{k}(x, z, *, z0, draw, xp):\n    return {body}\n"
        exec(text, names)
        step = names[f"step{k}"]
        step.__annotations__ = {"x": Scalar, "z": Scalar | None, "return": Scalar}
        blocks.append(block(step))

    @graph
    def g(x: Stream[Scalar], z: Stream[Scalar]):
        held = latest(x, init=0.25, at=x | z)
        one = blocks[0](held, z, z0=0.5, name="one")
        return {"one": one, "two": blocks[1](one, z, z0=-1.5, name="two")}

    return g.build(x=aperiodic(), z=aperiodic())


def check(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same in the loop, tick by tick and in the reference engine."""
    made = drawn_graph(seed)
    ours = simulate(made, INPUTS, seed=seed, diverged="count")
    (loop,) = [known for known in made.plans.values() if isinstance(known, Loop)]
    assert re.search(r"= f\d", loop.plan.source) is None  # both are written out
    with monkeypatch.context() as patch:
        patch.setattr(runs, "loop", lambda *_: None)
        called = simulate(made, INPUTS, seed=seed, diverged="count")
    same(ours, called)
    same(ours, simulate(made, INPUTS, seed=seed, diverged="count", engine="reference"))


@pytest.mark.parametrize("first", range(0, 40, 10))
def test_random_steps_are_what_they_are_when_called(monkeypatch, first):
    for seed in range(first, first + 10):
        check(seed, monkeypatch)


@block
def laid_out(x: Scalar, *, draw: Any, xp: Any) -> Scalar:
    """A sum goes through a transposed matrix in another order than through a copy of it."""
    m = xp.sin(draw.normal("m", (7, 9)))
    part = xp.sin(draw.normal("part", (9, 12)))[:, :7]
    taken = xp.where(x > 0.0, m.mT, part)
    return xp.sum(taken) + xp.sum(xp.where(x > 0.5, taken, 1.0)) + xp.sum(xp.where(x > 0.0, 0.1, m.mT))


@graph
def lying(x: Stream[Scalar]):
    return {"sum": laid_out(x)}


def test_what_a_selection_takes_lies_as_it_did(monkeypatch):
    made, inputs = lying.build(), {"x": INPUTS["x"]}
    ours = simulate(made, inputs)
    (loop,) = [known for known in made.plans.values() if isinstance(known, Loop)]
    assert " if " in loop.plan.source.split("key == 1:")[1]
    same(ours, simulate(made, inputs, engine="reference"))
    with monkeypatch.context() as patch:
        patch.setattr(runs, "loop", lambda *_: None)
        same(ours, simulate(made, inputs))
