"""Loops that close through a block whose output does not read this tick's input."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    CycleError,
    DeclarationError,
    Scalar,
    Stream,
    Tick,
    TypeMismatchError,
    block,
    graph,
    latest,
    moore,
    ticks,
)
from tests.support import MS, all_engines


@block
def tank(level, flow, drain, *, dt):  # type: ignore[no-untyped-def]
    """A level that rises by what flows in and falls by what is drained, both held since the last tick."""
    new = level + (flow - drain) * dt
    return new, new


@tank.init
def _(flow, drain):  # type: ignore[no-untyped-def]
    return 1.0


@graph
def filled(clock: Stream[Tick], drain: Stream[Scalar]):
    body = moore(tank, drain, init=0.5, at=drain, name="tank")
    body.feed(4.0 * (2.0 - body.output))
    return {"level": body.output, "clock": clock}


def test_a_loop_closes_through_a_moore_block_in_every_engine() -> None:
    time = np.array([0, 100, 250, 300, 500]) * MS
    drain = np.array([0.0, 0.1, 0.2, 0.0, 0.3])
    given = {"clock": ticks("250ms", until="600ms"), "drain": (time, drain)}
    found = all_engines(filled.build(), given)["level"].value
    level, flow, want = 1.0, 0.5, []
    for k in range(len(time)):
        dt = 0.0 if k == 0 else (time[k] - time[k - 1]) * 1e-9
        level += (flow - drain[k]) * dt
        want.append(level)
        flow = 4.0 * (2.0 - level)
    np.testing.assert_allclose(found, want, rtol=1e-12)


def test_what_it_is_fed_is_in_the_state_and_may_start_elsewhere() -> None:
    given = {"clock": ticks("1s", until="1s"), "drain": (np.array([0, 100]) * MS, np.zeros(2))}
    result = all_engines(filled.build(), given, init={"tank_input": -1.0})
    assert result["level"].value[0] == 1.0
    assert result.state["registers"]["tank_input"] == pytest.approx(4.0 * (2.0 - result["level"].value[1]))


def test_without_it_the_loop_is_refused_with_the_chain() -> None:

    @graph
    def loop(drain: Stream[Scalar]):
        flow = latest(init=0.5, name="flow")
        level = tank(flow, drain, name="tank")
        flow.feed(4.0 * (2.0 - level))
        return level

    with pytest.raises(CycleError, match="passes through no delay") as caught:
        loop.build()
    assert "moore(" in (caught.value.fix or "")


def test_a_moore_block_that_is_never_fed_or_fed_another_type_is_refused() -> None:
    @graph
    def unfed(drain: Stream[Scalar]):
        return moore(tank, drain, init=0.5, at=drain, name="tank").output

    with pytest.raises(DeclarationError, match="never fed") as caught:
        unfed.build()
    assert "tank_input" in str(caught.value)

    @graph
    def crossed(clock: Stream[Tick], drain: Stream[Scalar]):
        body = moore(tank, drain, init=0.5, at=drain, name="tank")
        body.feed(clock)
        return body.output

    with pytest.raises(TypeMismatchError):
        crossed.build()
