"""Tables as pandas, R, MATLAB, spreadsheets and loggers write them: the same numbers, or a reason."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowgraph import Flight, load_flight
from flowgraph.blocks.datasets import euroc, tum
from flowgraph.blocks.datasets.cells import stamps
from flowgraph.blocks.datasets.units import unit_of
from flowgraph.errors import DataError, DeclarationError, FlowgraphError, UnknownNameError

START = 1400000000123456789  # odd in its last digit: a float64 would lose it
NAMES = ["t", "wx", "wy", "wz", "ax", "ay", "az"]
ROWS = [[str(START + 5_000_000 * k), "0.5", "-0.25", f"0.0{k}1", "0.1", "1e-3", "9.81"] for k in range(5)]
GIVEN = {"time.unit": "ns", "imu.gyro": "wx,wy,wz", "imu.specific_force": "ax,ay,az"}


def text(rows: list[list[str]] = ROWS, between: str = ",", head: str | None = None, end: str = "\n") -> str:
    lines = [between.join(NAMES) if head is None else head, *(between.join(row) for row in rows)]
    return end.join(line for line in lines if line is not None) + end


def comma(between: str = ";", end: str = "\n") -> str:
    return text([[c.replace(".", ",") for c in row] for row in ROWS], between, between.join(NAMES), end)


def load(folder: Path, content: str | bytes, **more: str) -> Flight:
    file = folder / "log.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    given = {**GIVEN, **{k.replace("__", "."): v for k, v in more.items()}}
    return load_flight(f"csv:{file}", settings={k: v for k, v in given.items() if v})


def same(flight: Flight) -> None:
    imu = flight.streams["imu"]
    assert imu.time.tolist() == [int(row[0]) for row in ROWS]
    np.testing.assert_allclose(imu["gyro"], [[float(x) for x in row[1:4]] for row in ROWS], rtol=1e-15)
    np.testing.assert_allclose(
        imu["specific_force"], [[float(x) for x in row[4:]] for row in ROWS], rtol=1e-15
    )


DIALECTS: dict[str, str | bytes] = {
    "plain": text(),
    "spreadsheet with decimal commas": comma(),
    "tabs and decimal commas": comma("\t", "\r\n"),
    "quoted decimal commas between commas": text(
        [[f'"{c.replace(".", ",")}"' for c in row] for row in ROWS], head=",".join(f'"{n}"' for n in NAMES)
    ),
    "sep= on the first line": "sep=;\n" + comma(),
    "sep=, in quotes, with commas": '"sep=,"\r\n' + text(end="\r\n"),
    "UTF-16 with its mark, tabs": text(between="\t").encode("utf-16"),
    "UTF-16, big end first, no mark": text().encode("utf-16-be"),
    "UTF-32": text().encode("utf-32"),
    "UTF-8 with its mark": b"\xef\xbb\xbf" + text().encode(),
    "ends of lines of old Macs": text(end="\r"),
    "MATLAB comments": "% exported\n%\n" + text(),
    "C comments and others": "// log\n! note\n" + text() + "# the end\n",
    "comments that are padded": "# made by a logger,,,,,,\n" + text(),
    "names behind a mark": "%" + text(),
    "names behind a mark, and prose": "# a remark, with commas\n# " + text(),
    "comments between rows": text().replace(f"{ROWS[2][0]}", f"% lost contact\n{ROWS[2][0]}"),
    "quoted names, as R": text(head=",".join(f'"{n}"' for n in NAMES)),
    "row names of R": text(
        [[f'"{k}"', *row] for k, row in enumerate(ROWS, 1)], " ", " ".join(f'"{n}"' for n in NAMES)
    ),
    "row names of R, csv": text(
        [[f'"{k}"', *row] for k, row in enumerate(ROWS, 1)], head='"",' + ",".join(NAMES)
    ),
    "the index of pandas": text([[str(k), *row] for k, row in enumerate(ROWS)], head="," + ",".join(NAMES)),
    "a delimiter at each end": text([[*row, ""] for row in ROWS], head=",".join(NAMES) + ","),
    "a delimiter at the end of rows only": text([[*row, ""] for row in ROWS]),
    "aligned with blanks": text([[c.rjust(22) for c in row] for row in ROWS], " "),
    "pipes": text(between=" | "),
    "a row of units": text(head=",".join(NAMES) + "\n[ns],[rad/s],[rad/s],[rad/s],[m/s2],[m/s2],[m/s2]"),
    "no units": text(head=",".join(NAMES) + "\n" + ",".join("-" * 7)),
    "units in words": text(head=",".join(NAMES) + "\nns,rad s^-1,rad s^-1,rad s^-1,m s^-2,m s^-2,m s^-2"),
    "units behind names": text(head="t [ns],wx (rad/s),wy (rad/s),wz (rad/s),ax [m/s²],ay [m/s²],az [m/s²]"),
    "a title, and units nobody knows": text(
        head="Run 7\n" + ",".join(NAMES) + "\nfoo,foo,foo,foo,foo,foo,foo"
    ),
    "a quoted cell over two lines": text(
        [[*row, '"a note\nof two lines, and a comma"'] for row in ROWS], head=",".join([*NAMES, "note"])
    ),
    "exponents of Fortran": text([[*row[:5], "1.0D-03", row[6]] for row in ROWS]),
    "a real minus sign": text([[c.replace("-0.25", "\u22120.25") for c in row] for row in ROWS]),
    "cp1252": text(head=",".join([*NAMES, "heat [°C]"]).encode("cp1252").decode("latin-1")).encode("latin-1"),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_dialect_says_the_same_numbers(tmp_path, dialect):
    same(load(tmp_path, DIALECTS[dialect]))


@pytest.mark.parametrize(
    ("dialect", "said"),
    [
        ("spreadsheet with decimal commas", "assumed: log.csv: numbers have a decimal comma"),
        ("tabs and decimal commas", "assumed: log.csv: the delimiter is a tab"),
        ("MATLAB comments", "skipped: log.csv: 2 lines (1 the first) of comment"),
        ("comments between rows", "skipped: log.csv: line 4 of comment"),
        ("a title, and units nobody knows", "skipped: log.csv: line 3, units not understood"),
        ("a title, and units nobody knows", "skipped: log.csv: line 1 before the names"),
        ("the index of pandas", "assumed: log.csv: column 't' is the time"),
        ("cp1252", "assumed: log.csv: it is no UTF-8, read as cp1252 (Western European)"),
    ],
)
def test_what_was_found_out_is_said(tmp_path, dialect, said):
    assert said in load(tmp_path, DIALECTS[dialect]).notes
    assert said not in load(tmp_path, text()).notes


def test_words_for_what_was_not_measured(tmp_path):
    words = ["NA", "N/A", "#N/A", "null", "None", "-", "1.#QNAN", "-nan(ind)", "<NA>", "NaN", ""]
    rows = [
        [str(START + 1_000_000 * k), "0", "0", "0", w, "0", "9.8"]
        for k, w in enumerate([*words, "1", "2", "3", "4"])
    ]
    flight = load(tmp_path, text(rows))
    assert len(flight.streams["imu"]) == 4
    assert flight.info["absent"]["imu"] == len(words)


BAD: dict[str, tuple[str | bytes, type[FlowgraphError], list[str]]] = {
    "thousands": (
        text([[*row[:1], '"1,234.5"', *row[2:]] for row in ROWS]),
        DataError, ["line 2", "thousands separators", "1,234.5"],
    ),
    "thousands, German": (
        text([[*row[:1], "1.234,5", *row[2:]] for row in ROWS], ";", ";".join(NAMES)),
        DataError, ["line 2", "thousands separators"],
    ),
    "in doubt": (
        text([[*row[:1], "1,234", "2,345", "3,456", "1", "2", "9"] for row in ROWS], ";", ";".join(NAMES)),
        DataError, ["two ways", "decimal=comma"],
    ),
    "two marks": (
        text([[*row[:1], "0,5", *row[2:]] for row in ROWS], ";", ";".join(NAMES)),
        DataError, ["decimal comma or a decimal point", "'0,5'"],
    ),
    "commas in all": (
        text([[c.replace(".", ",") for c in row] for row in ROWS]),
        DataError, ["decimal comma"],
    ),
    "twice": (
        text(head=",".join([*NAMES[:2], "wx", *NAMES[3:]])),
        DataError, ["'wx' is ambiguous", "columns 1, 2"],
    ),
    "two clocks": (
        text([[*row, "1"] for row in ROWS], head=",".join([*NAMES, "timestamp"])),
        DataError, ["several columns may be the time", "t, timestamp", "time=t or time=timestamp"],
    ),
    "an index": (
        text([[str(k), *row] for k, row in enumerate(ROWS)], head="Unnamed: 0,clock," + ",".join(NAMES[1:])),
        DataError, ["index of rows, not a time", "time=clock"],
    ),
    "other units": (
        text(head=",".join(NAMES) + "\n[s],[rad/s],[rad/s],[rad/s],[m/s2],[m/s2],[m/s2]"),
        DeclarationError, ["another unit than time.unit", "line 2", "time.unit=s"],
    ),
    "a unit of another kind": (
        text(head="t,wx [m],wy [m],wz [m],ax,ay,az"),
        DataError, ["cannot be those of imu.gyro", "rad/s, deg/s"],
    ),
    "a wide row": (
        text([*ROWS[:2], [*ROWS[2], "7"], *ROWS[3:]]),
        DataError, ["line 4", "wrong number of columns"],
    ),
    "hexadecimal": (text([[*row[:1], "0x1p3", *row[2:]] for row in ROWS]), DataError, ["line 2", "'0x1p3'"]),
    "endless": (text([*ROWS[:1], [ROWS[1][0], "inf", *ROWS[1][2:]]]), DataError, ["line 3", "finite number"]),
    "gzip": (gzip.compress(text().encode()), DataError, ["no text table", "gzip", "unpack"]),
    "a spreadsheet": (b"PK\x03\x04" + bytes(100), DataError, ["no text table", ".xlsx", "save it as csv"]),
    "Parquet": (b"PAR1" + bytes(100), DataError, ["Parquet"]),
    "bytes": (bytes(range(256)), DataError, ["no text table", "binary"]),
    "names only": (text([]), DataError, ["no rows"]),
    "a day or a month": (
        text([["01/02/2024 10:00:00", *row[1:]] for row in ROWS]),
        DataError, ["the stamp is not a time", "which of the numbers is the day"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_what_can_be_read_in_two_ways_is_refused_by_name(tmp_path, what):
    content, kind, parts = BAD[what]
    with pytest.raises(kind) as caught:
        load(tmp_path, content)
    for part in (*parts, "expected:", "got:", "fix:"):
        assert part in str(caught.value)


def test_settings_tell_what_the_file_does_not(tmp_path):
    rows = [[*row[:1], "1,234", "2,345", "3,456", "1", "2", "9"] for row in ROWS]
    flight = load(tmp_path, text(rows, ";", ";".join(NAMES)), decimal="comma")
    assert flight.streams["imu"]["gyro"][0].tolist() == [1.234, 2.345, 3.456]
    assert "assumed: log.csv: numbers have a decimal comma" not in flight.notes
    same(load(tmp_path, "@ remark\n" + text(), comment="@", delimiter="comma"))
    with pytest.raises(DataError, match="decimal comma or a decimal point"):
        load(tmp_path, comma(), decimal="point")
    with pytest.raises(UnknownNameError, match="comma, pipe"):
        load(tmp_path, text(), delimiter="dash")
    with pytest.raises(UnknownNameError, match="comma, point"):
        load(tmp_path, text(), decimal="dot")


def test_units_of_the_file_are_taken_and_said(tmp_path):
    units = "\n[us],[deg/s],[deg/s],[deg/s],[g],[g],[g]"
    rows = [[str(k), "180", "0", "0", "0", "0", "1"] for k in range(1000, 5000, 1000)]
    flight = load(tmp_path, text(rows, head=",".join(NAMES) + units), time__unit="")
    imu = flight.streams["imu"]
    assert imu.time.tolist() == [1_000_000, 2_000_000, 3_000_000, 4_000_000]
    np.testing.assert_allclose(imu["gyro"][0], [np.pi, 0, 0])
    np.testing.assert_allclose(imu["specific_force"][0], [0, 0, 9.80665])
    assert "info: imu.gyro.unit: deg/s, as line 2 of log.csv says" in flight.notes
    named = text(rows, head=",".join(["time_us", *NAMES[1:]]))
    flight = load(tmp_path, named, time__unit="", imu__gyro__unit="deg/s", imu__specific_force__unit="g")
    assert flight.streams["imu"].time.tolist() == imu.time.tolist()
    assert "info: time.unit: us, as the name 'time_us' says" in flight.notes


@pytest.mark.parametrize(
    ("spelled", "unit"),
    [("[°/s]", "deg/s"), ("dps", "deg/s"), ("(rad s^-1)", "rad/s"), ("m/s²", "m/s^2"), ("m s⁻²", "m/s^2"),
     ("[µT]", "uT"), ("Gauss", "G"), ("µs", "us"), ("Seconds", "s"), ("[-]", "none"), ("furlong", "")],
)  # fmt: skip
def test_units_have_many_spellings(spelled, unit):
    assert unit_of(spelled) == unit


def test_a_head_of_several_rows_as_motion_capture_writes_it(tmp_path):
    head = (
        "Format Version,1.23,Take Name,one\n\n,,Type,Type,Type,Marker,Marker,Marker\n"
        ",,Rotation,Rotation,Rotation,Position,Position,Position\nFrame,Time (Seconds),X,Y,Z,X,Y,Z"
    )
    rows = [[str(k), f"{0.01 * k:.2f}", "10", "20", "30", "1", "2", str(k)] for k in range(4)]
    given = {
        "imu.gyro": "", "imu.specific_force": "", "time.unit": "", "time": "Time",
        "vicon.position": "Marker.Position.X,Marker.Position.Y,Marker.Position.Z",
        "vicon.angles": "Type.Rotation.X,Type.Rotation.Y,Type.Rotation.Z", "vicon.angles.order": "xyz",
    }  # fmt: skip
    flight = load(tmp_path, text(rows, head=head), **{k.replace(".", "__"): v for k, v in given.items()})
    vicon = flight.streams["vicon"]
    assert vicon.time.tolist() == [0, 10_000_000, 20_000_000, 30_000_000]
    assert vicon["position"][3].tolist() == [1, 2, 3]
    wanted = Rotation.from_euler("XYZ", [10, 20, 30], degrees=True)
    found = Rotation.from_quat(vicon["attitude"][0][[1, 2, 3, 0]])
    assert (wanted.inv() * found).magnitude() < 1e-12
    assert any(n == "assumed: vicon.angles are in deg; vicon.angles.unit says it" for n in flight.notes)
    with pytest.raises(DataError, match="'X' is ambiguous"):
        load(tmp_path, text(rows, head=head), time="Time", imu__gyro="X,Y,Z")


def turned(folder: Path, angles: np.ndarray, mapping: dict[str, str], columns: np.ndarray) -> Flight:
    rows = [[f"{0.01 * k:.2f}", "1", "2", "3", *map(repr, row.tolist())] for k, row in enumerate(columns)]
    (folder / "a.csv").write_text("\n".join(",".join(row) for row in rows))
    return load_flight(f"csv:{folder / 'a.csv'}", settings={"vicon.position": "1,2,3", **mapping})


@pytest.mark.parametrize("order", ["zyx", "zxy", "xyz", "yzx"])
@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_attitudes_may_be_angles(tmp_path, order, unit):
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))  # about x, y and z
    columns = np.degrees(angles) if unit == "deg" else angles
    given = {"vicon.angles": "4,5,6", "vicon.angles.order": order, "vicon.angles.unit": unit}
    flight = turned(tmp_path, angles, given, columns)
    about = {axis: Rotation.from_rotvec(np.eye(3)[k] * angles[:, [k]]) for k, axis in enumerate("xyz")}
    wanted = about[order[0]] * about[order[1]] * about[order[2]]  # each about an axis of the turned body
    found = Rotation.from_quat(flight.streams["vicon"]["attitude"][:, [1, 2, 3, 0]])
    assert (wanted.inv() * found).magnitude().max() < 1e-12
    assert not [n for n in flight.notes if n.startswith("assumed")]


@pytest.mark.parametrize("order", ["rows", "columns"])
def test_attitudes_may_be_matrices(tmp_path, order):
    wanted = Rotation.random(12, rng=np.random.default_rng(2))
    matrices = wanted.as_matrix() if order == "rows" else wanted.as_matrix().transpose(0, 2, 1)
    given = {"vicon.matrix": "4,5,6,7,8,9,10,11,12", "vicon.matrix.order": order}
    flight = turned(tmp_path, matrices, given, matrices.reshape(12, 9))
    found = Rotation.from_quat(flight.streams["vicon"]["attitude"][:, [1, 2, 3, 0]])
    assert (wanted.inv() * found).magnitude().max() < 1e-12
    columns = matrices.reshape(12, 9).copy()
    columns[7] = 0.0  # the body was lost
    with pytest.raises(DataError, match="line 8[\\s\\S]*vicon.lost=absent"):
        turned(tmp_path, matrices, given, columns)
    assert len(turned(tmp_path, matrices, {**given, "vicon.lost": "absent"}, columns).streams["vicon"]) == 11
    matrices[4, 0] *= -1.0
    with pytest.raises(DataError, match="line 5: a matrix is no rotation"):
        turned(tmp_path, matrices, given, matrices.reshape(12, 9))


def test_angles_without_a_unit_are_said_and_gaps_stay(tmp_path):
    columns = np.array([[0.1, 0.2, 0.3], [np.nan, 0.2, 0.3], [0.2, 0.3, 0.4]])
    flight = turned(tmp_path, columns, {"vicon.angles": "4,5,6"}, columns)
    assert len(flight.streams["vicon"]) == 2
    assert "assumed: vicon.angles are in rad; vicon.angles.unit says it" in flight.notes
    assert any("turned in the order zyx" in n for n in flight.notes)


def test_a_wrong_number_of_columns_names_the_setting_that_fits(tmp_path):
    for mapping, fix in (("4,5,6", "vicon.angles=4,5,6"), ("1,2,3,4,5,6,7,8,9", "vicon.matrix=")):
        with pytest.raises(DeclarationError) as caught:
            turned(tmp_path, np.ones((2, 3)), {"vicon.attitude": mapping}, np.ones((2, 9)))
        assert fix in str(caught.value)
    with pytest.raises(DeclarationError, match="vicon has its attitude twice"):
        turned(
            tmp_path, np.ones((2, 3)), {"vicon.attitude": "4,5,6,7", "vicon.angles": "4,5,6"}, np.ones((2, 4))
        )


@pytest.mark.parametrize(
    ("cells", "unit", "wanted"),
    [
        (["1403636579.758560001"], "s", [1403636579758560001]),
        (["1403636579758560001"], "ns", [1403636579758560001]),
        (["1403636579758560.001"], "us", [1403636579758560001]),
        (["1.5", "3"], "ms", [1_500_000, 3_000_000]),
        (["0.5"], "min", [30_000_000_000]),
        (["1"], "h", [3_600_000_000_000]),
        (["19000.5"], "day", [1641643200000000000]),
        (["2014-05-13T16:53:20.123456789Z"], "s", [1400000000123456789]),
        (["2014-05-13 16:53:20,123456789"], "s", [1400000000123456789]),
        (["2014-05-13T18:53:20.5+02:00"], "s", [1400000000500000000]),
        (["2014-05-13T11:53:20.6-0500"], "s", [1400000000600000000]),
        (["20140513T165320.25Z"], "s", [1400000000250000000]),
        (["2014/05/13 16:53:20"], "s", [1400000000 * 10**9]),
        (["13-May-2014 16:53:20"], "s", [1400000000 * 10**9]),
        (["0 days 00:00:01.000000005", "1 days 00:00:00"], "s", [1_000_000_005, 86400 * 10**9]),
        (["-1 days +23:59:59", "00:01:00.5"], "s", [-(10**9), 60_500_000_000]),
    ],
)  # fmt: skip
def test_stamps_of_all_kinds_are_exact(cells, unit, wanted):
    found, _ = stamps(cells, lambda k: f"row {k}", unit=unit)
    assert found.tolist() == wanted


@pytest.mark.parametrize(
    ("cells", "part"),
    [
        (["2014-02-30T00:00:00Z"], "not a time"),
        (["2014-05-13T16:53:60Z"], "not a time"),
        (["3000-01-01T00:00:00Z"], "64 bits"),
        (["2014-05-13T16:53:20Z", "2014-05-13T16:53:21"], "two kinds"),
        (["2014-05-13T16:53:20Z", "00:00:01"], "two kinds"),
        (["1400000000123456789"], "time.unit=ns"),
        (["1400000000123"], "time.unit=ms"),
        (["1", "soon"], "row 1"),
        (["1_0"], "not a time"),
    ],
)
def test_what_is_no_stamp_is_refused(cells, part):
    with pytest.raises(DataError) as caught:
        stamps(cells, lambda k: f"row {k}", unit="s")
    assert part in str(caught.value)


def test_a_date_without_a_zone_is_said_to_be_utc(tmp_path):
    rows = [["2014-05-13 16:53:20.123456789", *ROWS[0][1:]], ["2014-05-13 16:53:20.128456789", *ROWS[1][1:]]]
    flight = load(tmp_path, text(rows), time__unit="")
    assert flight.streams["imu"].time.tolist() == [START, START + 5_000_000]
    assert "assumed: log.csv: stamps name no zone, and are taken for UTC" in flight.notes


def test_an_index_of_dates_is_a_clock(tmp_path):
    rows = [[f"2014-05-13 16:53:20.{123456789 + 5_000_000 * k}", *row[1:]] for k, row in enumerate(ROWS)]
    flight = load(tmp_path, text(rows, head="," + ",".join(NAMES[1:])), time__unit="")
    same(flight)
    assert "assumed: log.csv: the first column, without a name, is the time" in flight.notes


def test_a_column_that_is_named_by_a_number(tmp_path):
    head = "t,1,2,3,4,5,6"
    given = {"imu__gyro": "1,2,3", "imu__specific_force": "4,5,6"}
    same(load(tmp_path, text(head=head), **given))  # names and numbers agree
    with pytest.raises(DataError, match="'1' is ambiguous"):
        load(tmp_path, text(head="t,3,1,2,4,5,6"), **given)


@pytest.mark.parametrize("between", [",", "\t", ", "])
def test_trajectories_and_sequences_are_read_in_dialects_too(tmp_path, between):
    pose = ["1403636579.758560001", "1.5", "2", "3", "0", "0", "0", "1"]
    (tmp_path / "a.tum").write_text(between.join(pose) + "\n")
    vicon = tum.load(str(tmp_path / "a.tum")).streams["vicon"]
    assert vicon.time.tolist() == [1403636579758560001]
    assert vicon["position"].tolist() == [[1.5, 2, 3]]
    names = between.join(["timestamp", "p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w"])
    (tmp_path / "a.tum").write_text(f"{names}\n{between.join(pose)}\n", encoding="utf-16")
    assert tum.load(str(tmp_path / "a.tum")).streams["vicon"].time.tolist() == [1403636579758560001]


def test_a_sequence_with_decimal_commas_is_read(tmp_path):
    (tmp_path / "imu0").mkdir()
    (tmp_path / "imu0" / "sensor.yaml").write_text(
        "rate_hz: 200\ngyroscope_noise_density: 1e-4\ngyroscope_random_walk: 1e-5\n"
        "accelerometer_noise_density: 2e-3\naccelerometer_random_walk: 3e-3\n"
    )
    (tmp_path / "imu0" / "data.csv").write_text(comma())
    flight = euroc.load(str(tmp_path))
    same(flight)
    assert any("decimal comma" in n for n in flight.notes)
