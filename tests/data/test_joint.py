"""Several files in one flight: what goes to which part, and what does not fit together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowgraph import Series, load_flight
from flowgraph.data.joint import doubtful_span, parts_of
from flowgraph.data.registry import flight_settings
from flowgraph.errors import DataError, UnknownNameError
from flowgraph.study import Study

START = 1400000000123456789
IMU = {"imu.gyro": "wx,wy,wz", "imu.specific_force": "ax,ay,az"}
VICON = {"vicon.position": "x,y,z", "vicon.attitude": "qw,qx,qy,qz"}


def write(folder: Path, start: int = START) -> Path:
    """A body at rest: its IMU, a motion capture, and the truth as TUM text."""
    times = [start + 5_000_000 * k for k in range(41)]
    imu = ["t,wx,wy,wz,ax,ay,az", *(f"{t},0,0,0,0,0,9.81" for t in times)]
    mocap = ["t,x,y,z,qw,qx,qy,qz", *(f"{t + 7},0,0,0,1,0,0,0" for t in times[::4])]
    truth = [f"{t // 10**9}.{t % 10**9:09d} 0 0 0 0 0 0 1" for t in times]
    for name, rows in (("imu.csv", imu), ("mocap.csv", mocap), ("truth.tum", truth)):
        (folder / name).write_text("\n".join(rows) + "\n")
    return folder


def both(folder: Path) -> str:
    return f"csv:{folder / 'imu.csv'}+csv:{folder / 'mocap.csv'}"


KINDS = ["csv", "tum", "sim", "euroc"]


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("csv:a.csv", ["csv:a.csv"]),
        ("csv:a.csv+csv:b.csv", ["csv:a.csv", "csv:b.csv"]),
        ("csv:a+b.csv+tum:c+d.tum", ["csv:a+b.csv", "tum:c+d.tum"]),
        ("csv:a+cs:v.csv", ["csv:a+cs:v.csv"]),
        ("sim", ["sim"]),
        (r"csv:C:\a b.csv+euroc:D:\x", [r"csv:C:\a b.csv", r"euroc:D:\x"]),
        ("csv:a+tum", ["csv:a+tum"]),
    ],
)
def test_a_plus_begins_a_part_where_a_kind_follows(spec, parts):
    assert parts_of(spec, KINDS) == parts


def test_a_file_of_the_whole_name_goes_first(tmp_path):
    file = tmp_path / "a+csv:b.csv"
    file.write_text("x")
    assert parts_of(f"csv:{file}", KINDS) == [f"csv:{file}"]


def test_each_table_takes_the_columns_that_it_has(tmp_path):
    flight = load_flight(both(write(tmp_path)), settings={"time.unit": "ns", **IMU, **VICON})
    assert flight.name == "imu+mocap"
    assert list(flight.streams) == ["imu", "vicon"]
    assert flight.streams["imu"].time[0] == START
    assert flight.streams["vicon"].time.tolist() == [START + 20_000_000 * k + 7 for k in range(11)]
    assert flight.info["imu_noise"].gyro > 0
    assert len(flight.notes) == len(set(flight.notes))


def test_a_part_has_settings_of_its_own(tmp_path):
    write(tmp_path)
    rows = (tmp_path / "mocap.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows[1:]]
    seconds = [[f"{int(t) // 10**9}.{int(t) % 10**9:09d}", *rest] for t, *rest in cells]
    (tmp_path / "mocap.csv").write_text("\n".join([rows[0], *(",".join(c) for c in seconds)]))
    given = {"time.unit": "ns", "2.time.unit": "s", **IMU, **VICON}
    flight = load_flight(both(tmp_path), settings=given)
    assert flight.streams["vicon"].time[0] == START + 7
    for key, text in (("3.time.unit", "3.time.unit"), ("2.clock", "2.clock"), ("clock", "'clock'")):
        with pytest.raises(UnknownNameError, match="no setting is called") as caught:
            load_flight(both(tmp_path), settings={**given, key: "s"})
        assert text in str(caught.value)
    assert {"time.unit", "1.time.unit", "2.vicon.position"} <= set(flight_settings(both(tmp_path)))
    assert "1.time.unit" not in flight_settings("csv:a.csv")


def test_three_parts_of_two_kinds(tmp_path):
    spec = both(write(tmp_path)) + f"+tum:{tmp_path / 'truth.tum'}"
    given = {"1.time.unit": "ns", "2.time.unit": "ns", "3.role": "truth", **IMU, **VICON}
    flight = load_flight(spec, settings=given)
    assert flight.truth is not None
    assert flight.truth.time[0] == START
    with pytest.raises(
        DataError, match="vicon is in two parts"
    ):  # a trajectory that is taken for a measurement
        load_flight(spec, settings={k: v for k, v in given.items() if k != "3.role"})


def test_a_stream_in_two_parts_is_refused_with_both_files(tmp_path):
    write(tmp_path)
    with pytest.raises(DataError) as caught:
        load_flight(
            f"csv:{tmp_path / 'imu.csv'}+csv:{tmp_path / 'imu.csv'}", settings={"time.unit": "ns", **IMU}
        )
    for part in ("imu is in two parts", "(part 1)", "(part 2)", "2.imu.FIELD", "expected:"):
        assert part in str(caught.value)


def test_a_column_that_no_part_has_is_named(tmp_path):
    given = {"time.unit": "ns", **IMU, **VICON, "vicon.position": "x,y,zz"}
    with pytest.raises(UnknownNameError, match="no column is called '(x|zz)'"):
        load_flight(both(write(tmp_path)), settings=given)


@pytest.mark.parametrize(
    ("shift", "words"),
    [(-START, "44.4 years earlier"), (10**10, "s later"), (-30 * 86400 * 10**9, "30 days")],
)
def test_parts_of_other_times_are_refused(tmp_path, shift, words):
    write(tmp_path, START + shift)
    other = (tmp_path / "mocap.csv").rename(tmp_path / "other.csv")
    write(tmp_path)
    spec = f"csv:{tmp_path / 'imu.csv'}+csv:{other}"
    with pytest.raises(DataError) as caught:
        load_flight(spec, settings={"time.unit": "ns", **IMU, **VICON})
    for part in ("no sample of vicon lies within the span of the imu", words, "2.time.unit"):
        assert part in str(caught.value)


def test_a_truth_of_its_own(tmp_path):
    write(tmp_path)
    given = {"1.time.unit": "ns", **IMU}
    truth = f"tum:{tmp_path / 'truth.tum'}"
    flight = load_flight(f"csv:{tmp_path / 'imu.csv'}", settings=given, truth=truth)
    assert flight.truth is not None
    assert flight.truth.name == "truth"
    assert list(flight.streams) == ["imu"]
    assert np.isin(flight.truth.time, flight.streams["imu"].time).all()
    columns = {"2.time.unit": "ns", "truth.position": "x,y,z", "truth.attitude": "qw,qx,qy,qz"}
    mapped = load_flight(
        f"csv:{tmp_path / 'imu.csv'}", settings={**given, **columns}, truth=f"csv:{tmp_path / 'mocap.csv'}"
    )
    assert mapped.truth is not None
    assert len(mapped.truth) == 11
    with pytest.raises(DataError, match="which of these is the truth"):
        load_flight(
            f"tum:{tmp_path / 'truth.tum'}",
            settings={"2.time.unit": "ns", **{f"2.{k}": v for k, v in IMU.items()}},
            truth=f"csv:{tmp_path / 'imu.csv'}",
        )


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("s", "its unit of time looks wrong by 1e3"),
        ("us", "its unit of time looks wrong by 1e3"),
        ("min", "only 1 of 50 samples of it lie within; check the unit"),
        ("ms", None),
    ],
)
@pytest.mark.parametrize("truth", [False, True])
def test_a_part_that_counts_from_zero_in_another_unit_is_said(tmp_path, unit, words, truth):
    imu = ["t,wx,wy,wz,ax,ay,az", *(f"{5 * k},0,0,0,0,0,9.81" for k in range(500))]
    (tmp_path / "imu.csv").write_text("\n".join(imu) + "\n")
    (tmp_path / "mocap.csv").write_text(
        "\n".join(f"{50 * k} {k / 1000} 0 0 0 0 0 1" for k in range(50)) + "\n"
    )
    parts = f"csv:{tmp_path / 'imu.csv'}", f"tum:{tmp_path / 'mocap.csv'}"
    given = {"1.time.unit": "ms", "2.time.unit": unit, **IMU}
    spec, other = (parts[0], parts[1]) if truth else ("+".join(parts), None)
    said = [n for n in load_flight(spec, settings=given, truth=other).notes if n.startswith("warning: ")]
    assert len(said) == (words is not None)
    assert words is None or (words in said[0] and ("truth" if truth else "vicon") in said[0])


def test_one_recording_in_two_units_is_said_too():
    time = np.arange(50) * 10**8
    assert not doubtful_span("truth", np.arange(900) * 10**7, "imu", time)  # a truth that is longer
    assert not doubtful_span("gps", time[:9], "imu", time // 1000)  # too few to tell
    assert "wrong by 1e6" in doubtful_span("gps", time, "imu", time // 10**6)[0]
    assert "only 20 of 50 samples" in doubtful_span("gps", time, "imu", time - 3 * 10**9)[0]


def test_settings_of_the_truth_are_for_the_truth_that_is_given(tmp_path):
    write(tmp_path)
    given = {"1.time.unit": "ns", **IMU, "truth.time_offset": "0.01", "truth.every": "0.02"}
    flight = load_flight(f"csv:{tmp_path / 'imu.csv'}", settings=given, truth=f"tum:{tmp_path / 'truth.tum'}")
    assert flight.truth is not None
    assert flight.truth.time[0] == START + 10_000_000
    assert len(flight.truth) == 11
    assert not any("this flight has no truth" in n for n in flight.notes)
    far = {**given, "truth.time_offset": "50"}
    with pytest.raises(DataError, match="no sample of truth"):
        load_flight(f"csv:{tmp_path / 'imu.csv'}", settings=far, truth=f"tum:{tmp_path / 'truth.tum'}")


def test_a_study_may_name_parts(tmp_path):
    spec = both(write(tmp_path))
    study = Study(
        graphs=("ins_eskf",),
        data=(spec,),
        parameters={"time.unit": ("ns",), **{k: (v,) for k, v in IMU.items()}},
    )
    assert study.data == (spec,)
    with pytest.raises(UnknownNameError, match="no kind of flight is called 'cvs'"):
        Study(graphs=("ins_eskf",), data=("cvs:a+csv:b",))


def test_a_series_may_have_dates(tmp_path):
    stamps = np.array(["2014-05-13T16:53:20.123456789", "2014-05-13T16:53:21"], dtype="datetime64[ns]")
    assert Series(stamps, np.zeros(2)).time.tolist() == [START, 1400000001 * 10**9]
    assert Series(np.array([1, 2], "timedelta64[ms]"), np.zeros(2)).time.tolist() == [10**6, 2 * 10**6]
    for bad in (np.array(["NaT", "2014"], "datetime64[s]"), np.array(["0100", "2014"], "datetime64[D]")):
        with pytest.raises(DataError, match="a time is missing, or beyond"):
            Series(bad, np.zeros(2))
