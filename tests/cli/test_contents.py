"""`flowgraph inspect`: what is in a recording, by what the test wrote into it."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from flowgraph.cli import app


def invoke(*arguments: str):
    return CliRunner(env={"COLUMNS": "220", "NO_COLOR": "1"}).invoke(app, ["inspect", *arguments])


def written(file: Path) -> list[str]:
    """4 s of an IMU at 50 Hz with a pause of 0.5 s, and a GPS at 2 Hz; the arguments that read it."""
    rows = ["t,wx,wy,wz,ax,ay,az,lat,lon,h"]
    for k in range(200):
        if 100 <= k < 124:
            continue
        fix = f"47.4,8.5,{430 + k}" if k % 25 == 0 else ",,"
        rows.append(f"{k * 0.02:.2f},0.01,0,0,0,0.1,9.8,{fix}")
    file.write_text("\n".join(rows) + "\n")
    settings = (
        "imu.gyro=wx,wy,wz", "imu.specific_force=ax,ay,az", "gps.latitude=lat", "gps.longitude=lon",
        "gps.height=h", "gps.latitude.unit=deg", "gps.longitude.unit=deg",
    )  # fmt: skip
    return [f"csv:{file}", *(part for s in settings for part in ("--set", s))]


def test_it_tells_streams_fields_rates_gaps_and_graphs(tmp_path):
    done = invoke(*written(tmp_path / "log.csv"), "--json")
    assert done.exit_code == 0
    found = json.loads(done.stdout)
    imu, gps = found["streams"]
    assert imu == {
        "name": "imu",
        "kind": "Imu",
        "fields": [{"name": "gyro", "unit": "rad/s"}, {"name": "specific_force", "unit": "m/s^2"}],
        "count": 176,
        "rate_hz": 50.0,
        "first_ns": 0,
        "last_ns": 3_980_000_000,
        "gaps": 1,
        "longest_gap_s": 0.5,
    }
    assert gps["count"] == 7
    assert gps["kind"] == "GeodeticPosition"
    assert gps["rate_hz"] == 2.0
    assert [f["unit"] for f in gps["fields"]] == ["rad", "rad", "m"]
    assert "gnss_ins" in found["graphs"]
    assert not {"ins_eskf", "ekf", "outdoor_eskf"} & set(found["graphs"])
    assert any("noise of a typical unit" in n for n in found["notes"])


def test_a_simulated_flight_has_its_truth_and_the_graphs_that_run_on_it():
    done = invoke("sim", "--set", "duration=3", "--json")
    found = json.loads(done.stdout)
    assert [s["name"] for s in found["streams"]] == ["imu", "vicon", "truth"]
    assert {"ins_eskf", "ekf", "gnss_ins"} <= set(found["graphs"])
    assert "outdoor_eskf" not in found["graphs"]


def test_in_words(tmp_path):
    done = invoke(*written(tmp_path / "log.csv"))
    assert "specific_force" in done.stdout
    assert "(m/s^2)" in done.stdout
    assert "graphs: " in done.stdout
    assert "gnss_ins" in done.stdout


def test_what_cannot_be_read_and_settings_that_are_none_are_refused(tmp_path):
    assert invoke(f"tum:{tmp_path / 'absent.tum'}").exit_code == 1
    done = invoke("sim", "--set", "wind=3")
    assert done.exit_code in (1, 2)
    assert "wind" in done.stderr
