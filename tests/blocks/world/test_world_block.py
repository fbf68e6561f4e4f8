"""Worlds as blocks: at each tick what they say for all times at once."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Stream, Tick, graph, simulate, ticks
from flowgraph.blocks.world import Hover, RoundTrip, World, thesis_flight, world_motion
from tests.support import both_quick

WORLDS = {
    "hover": Hover(2.0, drift=0.3).shaped(np.linspace(0.6, 3.1, 18)),
    "round trip": RoundTrip(2.0, trip=0.4, rest=0.1),
    "thesis": thesis_flight(3),
}


@graph
def moving(clock: Stream[Tick], *, world: World):
    return world_motion(at=clock, world=world)


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_at_a_tick_is_that_of_all_times(name: str) -> None:
    world = WORLDS[name]
    clock = ticks("90ms", until="1.9s")
    built = moving.build(world=world)
    result = both_quick(built, {"clock": clock}).output
    want = world.at(clock.time * 1e-9)
    for other in (result, simulate(built, {"clock": clock}, engine="c").output):
        for leaf, values in other.leaves.items():
            np.testing.assert_allclose(values, getattr(want, leaf), rtol=1e-9, atol=1e-9, err_msg=leaf)
    assert np.abs(want.rate).max() > 0.01


def test_a_world_stands_at_its_end() -> None:
    found = simulate(
        moving.build(world=Hover(1.0, drift=0.2).shaped(np.linspace(0.6, 3.1, 18))),
        {"clock": ticks("1s", until="4s")},
    ).output
    assert (found["position"][2:] == found["position"][1]).all()
    assert (found["position"][0] != found["position"][1]).any()
