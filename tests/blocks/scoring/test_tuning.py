"""An inertial unit made of its parts: it says what they say of how they read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowgraph import Flight, load_flight, simulate
from flowgraph.blocks.scoring.streams import told_acceleration
from flowgraph.blocks.scoring.tuning import reading_of, with_imu
from flowgraph.graphs import ekf, ukf


def flight(**settings: str) -> Flight:
    named = {name.replace("__", "."): value for name, value in settings.items()}
    given = {"sensors": "gyro,coordinate_acceleration,vicon", "duration": "4", **named}
    return load_flight("sim:thesis", seed=1, settings=given)


@pytest.mark.parametrize(
    ("gyro", "push", "turn", "reading"),
    [
        ("1", "1", "0", "instant"),
        ("10", "10", "0", "mean"),
        ("10", "1", "0", "mean"),
        ("1", "1", "1", "mean"),
        ("1", "10", "1", "mean"),
    ],
)
def test_a_unit_made_of_parts_reads_as_they_do(gyro, push, turn, reading):
    looks = {"gyro__oversample": gyro, "coordinate_acceleration__oversample": push}
    made = with_imu(flight(gyro__turn=turn, **looks))
    assert reading_of(made) == reading
    assert made.info["imu_period_ns"] == 5_000_000
    gyro_part, push_part = made.streams["gyro"]["rate"], made.streams["coordinate_acceleration"]
    np.testing.assert_array_equal(made.streams["imu"]["gyro"], gyro_part)
    force = push_part["acceleration"]
    if reading == "mean" and push == "1":  # of an instant: the mean of the two at the ends of the step
        force = np.concatenate([force[:1], 0.5 * (force[1:] + force[:-1])])
    np.testing.assert_array_equal(made.streams["imu"]["specific_force"], force)
    assert len(told_acceleration(made)) == len(made.streams["imu"])


def test_the_faster_of_two_oversampling_parts_is_averaged_over_the_step():
    made = with_imu(
        flight(
            gyro__oversample="10",
            coordinate_acceleration__oversample="10",
            coordinate_acceleration__rate="100",
        )
    )
    rate = made.streams["gyro"]["rate"]
    expected = 0.5 * (rate[1:-1:2] + rate[2::2])
    np.testing.assert_allclose(made.streams["imu"]["gyro"][1:], expected, rtol=0.0, atol=1e-12)
    assert made.info["imu_period_ns"] == 10_000_000


@pytest.mark.parametrize("graph", [ekf, ukf], ids=lambda g: g.name)
def test_a_filter_that_knows_that_readings_are_means_is_better(graph):
    quiet = dict.fromkeys(("gyro__noise", "coordinate_acceleration__noise"), "1e-4")
    quiet |= {"vicon__noise": "1e-3", "vicon__attitude_noise": "1e-3", "gyro__oversample": "10"}
    quiet["gyro__turn"] = "0"
    made = with_imu(flight(coordinate_acceleration__oversample="10", **quiet))
    error = {}
    for looks in (10, 1):
        case = graph.case(replace(made, info={**made.info, "imu_oversample": looks}))
        error[looks] = case.score(simulate(case.graph, case.inputs))["attitude_rmse_deg"]
    assert error[10] < 0.8 * error[1]
