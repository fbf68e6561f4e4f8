"""The experiments on a day of flight and on faults: short ones, and what they refuse."""

from __future__ import annotations

import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.graphs.benches.endurance import endurance, memory
from flowgraph.graphs.benches.fault_kinds import faults_of
from flowgraph.graphs.benches.faults import faults


@pytest.mark.slow
def test_some_minutes_of_flight_keep_time_memory_and_covariance():
    held = memory()  # other tests of this process have left it with much
    report = endurance(hours=0.1)
    (row,) = report.rows
    assert row["ticks"] == 6 * 60 * 200
    assert row["time_error_ns"] == 0
    assert row["least_eigenvalue"] > 0.0
    assert row["asymmetry"] == 0.0
    assert 1.5 < row["nees_mean"] < 6.0
    assert row["memory_bytes"] - held < 2**28


def test_less_than_a_minute_is_refused():
    with pytest.raises(DeclarationError, match="flies a minute or more"):
        endurance(hours=0.001)


def test_verdicts_of_a_filter_that_weighs_nothing():
    report = faults(
        graphs="gyro_integration", kinds="duplicates imu,stuck imu,dropout vicon 1 s,start heading"
    )
    found = {row["fault"]: row for row in report.rows}
    assert found["duplicates imu"]["verdict"] == "said"
    assert found["stuck imu 2 s"]["verdict"] == "said"
    assert "a sensor that is stuck" in found["stuck imu 2 s"]["why"]
    assert found["stuck imu 2 s"]["factor"] > 2.0
    assert found["dropout vicon 1 s"]["verdict"] == "recovered"  # it reads none
    assert found["start heading 90 deg off"]["verdict"] == "undetectable"
    assert set(found) == {"duplicates imu", "stuck imu 2 s", "dropout vicon 1 s", "start heading 90 deg off"}


@pytest.mark.slow
def test_no_fault_of_the_error_state_filter_is_silent():
    report = faults(graphs="ins_eskf", kinds="spikes,noise,late,stuck vicon,singular")
    assert len(report.rows) == 2 * (2 + 2 + 3 + 1 + 1)
    assert {row["verdict"] for row in report.rows} <= {"recovered", "covered", "said"}
    late = [row for row in report.rows if row["fault"] == "late vicon 0.3 s" and row["gate"] == "off"]
    assert late[0]["verdict"] == "said"
    assert "the NIS is far from 1" in late[0]["why"]


def test_another_graph_is_refused():
    with pytest.raises(UnknownNameError, match="graph of this bench"):
        faults(graphs="tracker")


def test_faults_leave_the_flight_as_it_was_before():
    from flowgraph import load_flight

    flight = load_flight("sim", seed=0, settings={"duration": "5", "imu.rate": "100"})
    for fault in faults_of(flight):
        made = fault.make(flight, 3.0)
        changed = 0
        for name, series in flight.streams.items():
            before = series.time < int(series.time[0]) + 2_900_000_000
            part = made.streams[name]
            assert (part.time[: before.sum()] == series.time[before]).all()
            for leaf, values in series.leaves.items():
                assert (part.leaves[leaf][: before.sum()] == values[before]).all()
            changed += (
                len(part) != len(series)
                or any((part.leaves[leaf] != values).any() for leaf, values in series.leaves.items())
                or (part.time != series.time).any()
            )
        assert changed == (0 if fault.settings else len(flight.streams) if "jumps" in fault.name else 1), (
            fault.name
        )
