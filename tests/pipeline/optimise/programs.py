"""Small programs for the tests of passes: recorded from a function, and played in NumPy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.pipeline.evaluate import evaluate
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import OPS, Spec
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.trace import Trace


def record(
    function: Callable[..., Any],
    *shapes: tuple[int, ...],
    memory: tuple[int, ...] = (),
    symmetric: tuple[int, ...] = (),
    lanes: tuple[int, ...] = (),
) -> Program:
    """The program of `function(xp, *arrays)`.

    Args:
        shapes: of the arguments, all real.
        memory: places among the arguments that are registers; the last results are written back to them.
        symmetric: of those, the ones that begin symmetric.
        lanes: sizes of axes that are not taken apart.
    """
    trace = Trace()
    given = [trace.input(Spec(s, "real")) for s in shapes]
    found = function(namespace, *given)
    found = found if isinstance(found, tuple) else (found,)
    outs = [trace.constant(x).number if isinstance(x, np.ndarray) else x.number for x in found]
    specs = {g.number: g.spec for g in given} | {i.out: i.spec for i in trace.instructions}
    specs |= {n: Spec(a.shape, "bool" if a.dtype == bool else "real") for n, a in trace.constants.items()}
    shown = outs[: len(outs) - len(memory)]
    return Program(
        dict(trace.constants),
        tuple(trace.instructions),
        ((None, tuple(shown)),),
        tuple(outs[len(shown) :]),
        specs,
        tuple(given[k].number for k in memory),
        frozenset(given[k].number for k in symmetric),
        frozenset(lanes),
    )


def play(program: Program, *values: Any) -> list[np.ndarray]:
    """What outputs and registers get, from the values of the first numbers."""
    env: dict[int, Any] = dict(enumerate(map(np.asarray, values))) | dict(program.constants)
    with np.errstate(all="ignore"):
        for i in program.instructions:
            assert i.spec == OPS[i.op].rule(*(program.specs[a] for a in i.args), **i.attrs)
            env[i.out] = evaluate(i, *(env[a] for a in i.args))
            assert np.shape(env[i.out]) == i.spec.shape
    return [env[n] for n in (*program.outputs[0][1], *program.writes)]


def counts(program: Program) -> Counter[str]:
    """How many instructions there are of each kind."""
    return Counter(i.op for i in program.instructions)


def same(a: Program, b: Program, *values: Any, exact: bool = False) -> None:
    """Both programs give the same."""
    for x, y in zip(play(a, *values), play(b, *values), strict=True):
        np.testing.assert_allclose(x, y, rtol=0.0 if exact else 1e-12, atol=0.0 if exact else 1e-12)
