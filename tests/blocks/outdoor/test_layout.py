"""What an outdoor state is made of: each part in its place, with biases and without."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.blocks.outdoor import BIASED, OUTDOOR
from flowgraph.blocks.outdoor.layout import BELIEF, PARTICLE, Layout, belief_layout, particle_layout


@pytest.mark.parametrize(("layout", "space"), [(BELIEF, OUTDOOR), (BELIEF.with_biases(), BIASED)])
def test_the_parts_of_a_belief_are_those_of_its_space(layout: Layout, space):
    assert [(at, on) for _, at, on in space.places()] == list(
        zip(layout.means.values(), layout.errors.values(), strict=True)
    )
    assert (layout.size, layout.directions) == (space.size, space.tangent)
    assert belief_layout(np.zeros((2, space.size))).errors == layout.errors


@pytest.mark.parametrize("biased", [False, True])
def test_a_turn_is_taken_out_of_a_particles_state_and_put_back(biased):
    n = 18 if biased else 12
    layout, state = particle_layout(np.zeros((n, 4))), np.arange(4.0 * n).reshape(n, 4)
    means = layout.but("turn", state, np)
    assert (layout.biased, len(means)) == (biased, layout.size)
    np.testing.assert_array_equal(np.delete(state, [9, 10, 11], axis=0), means)
    np.testing.assert_array_equal(layout.put("turn", means, state[9:12], np), state)


def test_a_number_a_part_and_parts_that_become_others():
    assert PARTICLE.diagonal(position=2.0, gyro_bias=5.0).tolist() == [0.0] * 3 + [2.0] * 3 + [0.0] * 6
    assert PARTICLE.with_biases().diagonal(gyro_bias=5.0).tolist() == [0.0] * 12 + [5.0] * 3 + [0.0] * 3
    T = PARTICLE.with_biases().copied({"moved": "velocity"})
    x = np.arange(18.0)
    assert (T @ x).tolist() == [*x[:6], *x[:3], *x[9:]]
