"""The command on flights of several files, and with a truth of its own."""

from __future__ import annotations

import json

import pytest

from tests.cli.test_cli import invoke
from tests.data.test_joint import IMU, VICON, both, write


def test_the_command_takes_parts_and_a_truth(tmp_path):
    truth = f"tum:{write(tmp_path) / 'truth.tum'}"
    given = {"1.time.unit": "ns", "2.time.unit": "ns", "settle": "0", **IMU, **VICON}
    sets = [word for key, value in given.items() for word in ("--set", f"{key}={value}")]
    done = invoke("run", "ins_eskf", "--data", both(tmp_path), "--truth", truth, *sets, "--json")
    assert done.exit_code == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["position_rmse_m"] < 0.01
    assert (report["data"], report["truth"]) == (both(tmp_path), truth)
    for other in (["show", "ins_eskf"], ["lower", "ins_eskf", "-o", str(tmp_path / "out")]):
        assert invoke(*other, "--data", both(tmp_path), "--truth", truth, *sets).exit_code == 0
    assert invoke("run", "ins_eskf", "--data", both(tmp_path), *sets, "--set", "3.time.unit=s").exit_code == 2


def test_parts_are_tuned_as_one_recording(tmp_path):
    write(tmp_path)
    sets = [w for k, v in {"time.unit": "ns", **IMU, **VICON}.items() for w in ("--set", f"{k}={v}")]
    spec = both(tmp_path)
    done = invoke(
        "tune",
        "ins_eskf",
        "--data",
        spec,
        "--fit",
        "position_noise=0.001:0.1",
        "--most",
        "3",
        *sets,
        "--json",
    )
    assert done.exit_code == 0, done.stderr
    assert [r["data"] for r in json.loads(done.stdout)["recordings"]] == [spec]


@pytest.mark.parametrize("verb", [["run"], ["show"], ["lower", "-o", "x"]])
def test_a_second_flight_is_refused_with_what_was_meant(verb):
    done = invoke(*verb, "ins_eskf", "--data", "csv:a.csv", "--data", "csv:b.csv")
    assert done.exit_code == 2
    for part in ("takes one flight", "--data csv:a.csv+csv:b.csv", "tune", "expected:"):
        assert part in done.stderr
