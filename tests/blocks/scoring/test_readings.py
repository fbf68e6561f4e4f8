"""What a flight's readings are taken for: usual steps, gaps, pauses."""

import numpy as np
import pytest

from flowgraph.blocks.scoring.readings import usual_step


def test_the_usual_step_of_bursts_is_the_wait_between_them():
    """Seven readings within a millisecond, then nothing for 33 ms; a single long gap is no burst."""
    burst = np.tile([1e-4] * 6 + [0.033], 50)
    assert usual_step(burst) == pytest.approx(0.033)
    assert usual_step(np.append(np.full(500, 0.005), 9.0)) == pytest.approx(0.005)
    assert usual_step(np.full(20, 0.01)) == pytest.approx(0.01)
    assert usual_step(np.zeros(0)) == 0.0
