"""The EuRoC reader: exact times, both kinds of truth, and errors that name file and line."""

from __future__ import annotations

from pathlib import Path
from time import process_time

import numpy as np
import pytest

from flowgraph import Flight, Series
from flowgraph.blocks.datasets import euroc
from flowgraph.blocks.datasets.tables import nanoseconds
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

START = 1403636579758560001  # odd in its last digit: a float64 would lose it
IMU_ROWS = [f"{START + 5_000_000 * k},0.1,0.2,0.3,9.81,{k},0" for k in range(5)]
IMU = "\n".join(["#timestamp [ns],w,w,w,a,a,a", *IMU_ROWS])
LEICA_ROWS = [f"{START + d},1,2,3" for d in (-10_000_000, 1, 7_000_000)]
LEICA = "\n".join(["#timestamp [ns],p,p,p", *LEICA_ROWS])
VICON = f"#t,p,p,p,q,q,q,q\n{START + 3},1,2,3,0.5,0.5,0.5,0.5"
SENSOR = """
T_BS: {data: [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]}
rate_hz: 200
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""
TUM = "# t p q\n1403636579.758560001 1 2 3 0.1 0.2 0.3 0.9273618495495703\n1403636579.76 1 2 4 0 0 0 1\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small sequence with an IMU, a Leica and a TUM truth."""
    for name in ("imu0", "leica0"):
        (tmp_path / "seq" / "mav0" / name).mkdir(parents=True)
    mav = tmp_path / "seq" / "mav0"
    (mav / "imu0" / "data.csv").write_text(IMU)
    (mav / "imu0" / "sensor.yaml").write_text(SENSOR)
    (mav / "leica0" / "data.csv").write_text(LEICA)
    (tmp_path / "seq" / "groundtruth.tum").write_text(TUM)
    return tmp_path / "seq"


def truth_of(flight: Flight) -> Series:
    assert flight.truth is not None
    return flight.truth


def refused(folder: Path, *parts: str, **settings: str | float) -> DataError:
    with pytest.raises(DataError) as caught:
        euroc.load(str(folder), settings=settings)
    for part in parts:
        assert part in str(caught.value)
    return caught.value


def test_reads_a_sequence_with_exact_times(folder):
    flight = euroc.load(str(folder))
    assert flight.name == "seq"
    imu, leica = flight.streams["imu"], flight.streams["leica"]
    assert imu.time.tolist() == [START + 5_000_000 * k for k in range(5)]
    np.testing.assert_array_equal(imu.gyro[2], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(imu.specific_force[2], [9.81, 2.0, 0.0])
    assert leica.time.tolist() == [START + 1, START + 7_000_000]  # the one before the IMU is left out
    assert any("1 samples from before the first imu sample" in note for note in flight.notes)
    assert truth_of(flight).time.tolist() == [START, 1403636579760000000]
    np.testing.assert_allclose(truth_of(flight).attitude[0], [0.9273618495495703, 0.1, 0.2, 0.3])
    assert flight.info["imu_noise"].gyro == 1.6968e-04
    assert flight.info["imu_noise"].accelerometer_bias == 3e-3
    assert flight.info["imu_period_ns"] == 5_000_000
    assert flight.info["leica_lever"] == euroc.LEICA_LEVER


def test_the_path_may_be_mav0_and_the_truth_in_it(folder):
    (folder / "groundtruth.tum").rename(folder / "mav0" / "groundtruth.tum")
    flight = euroc.load(str(folder / "mav0"))
    assert flight.name == "seq"
    assert len(truth_of(flight)) == 2


def test_sensors_and_truth_may_be_absent(folder):
    (folder / "groundtruth.tum").unlink()
    (folder / "mav0" / "leica0" / "data.csv").unlink()
    (folder / "mav0" / "leica0").rmdir()
    flight = euroc.load(str(folder))
    assert list(flight.streams) == ["imu"]
    assert flight.truth is None
    assert any("no ground truth" in note for note in flight.notes)


def test_vicon_and_extrinsics(folder):
    vicon = folder / "mav0" / "vicon0"
    vicon.mkdir()
    (vicon / "data.csv").write_text(VICON)
    assert euroc.load(str(folder)).info["vicon_mount"] == (1.0, 0.0, 0.0, 0.0)
    turned = "T_BS: {data: [0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]}"
    (vicon / "sensor.yaml").write_text(turned)
    (folder / "mav0" / "leica0" / "sensor.yaml").write_text(turned)
    flight = euroc.load(str(folder))
    assert flight.info["leica_lever"] == flight.info["vicon_lever"] == (0.1, 0.2, 0.3)
    np.testing.assert_allclose(flight.info["vicon_mount"], [0.5**0.5, 0.0, 0.0, 0.5**0.5])
    # q of the marker = q of the body times the mount, a quarter turn about z: undone here
    body = [0.5**0.5, 0.0, 0.5**0.5, 0.0]
    np.testing.assert_allclose(flight.streams["vicon"].attitude, [body], atol=1e-15)


def test_asl_truth_goes_before_tum(folder):
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    row = ",".join(map(str, [START, 1, 2, 3, 1, 0, 0, 0, 4, 5, 6, 7, 8, 9, 10, 11, 12]))
    (truth / "data.csv").write_text("#head\n" + row + "\n")
    state = truth_of(euroc.load(str(folder)))
    np.testing.assert_array_equal(state.velocity, [[4, 5, 6]])
    np.testing.assert_array_equal(state.attitude, [[1, 0, 0, 0]])
    np.testing.assert_array_equal(state.gyro_bias, [[7, 8, 9]])
    np.testing.assert_array_equal(state.accelerometer_bias, [[10, 11, 12]])


@pytest.mark.parametrize("value", ["-0.000000001", -1e-9])
def test_time_offsets_are_rounded_once_and_exact(folder, value):
    flight = euroc.load(str(folder), settings={"leica.time_offset": value})
    assert flight.streams["leica"].time.tolist() == [START, START + 7_000_000 - 1]
    assert "info: leica: stamps shifted by -1 ns" in flight.notes


def test_offsets_of_each_sensor_move_only_that_sensor(folder):
    flight = euroc.load(str(folder), settings={"imu.time_offset": "-0.015", "truth.time_offset": "0.002"})
    assert flight.streams["imu"].time[0] == START - 15_000_000
    assert len(flight.streams["leica"]) == 3
    assert truth_of(flight).time[0] == START + 2_000_000


def test_seconds_become_nanoseconds_without_a_float():
    assert nanoseconds("1403636579.758560001") == START
    assert nanoseconds("1.403636579758560001e9") == START
    assert nanoseconds("-0.135") == -135_000_000
    for bad in ("x", "nan", "inf", ""):
        with pytest.raises(ValueError, match="not a finite number"):
            nanoseconds(bad)


def test_unknown_settings_list_the_valid_ones(folder):
    with pytest.raises(UnknownNameError, match=r"leica\.time_offset"):
        euroc.load(str(folder), settings={"leica.offset": 1})
    with pytest.raises(UnknownNameError, match="drop, raise, sort"):
        euroc.load(str(folder), settings={"bad_time": "ignore"})
    with pytest.raises(DeclarationError, match=r"'imu.time_offset' is not usable[\s\S]*number of seconds"):
        euroc.load(str(folder), settings={"imu.time_offset": "late"})


def test_missing_folders_and_files_are_named(folder, tmp_path):
    refused(tmp_path / "none", "no EuRoC sequence", "no such folder", "mav0/imu0")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "nothing in it")
    (folder / "mav0" / "leica0" / "data.csv").unlink()
    refused(folder, str(Path("leica0") / "data.csv"), "data.csv is missing", "prism")
    (folder / "mav0" / "imu0" / "data.csv").unlink()
    refused(folder, str(Path("imu0") / "data.csv"), "data.csv is missing", "the IMU's data")


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("{t},1,2,3,4,5", "wrong number of columns"),
        ("{t},1,2,3,4,5,6,7", "wrong number of columns"),
        ("{t},1,2,three,4,5,6", "column 4 is not a finite number"),
        ("{t},1,2,3,4,-inf,6", "column 6 is not a finite number"),
        ("{t},1,2,3,4,5,inf", "column 7 is not a finite number"),
        ("{t},1,,3,4,5,6", "column 3 is not a finite number"),
        ("1.4e18,1,2,3,4,5,6", "the stamp is not a time"),
        ("later,1,2,3,4,5,6", "the stamp is not a time"),
        ("99999999999999999999,1,2,3,4,5,6", "the stamp is not a time"),
    ],
)
def test_a_malformed_row_is_named_by_file_and_line(folder, row, problem):
    file = folder / "mav0" / "imu0" / "data.csv"
    lines = IMU.splitlines()
    lines.insert(3, row.format(t=START + 7_000_000))
    file.write_text("\n".join(lines))
    refused(folder, f"{file}, line 4", problem)


@pytest.mark.parametrize("stamp", ["1.5e560001", "1.5D99999999", "-1e400000", "1" * 40])
def test_a_stamp_of_any_size_is_refused_before_it_is_written_out(folder, stamp):
    """An integer of a million digits takes ten seconds to make."""
    (folder / "groundtruth.tum").write_text(f"# t p q\n{stamp} 0 0 0 0 0 0 1\n")
    start = process_time()
    refused(folder, "groundtruth.tum, line 2", "the stamp is not a time")
    assert process_time() - start < 2.0


def test_an_empty_table_and_a_bad_quaternion_are_refused(folder):
    (folder / "groundtruth.tum").write_text("# t p q\n1.5 0 0 0 0 0 0 1\n2.5 0 0 0 0 0 0 0.9\n")
    refused(folder, "groundtruth.tum, line 3", "not a unit quaternion", "0.9")
    (folder / "groundtruth.tum").write_text("# t p q\nsoon 0 0 0 0 0 0 1\n")
    refused(folder, "groundtruth.tum, line 2", "the stamp is not a time", "decimal seconds")
    (folder / "mav0" / "leica0" / "data.csv").write_text("# nothing\n\n")
    refused(folder, "leica0", "no rows")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (SENSOR.replace("rate_hz: 200", "rate_hz: often"), "'rate_hz' is missing or not a positive number"),
        (SENSOR.replace("gyroscope_random_walk", "gyro_walk"), "'gyroscope_random_walk' is missing"),
        ("- 1\n- 2\n", "no sensor description"),
        ("a: [1, 2\n", "not readable as YAML"),
        ("a: !!python/object/apply:os.getcwd []\n", "not readable as YAML"),
    ],
)
def test_a_bad_sensor_file_is_refused(folder, text, problem):
    (folder / "mav0" / "imu0" / "sensor.yaml").write_text(text)
    refused(folder, "sensor.yaml", problem)


@pytest.mark.parametrize("data", ["[1, 2]", "[2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]", "none"])
def test_bad_extrinsics_are_refused(folder, data):
    (folder / "mav0" / "leica0" / "sensor.yaml").write_text(f"T_BS: {{data: {data}}}")
    refused(folder, "leica0", "T_BS is missing or malformed")


def jumbled(folder: Path) -> None:
    stamps = [0, 10, 5, 10, 20]
    rows = [f"{START + t * 1_000_000},{k},0,0,0,0,9.8" for k, t in enumerate(stamps)]
    (folder / "mav0" / "imu0" / "data.csv").write_text("#head\n" + "\n".join(rows))


def test_time_that_does_not_increase_is_refused(folder):
    jumbled(folder)
    refused(
        folder,
        "data.csv, line 4",
        "time does not increase",
        f"after {START + 10_000_000} ns",
        "bad_time=sort",
    )


def test_bad_times_can_be_dropped(folder):
    jumbled(folder)
    flight = euroc.load(str(folder), settings={"bad_time": "drop"})
    assert (flight.streams["imu"].time - START).tolist() == [0, 10_000_000, 20_000_000]
    assert flight.streams["imu"].gyro[:, 0].tolist() == [0, 1, 4]
    assert "skipped: imu: 2 rows out of order left out" in flight.notes


def test_bad_times_can_be_sorted(folder):
    jumbled(folder)
    flight = euroc.load(str(folder), settings={"bad_time": "sort"})
    assert (flight.streams["imu"].time - START).tolist() == [0, 5_000_000, 10_000_000, 20_000_000]
    assert flight.streams["imu"].gyro[:, 0].tolist() == [0, 2, 1, 4]
    assert "skipped: imu: sorted, 2 rows were out of order, 1 of equal time left out" in flight.notes


# -- offsets, rates and what real files hold -----------------------------------------------------------


@pytest.mark.parametrize("value", ["1e7", "-1000001", "1e30", "1e999999999", "inf", "nan", "1_0", "abc", ""])
def test_an_absurd_offset_is_refused(folder, value):
    with pytest.raises(DeclarationError, match=r"'leica.time_offset' is not usable") as caught:
        euroc.load(str(folder), settings={"leica.time_offset": value})
    assert "at most 1000000" in str(caught.value)


@pytest.mark.parametrize(("name", "value"), [("leica", "1000"), ("leica", "-1000"), ("imu", "500000")])
def test_an_offset_that_leaves_no_sample_is_named(folder, name, value):
    error = refused(folder, f"{name}.time_offset={float(value):g}", **{f"{name}.time_offset": value})
    assert "no sample of leica lies within the span of the imu" in str(error)
    assert error.fix == "check leica.time_offset and imu.time_offset, which are in seconds"


def test_a_shift_stays_within_64_bits(folder):
    late = 2**63 - 10
    (folder / "mav0" / "imu0" / "data.csv").write_text(f"{late - 5},0,0,0,0,0,9\n{late},0,0,0,0,0,9\n")
    refused(folder, "do not fit 64 bits", "data.csv", **{"imu.time_offset": "1"})


@pytest.mark.parametrize("rate", ["1e12", "1e-300", "1e300", "true", "0"])
def test_an_absurd_rate_is_refused(folder, rate):
    (folder / "mav0" / "imu0" / "sensor.yaml").write_text(SENSOR.replace("rate_hz: 200", f"rate_hz: {rate}"))
    refused(folder, "sensor.yaml", "rate_hz", "expected:", "fix:")


@pytest.mark.parametrize("file", ["imu0/data.csv", "leica0/data.csv"])
@pytest.mark.parametrize(("old", "new"), [("14036", "1_4036"), (",2", ",2_0")])
def test_underscores_are_refused_by_file_and_line(folder, file, old, new):
    path = folder / "mav0" / file
    rows = path.read_text().splitlines()
    rows[2] = rows[2].replace(old, new, 1)
    path.write_text("\n".join(rows))
    if new in rows[2]:
        refused(folder, f"{file}, line 3", "expected:", "got:", "fix:")


def test_underscores_in_seconds_are_refused(folder):
    (folder / "groundtruth.tum").write_text(TUM.replace("1403636579.76 ", "1_403636579.76 "))
    refused(folder, "groundtruth.tum, line 3", "the stamp is not a time")


def test_a_byte_order_mark_is_passed_over(folder):
    expected = euroc.load(str(folder))
    for file in folder.rglob("*"):
        if file.is_file():
            file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    flight = euroc.load(str(folder))
    np.testing.assert_array_equal(flight.streams["imu"].time, expected.streams["imu"].time)
    assert flight.info["imu_noise"] == expected.info["imu_noise"]
    (folder / "mav0" / "imu0" / "data.csv").write_text(
        "\ufeff" + IMU.split("\n", 1)[1], encoding="utf-8"
    )  # a mark before a stamp, not a comment
    assert len(euroc.load(str(folder)).streams["imu"]) == 5


def test_a_yaml_header_and_matrix_as_opencv_writes_them_are_read(folder):
    numbers = "[1.0, 0, 0, 0.5, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]"
    matrix = f"T_BS: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: {numbers}\n"
    (folder / "mav0" / "leica0" / "sensor.yaml").write_text("%YAML:1.0\n---\n" + matrix)
    (folder / "mav0" / "imu0" / "sensor.yaml").write_text("%YAML:1.0\n" + SENSOR)
    flight = euroc.load(str(folder))
    assert flight.info["leica_lever"] == (0.5, 0.0, 0.0)
    assert flight.info["imu_period_ns"] == 5_000_000


def test_other_yaml_tags_make_nothing(folder):
    (folder / "mav0" / "imu0" / "sensor.yaml").write_text("!!python/object/apply:os.getcwd []\n")
    refused(folder, "sensor.yaml", "not readable as YAML")
