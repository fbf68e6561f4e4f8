"""Ticks of several patterns without a switch: a loop for each pattern, as long as ticks of its own follow.

A switch copies all registers at every tick: what a branch makes is not the memory that a scan carries. What a
loop carries stays where it is, so for a large cloud the loops gain more than the turns among them cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any


def in_turns(
    jax: Any, steps: Sequence[Callable[..., Any]], cells: Any, key: Any, time: Any, inputs: Any
) -> tuple[Any, Any]:
    """Registers after all ticks, and the outputs of each.

    Args:
        jax: the module.
        steps: for each pattern `(registers, time, inputs, true) -> (registers, outputs)` of a tick, where
            `true` is so, but XLA cannot know.
        cells: registers before the first tick.
        key: the place of each tick's pattern in `steps` (T,). The first tick of another number is the end:
            outputs from there on are zeros.
        time: of each tick (T,); None where no step asks for it.
        inputs: arrays with a first axis of ticks.
    """
    lax, jnp, tree = jax.lax, jax.numpy, jax.tree
    ticks = len(key)

    def of(at: Any, all_: Any) -> Any:
        return tree.map(lambda x: lax.dynamic_index_in_dim(x, at, 0, keepdims=False), all_)

    def follows(some: Callable[[Any], Any], now: Any) -> Any:
        return (now[0] < ticks) & some(of(now[0], key))

    def tick(step: Callable[..., Any], now: Any) -> Any:
        at, cells, made = now
        cells, outputs = step(cells, of(at, time), of(at, inputs), at >= 0)
        put = lambda whole, new: lax.dynamic_update_index_in_dim(whole, new, at, 0)
        return at + 1, cells, tree.map(put, made, outputs)

    def turn(now: Any) -> Any:
        for number, step in enumerate(steps):
            now = lax.while_loop(partial(follows, partial(jnp.equal, number)), partial(tick, step), now)
        return now

    def outputs() -> Any:
        return steps[0](cells, of(0, time), of(0, inputs), True)[1]

    made = tree.map(lambda x: jnp.zeros((ticks, *x.shape), x.dtype), jax.eval_shape(outputs))
    known = lambda number: (number >= 0) & (number < len(steps))
    _, cells, made = lax.while_loop(partial(follows, known), turn, (jnp.int32(0), cells, made))
    return cells, made
