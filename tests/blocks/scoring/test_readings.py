"""What a flight's readings are taken for: usual steps, gaps, pauses."""

import numpy as np
import pytest

from flowgraph import Series
from flowgraph.blocks.scoring.readings import gap_notes, usual_step
from flowgraph.blocks.signals import Imu, Position
from tests.support import MS


def test_the_usual_step_of_bursts_is_the_wait_between_them():
    """Seven readings within a millisecond, then nothing for 33 ms; a single long gap is no burst."""
    burst = np.tile([1e-4] * 6 + [0.033], 50)
    assert usual_step(burst) == pytest.approx(0.033)
    assert usual_step(np.append(np.full(500, 0.005), 9.0)) == pytest.approx(0.005)
    assert usual_step(np.full(20, 0.01)) == pytest.approx(0.01)
    assert usual_step(np.zeros(0)) == 0.0


def _imu(time: np.ndarray) -> Series:
    n = len(time)
    return Series(time, Imu(gyro=np.zeros((n, 3)), specific_force=np.ones((n, 3))), name="imu")


def _fixes(time: np.ndarray) -> Series:
    return Series(time, Position(position=np.zeros((len(time), 3))), name="vicon")


def _notes(**inputs: Series) -> list[str]:
    return list(gap_notes(inputs, ["imu"]))


EACH = np.arange(1200) * 5 * MS
FIXES = np.arange(60) * 100 * MS


def test_what_a_whole_flight_has_is_not_noted():
    assert not _notes(imu=_imu(EACH), vicon=_fixes(FIXES))
    assert not _notes(imu=_imu(EACH), vicon=_fixes(FIXES[:-8]))  # within ten of its steps
    assert not _notes(imu=_imu(EACH[:1]), vicon=_fixes(FIXES[:0]))


@pytest.mark.parametrize(
    ("imu", "vicon", "name"), [(400, 60, "imu"), (1200, 20, "vicon"), (1200, 1, "vicon")]
)
def test_a_stream_that_ends_before_the_others_is_noted(imu, vicon, name):
    (said,) = _notes(imu=_imu(EACH[:imu]), vicon=_fixes(FIXES[:vicon]))
    assert said.startswith(f"bridged: {name}: nothing of it in the last ")


def test_after_a_pause_of_all_no_stream_ends_early():
    assert not any(
        "nothing of it" in n for n in _notes(imu=_imu(EACH), vicon=_fixes(np.append(FIXES, 10**12)))
    )


@pytest.mark.parametrize("unit", [1_000, 1_000_000])
def test_stamps_that_count_something_else_are_noted(unit):
    (said,) = _notes(imu=_imu(EACH // unit), vicon=_fixes(FIXES // unit))
    assert said.startswith("warning: imu: a reading each 5e-0")
    assert "a stamp counts nanoseconds" in said


@pytest.mark.parametrize("size", [3, 10, 40])
def test_readings_stamped_as_they_arrive_in_bursts_are_noted(size):
    count = np.arange(len(EACH))
    arrived = count // size * size * 5 * MS + count % size * 1000
    (said,) = _notes(imu=_imu(arrived), vicon=_fixes(FIXES))
    assert said.startswith(f"warning: imu: readings come in bursts, {size * 0.005:.3g} s apart")
    stamped = Series(EACH + 300 * MS, _imu(EACH).values, name="imu", stamp=EACH)
    assert not _notes(imu=stamped, vicon=_fixes(FIXES))
