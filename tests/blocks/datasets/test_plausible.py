"""What comes in is plausible, or is said: one check for all loaders, by kinds of what is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowgraph import Flight, Series, load_flight
from flowgraph.blocks.datasets.ranges import upright
from flowgraph.blocks.datasets.shape import Recording
from flowgraph.blocks.datasets.stamps import as_nanoseconds, check_clock, in_order, likely_unit, stretch
from flowgraph.blocks.signals import GeodeticPosition, Imu, Pose, Position
from flowgraph.data.notes import WORDS
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

MS = 1_000_000
START = 1_400_000_000_123_456_789
COLUMNS = ("wx,wy,wz", "ax,ay,az", "x,y,z", "qw,qx,qy,qz")
MAPPED = {
    "time.unit": "ns",
    "imu.gyro": COLUMNS[0],
    "imu.specific_force": COLUMNS[1],
    "vicon.position": COLUMNS[2],
    "vicon.attitude": COLUMNS[3],
}


def rows(n: int = 60, start: int = START, step: int = 20 * MS) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,), and numbers (n, 13) of a unit that turns about z and moves a little."""
    rng = np.random.default_rng(n)
    time = start + step * np.arange(n)
    x = np.zeros((n, 13))
    x[:, :3] = [0.0, 0.0, 0.5] + 0.01 * rng.normal(size=(n, 3))
    x[:, 3:6] = [0.0, 0.0, 9.81] + 0.05 * rng.normal(size=(n, 3))
    x[:, 6:9] = 0.01 * rng.normal(size=(n, 3)) + 0.1 * np.arange(n)[:, None] * 0.02
    x[:, 9:] = Rotation.from_rotvec(np.outer(0.5 * 0.02 * np.arange(n), [0, 0, 1])).as_quat()[:, [3, 0, 1, 2]]
    return time, x


def csv(folder: Path, time: Any, x: np.ndarray) -> str:
    """A table of both, as csv:FILE."""
    lines = ["t," + ",".join(COLUMNS)]
    lines += [
        f"{t}," + ",".join("" if np.isnan(v) else f"{v:.12g}" for v in r)
        for t, r in zip(time, x, strict=True)
    ]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    return f"csv:{folder / 'log.csv'}"


def euroc(folder: Path, time: np.ndarray, x: np.ndarray, sensor: str = "", truth: str = "") -> Path:
    """A sequence with imu0 and vicon0."""
    mav = folder / "seq" / "mav0"
    for name, part in (("imu0", x[:, :6]), ("vicon0", x[:, 6:])):
        (mav / name).mkdir(parents=True, exist_ok=True)
        text = "\n".join(f"{t}," + ",".join(f"{v:.12g}" for v in r) for t, r in zip(time, part, strict=True))
        (mav / name / "data.csv").write_text("#t\n" + text + "\n")
    if sensor:
        (mav / "imu0" / "sensor.yaml").write_text(sensor)
    if truth:
        (mav / "state_groundtruth_estimate0").mkdir()
        (mav / "state_groundtruth_estimate0" / "data.csv").write_text(truth)
    return folder / "seq"


def refused(spec: str, *parts: str, kind: type = DataError, **settings: Any) -> str:
    """The message with which a flight is refused, which has all parts; settings have __ for a dot."""
    given = {name.replace("__", "."): value for name, value in settings.items()}
    with pytest.raises(kind) as caught:
        load_flight(spec, settings={**(MAPPED if spec.startswith("csv:") else {}), **given})
    for part in (*parts, "expected:", "got:", "fix:"):
        assert part in str(caught.value)
    return str(caught.value)


def said(flight: Flight, *parts: str) -> str:
    """The one note with these parts."""
    (found,) = [n for n in flight.notes if all(p in n for p in parts)]
    assert found.partition(":")[0] in WORDS
    return found


# -- stamps --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda t: [0, *t[1:]], ["line 2: the first stamp lies 44.4 years before", "not yet set"]),
        (lambda t: [*t[:-1], t[-1] + 7200 * 10**9], ["line 61: the last stamp lies 2 h after"]),
        (lambda t: [*(k * 20 * MS for k in range(4)), *t[4:]], ["line 2: 4 stamps lie 44.4 years before"]),
        (
            lambda t: [*t[:30], *(k + 86400 * 10**9 for k in t[30:])],
            ["lie 1 days", "steps as the others, 20 ms"],
        ),
    ],
)
def test_a_step_that_cannot_be_is_named_by_its_row(tmp_path, change, parts):
    time, x = rows()
    refused(csv(tmp_path, change(time.tolist()), x), *parts)


def test_a_few_stamps_that_lie_apart_are_left_out_where_that_is_asked_for(tmp_path):
    time, x = rows()
    spec = csv(tmp_path, [0, *time[1:]], x)
    assert "bad_time=drop" in refused(spec)
    flight = load_flight(spec, settings={**MAPPED, "bad_time": "drop"})
    assert flight.streams["imu"].time[0] == time[1]
    said(flight, "skipped: imu", "line 2", "44.4 years")
    half = csv(tmp_path, [*(k * 20 * MS for k in range(30)), *time[30:]], x)
    assert "bad_time=drop" not in refused(half, bad_time="drop")


@pytest.mark.parametrize(
    ("unit", "size", "likely"),
    [("s", 10**6, "ms"), ("ns", 10**6, "ms"), ("s", 10**3, "us"), ("us", 10**9, "s")],
)
def test_a_unit_of_time_that_cannot_be_is_named(tmp_path, unit, size, likely):
    time, x = rows(start=0)
    spec = csv(tmp_path, [f"{t / size:.9f}" for t in time], x)
    assert f"time.unit={likely}" in refused(spec, "median step", time__unit=unit)
    assert len(load_flight(spec, settings={**MAPPED, "time.unit": likely}).streams["imu"]) == 60


def test_an_index_is_no_clock(tmp_path):
    _, x = rows()
    refused(csv(tmp_path, range(60), x), "line 2: these stamps are an index, not a clock", time__unit="s")
    refused(csv(tmp_path, range(1, 61), x), "these stamps are an index", time__unit="s")
    refused(csv(tmp_path, range(60), x), "no such sensor's clock", "median step of 1 ns")


@pytest.mark.parametrize("stamp", ["4100000000", "-3000000"])
def test_a_time_of_no_recording_is_refused(tmp_path, stamp):
    _, x = rows()
    time = [int(stamp) + 0.01 * k for k in range(60)]
    refused(csv(tmp_path, time, x), "between 1970 and 2096", time__unit="s")


def test_the_other_streams_have_wider_limits_and_few_rows_none():
    row = lambda k: f"row {k}"
    slow = np.arange(5) * 60 * 10**9
    assert check_clock("gps", row, slow, inertial=False, unit=None, drop=False, fix="")[1] is None
    with pytest.raises(DataError, match="no such sensor's clock"):
        check_clock("imu", row, slow, inertial=True, unit=None, drop=False, fix="look")
    for few in (slow[:0], slow[:1], slow[:2]):
        assert check_clock("imu", row, few, inertial=True, unit=None, drop=False, fix="")[1] is None


# -- order, and remedies that cost too much ------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (lambda t: [1.4e9] * len(t), "nearly all stamps are equal"),
        (lambda t: np.repeat(t[::4], 4), "many stamps are equal"),
        (lambda t: np.float32(t / 1e9).astype(float), "nearly all stamps are equal"),
    ],
)
@pytest.mark.parametrize("bad_time", ["raise", "drop", "sort"])
def test_equal_stamps_are_no_matter_of_order(tmp_path, stamps, words, bad_time):
    time, x = rows()
    found = stamps(time)
    unit = "ns" if max(found) > 1e12 else "s"
    message = refused(
        csv(tmp_path, [repr(v) for v in np.asarray(found).tolist()], x),
        words,
        "digits",
        bad_time=bad_time,
        time__unit=unit,
    )
    assert "bad_time" not in message


def test_one_stamp_in_the_future_costs_one_row(tmp_path):
    time, x = rows()
    late = time.copy()
    late[10] += 3600 * 10**9
    spec = csv(tmp_path, late, x)
    message = refused(spec, "line 12", "ahead of the next")
    assert "bad_time=drop leaves such rows out" in message
    flight = load_flight(spec, settings={**MAPPED, "bad_time": "drop"})
    assert flight.streams["imu"].time.tolist() == np.delete(time, 10).tolist()
    said(flight, "skipped: imu: 1 rows out of order left out")


@pytest.mark.parametrize(
    ("back", "what"),
    [
        (2**32 * 10**3, "32-bit counter of microseconds"),
        (3600 * 10**9, "set back by an hour"),
        (604_800 * 10**9, "time of the week"),
    ],
)
def test_a_clock_that_begins_anew_is_named_and_nothing_is_dropped_for_it(tmp_path, back, what):
    time, x = rows()
    message = refused(csv(tmp_path, [*time[:40], *(time[40:] - back)], x), "line 42", what)
    assert "bad_time" not in message


def test_what_would_lose_most_of_a_recording_is_not_offered():
    row = lambda k: f"row {k}"
    shuffled = np.random.default_rng(0).permutation(100) * MS
    for policy in ("raise", "drop"):
        with pytest.raises(DataError) as caught:
            in_order("imu", row, shuffled, np.arange(100), policy)
        assert "bad_time=drop" not in str(caught.value)
    with pytest.raises(DataError, match="too little of this recording"):
        in_order("imu", row, shuffled, np.arange(100), "drop")
    time, kept, notes = in_order("imu", row, np.array([0, 2, 1, 3]), np.arange(4), "sort")
    assert (time.tolist(), kept.tolist()) == ([0, 1, 2, 3], [0, 2, 1, 3])
    assert notes == ["info: imu: sorted, 1 rows were out of order"]


def test_stamps_and_lengths_of_time_in_words():
    assert as_nanoseconds("1.5", "ms") == 1_500_000
    assert as_nanoseconds("1400000000123456789", "ns") == START
    with pytest.raises(ValueError, match=r"below 9\.2e9 s"):
        as_nanoseconds("1e300", "s")
    assert [likely_unit(t) for t in ("1400000000123456789", "1.4e15", "1.4e12", "5", "x")] == [
        "ns", "us", "ms", None, None,
    ]  # fmt: skip
    assert [stretch(t) for t in (5, 20 * MS, -7200 * 10**9, 1.4e18)] == ["5 ns", "20 ms", "2 h", "44.4 years"]


@pytest.mark.parametrize(("unit", "size"), [("ns", 1), ("us", 10**3), ("ms", 10**6)])
def test_a_trajectory_has_a_unit_of_time(tmp_path, unit, size):
    time, x = rows()
    time = time // MS * MS
    table = [
        f"{t / size if size > 1 else t} 1 {v:.6f} 3 0 0 0 1"
        for t, v in zip(time.tolist(), x[:, 6], strict=True)
    ]
    (tmp_path / "t.txt").write_text("\n".join(table).replace(".0 ", " "))
    spec = f"tum:{tmp_path / 't.txt'}"
    assert f"time.unit={unit}" in refused(spec, "line 1", "the stamp is not a time", "look like")
    assert load_flight(spec, settings={"time.unit": unit}).streams["vicon"].time.tolist() == time.tolist()


# -- streams of different times ------------------------------------------------------------------------


def two(first: int, second: int, n: int = 50, **given: Any) -> Recording:
    """A recording of an imu from `first` and positions from `second`."""
    time, x = rows(n, start=0)
    made = Recording("two", kind="test", given={k.replace("__", "."): v for k, v in given.items()})
    made.add("imu", "a", time + first, {"gyro": x[:, :3], "specific_force": x[:, 3:6]}, Imu)
    made.add("leica", "b", time + second, {"position": x[:, 6:9]}, Position)
    return made


@pytest.mark.parametrize(("first", "second"), [(START, 5 * 10**9), (0, START), (0, 10**9), (10**10, 0)])
def test_streams_that_do_not_meet_are_refused(first, second):
    with pytest.raises(DataError) as caught:
        two(first, second).flight()
    assert "no sample of leica lies within the span of the imu" in str(caught.value)
    assert " apart" in str(caught.value)


def test_the_shift_that_brings_streams_together_is_said_and_does_so():
    with pytest.raises(DataError, match=r"leica\.time_offset=-5 if they began together"):
        two(0, 5 * 10**9).flight()
    flight = two(0, 5 * 10**9, leica__time_offset="-5").flight()
    assert flight.streams["leica"].time[0] == 0
    said(flight, "info: leica: stamps shifted by -5000000000 ns")
    with pytest.raises(DataError, match=r"check leica\.time_offset and imu\.time_offset"):
        two(0, 5 * 10**9, leica__time_offset="-3").flight()


def test_a_truth_of_another_day_is_refused_and_little_overlap_is_said(tmp_path):
    time, x = rows()
    made = two(START, START)
    pose = {"position": x[:, 6:9], "attitude": x[:, 9:]}
    made.add("truth", "c", time + 86400 * 10**9, pose, Pose)
    with pytest.raises(DataError, match="no sample of truth lies within the span of the imu"):
        made.flight()
    said(two(0, 800 * MS, n=50).flight(), "warning: leica: only 10 of 50 samples")


def test_a_clock_that_is_off_as_a_whole_is_said():
    flight = two(0, 18 * 10**9, n=2000).flight()
    assert "leica.time_offset=-18" in said(flight, "warning: leica starts and ends 18 s later than imu")
    assert two(0, 100 * MS, n=2000).flight().notes == ()


# -- ranges and units ----------------------------------------------------------------------------------


def fixes(latitude: Any, longitude: Any, height: Any = 400.0) -> Recording:
    made = Recording("gps", kind="csv", units="say {stream}.{field}.unit={unit}")
    n = len(np.atleast_1d(latitude))
    columns = {
        "latitude": np.atleast_1d(np.asarray(latitude, float)),
        "longitude": np.broadcast_to(np.asarray(longitude, float), n),
        "height": np.broadcast_to(np.asarray(height, float), n),
    }
    made.add("gps", "g", np.arange(n) * 10**9, columns, GeodeticPosition)
    return made


@pytest.mark.parametrize(
    ("latitude", "longitude", "parts"),
    [
        (47.3977, 8.5456, ["no latitude is 47.3977 rad", "as degrees", "say gps.latitude.unit=deg"]),
        (0.8, 8.5456, ["no longitude is 8.5456 rad", "gps.longitude.unit=deg"]),
        (473977000.0, 85456000.0, ["no latitude", "as 1e-7 degrees"]),
        (np.radians(147.0), np.radians(-35.0), ["(147 deg)", "exchanged"]),
    ],
)
def test_geodetic_positions_stay_in_their_range(latitude, longitude, parts):
    with pytest.raises(DataError) as caught:
        fixes(latitude, longitude)
    for part in parts:
        assert part in str(caught.value)


def test_geodetic_positions_that_hardly_can_be_are_said():
    good = np.radians(47.0 + 1e-5 * np.arange(6))
    none = fixes([*good[:2], 0.0], [0.1, 0.1, 0.0])
    assert len(none.streams["gps"]) == 2
    assert any("skipped: gps: 1 of 3 rows at 0, 0 hold no fix" in n for n in none.notes)
    around = fixes(good, np.radians(352.0))
    np.testing.assert_allclose(around.streams["gps"]["longitude"], np.radians(-8.0))
    assert any("info: gps: 6 longitudes" in n for n in around.notes)
    assert any("radians taken for degrees" in n for n in fixes(np.radians(0.8), np.radians(0.15)).notes)
    assert any("warning: gps: heights of 4e+05 m" in n for n in fixes(good, 0.1, 4e5).notes)
    coarse = np.radians(np.float32(47.0 + 1e-4 * np.arange(6)).astype(float))
    assert any("latitude holds single precision, steps of 0.42 m" in n for n in fixes(coarse, 0.1).notes)
    assert fixes(good, 0.1).notes == []


@pytest.mark.parametrize(
    ("scale", "parts"),
    [
        ((1.0, 1 / 9.81), ["imu.specific_force", "not in the unit", "median length of 1", "m/s^2"]),
        ((1000.0, 1.0), ["imu.gyro", "not in the unit", "rad/s"]),
        ((1.0, 0.01), ["imu.specific_force", "gravity was taken out"]),
    ],
)
def test_units_of_euroc_and_csv_are_checked_alike(tmp_path, scale, parts):
    time, x = rows()
    x[:, :3] *= scale[0]
    x[:, 3:6] *= scale[1]
    refused(f"euroc:{euroc(tmp_path, time, x)}", *parts)
    assert "imu." in refused(csv(tmp_path, time, x), *parts, ".unit=")


def test_values_that_hardly_can_be_are_said(tmp_path):
    time, x = rows()
    doubled = x.copy()
    doubled[:, 3:6] *= 2.0
    said(
        load_flight(csv(tmp_path, time, doubled), settings=MAPPED),
        "warning: imu: the median specific force is 19",
    )
    millimetres = x.copy()
    millimetres[:, 6:9] *= 1000.0
    said(load_flight(csv(tmp_path, time, millimetres), settings=MAPPED), "warning: vicon", "metres?")
    far = x.copy()
    far[:, 6] += 5.2e6
    said(
        load_flight(csv(tmp_path, time, far), settings=MAPPED),
        "single precision has steps of 500 mm; take an origin",
    )
    far[:, 6:9] = far[:, 6:9].astype(np.float32)
    said(load_flight(csv(tmp_path, time, far), settings=MAPPED), "steps of 500 mm, and hold no more")
    assert not [
        n for n in load_flight(csv(tmp_path, time, x), settings=MAPPED).notes if n.startswith("warning")
    ]


@pytest.mark.parametrize("wrong", ["order", "sign", "degrees"])
def test_attitudes_are_held_against_the_imu(tmp_path, wrong):
    time, x = rows(400)
    x[:, 9:] = (
        Rotation.from_quat(x[:, [10, 11, 12, 9]]) * Rotation.from_euler("x", 20, degrees=True)
    ).as_quat()[:, [3, 0, 1, 2]]
    turns = Rotation.from_quat(x[:, [10, 11, 12, 9]])
    x[:, 3:6] = turns.inv().apply([0.0, 0.0, 9.81])
    x[:, :3] = turns.inv().apply([0.0, 0.0, 0.5])
    given = dict(MAPPED)
    if wrong == "order":
        x[:, 9:] = x[:, [10, 11, 12, 9]]
    if wrong == "sign":
        x[:, 3:6] *= -1.0
    if wrong == "degrees":
        x[:, :3] *= 180.0 / np.pi
    words = {"order": "not upwards", "sign": "not upwards", "degrees": "in deg/s?"}[wrong]
    assert words in said(load_flight(csv(tmp_path, time, x), settings=given), "warning: ")
    few = Series(time[:5], Pose(position=x[:5, 6:9], attitude=x[:5, 9:]), name="vicon")
    imu = Series(time, Imu(gyro=x[:, :3], specific_force=x[:, 3:6]), name="imu")
    assert upright(imu, few, "vicon") == []


# -- rows of a lost body -------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["csv", "euroc", "tum"])
def test_a_lost_body_is_refused_by_the_line_and_left_out_if_asked_for(tmp_path, source):
    time, x = rows()
    x[25:30, 6:] = 0.0
    if source == "csv":
        spec, line, given = csv(tmp_path, time, x), "log.csv, line 27", MAPPED
    elif source == "euroc":
        spec, line, given = f"euroc:{euroc(tmp_path, time, x)}", "vicon0/data.csv, line 27", {}
    else:
        text = [
            f"{t / 1e9:.3f} " + " ".join(map(str, r))
            for t, r in zip(time, x[:, [6, 7, 8, 10, 11, 12, 9]], strict=True)
        ]
        (tmp_path / "t.txt").write_text("# t\n" + "\n".join(text))
        spec, line, given = f"tum:{tmp_path / 't.txt'}", "t.txt, line 27", {}
    message = refused(spec, line, "not a unit quaternion", "5 of 60 rows")
    assert "vicon.lost=absent" in message
    flight = load_flight(spec, settings={**given, "vicon.lost": "absent"})
    assert len(flight.streams["vicon"]) == 55
    assert flight.info["absent"] == {"vicon": 5}
    assert "5 of 60 rows of a lost body left out as absent" in said(flight, "skipped: vicon", line)


def test_a_lost_truth_is_masked_and_a_prism_that_reads_zeros_is_said():
    time, x = rows()
    x[25:30, 6:] = 0.0
    made = Recording("a", kind="test", given={"truth.lost": "absent"})
    pose = {"position": x[:, 6:9], "attitude": x[:, 9:]}
    made.add("truth", "a", time, pose, Pose)
    assert made.truth is not None
    assert np.flatnonzero(np.isnan(made.truth["position"]).any(axis=1)).tolist() == list(range(25, 30))
    assert made.info["absent"] == {"truth": 5}
    made.add("leica", "b", time, {"position": x[:, 6:9]}, Position)
    assert any(
        "warning: leica: 5 of 60 positions are exactly 0, 0, 0; leica.lost=absent" in n for n in made.notes
    )


def test_a_pose_that_stands_still_is_said_and_can_be_left_out():
    time, x = rows()
    x[20:31, 6:] = x[20, 6:]
    pose = {"position": x[:, 6:9], "attitude": x[:, 9:]}
    made = Recording("a", kind="test")
    made.add("vicon", "a", time, pose, Pose)
    assert made.notes == [
        "warning: vicon: 10 rows repeat the one before, from a, row 22 on; "
        "vicon.lost=repeated leaves such rows out"
    ]
    made = Recording("a", kind="test", given={"vicon.lost": "repeated"})
    assert len(made.add("vicon", "a", time, pose, Pose)) == 50
    with pytest.raises(UnknownNameError, match="absent, raise, repeated"):
        Recording("a", kind="test", given={"vicon.lost": "never"}).add("vicon", "a", time, pose, Pose)


# -- settings of every stream --------------------------------------------------------------------------


@pytest.mark.parametrize("stream", ["imu", "vicon"])
def test_every_stream_of_a_table_has_an_offset(tmp_path, stream):
    time, x = rows()
    given = {**MAPPED, f"{stream}.time_offset": "-0.12"}
    flight = load_flight(csv(tmp_path, time, x), settings=given)
    assert (flight.streams[stream].time - time).tolist() == [-120_000_000] * 60
    said(flight, f"info: {stream}: stamps shifted by -120000000 ns")
    other = "vicon" if stream == "imu" else "imu"
    assert flight.streams[other].time.tolist() == time.tolist()
    refused(
        csv(tmp_path, time, x), "is not usable", kind=DeclarationError, **{f"{stream}__time_offset": "later"}
    )


def test_a_stream_is_thinned_turned_and_placed(tmp_path):
    time, x = rows()
    given = {**MAPPED, "vicon.every": "0.1", "imu.mount": "0,0,90", "vicon.lever": "0.1,0,0.05"}
    flight = load_flight(csv(tmp_path, time, x), settings=given)
    assert flight.streams["vicon"].time.tolist() == time[::5].tolist()
    assert flight.info["vicon_lever"] == (0.1, 0.0, 0.05)
    np.testing.assert_allclose(flight.streams["imu"]["gyro"], x[:, [1, 0, 2]] * [-1, 1, 1], atol=1e-10)
    said(flight, "info: vicon: thinned to one in 0.1 s: 48 of 60 rows left out")
    turned = load_flight(csv(tmp_path, time, x), settings={**MAPPED, "vicon.mount": "0,0,90"})
    found = Rotation.from_quat(turned.streams["vicon"]["attitude"][:, [1, 2, 3, 0]])
    true = Rotation.from_quat(x[:, [10, 11, 12, 9]]) * Rotation.from_euler("z", -90, degrees=True)
    assert (found.inv() * true).magnitude().max() < 1e-9
    refused(csv(tmp_path, time, x), "three numbers", kind=DeclarationError, imu__mount="0,0")
    refused(csv(tmp_path, time, x), "has nothing to act on", kind=DeclarationError, imu__lever="0,0,1")


def test_a_truth_of_another_point_is_moved_to_the_body():
    time, x = rows()
    made = Recording("a", kind="test", given={"truth.lever": "0.5,0,0"})
    pose = {"position": x[:, 6:9], "attitude": x[:, 9:]}
    found = made.add("truth", "a", time, pose, Pose)
    away = Rotation.from_quat(x[:, [10, 11, 12, 9]]).apply([0.5, 0.0, 0.0])
    np.testing.assert_allclose(found["position"], x[:, 6:9] - away, atol=1e-12)


def test_a_setting_of_a_stream_that_is_not_there_is_said(tmp_path):
    time, x = rows()
    flight = load_flight(csv(tmp_path, time, x), settings={**MAPPED, "leica.time_offset": "1"})
    said(flight, "skipped: leica.time_offset: this flight has no leica")


# -- relatives of EuRoC --------------------------------------------------------------------------------

TURNED = "T_BS: {data: [0, -1, 0, 0.1, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n"
DENSITIES = "".join(
    f"{n}: {v}\n"
    for n, v in {
        "gyroscope_noise_density": 1e-3,
        "gyroscope_random_walk": 2e-5,
        "accelerometer_noise_density": 1e-2,
        "accelerometer_random_walk": 3e-4,
    }.items()
)


def test_readings_of_a_turned_unit_are_turned_into_the_body(tmp_path):
    time, x = rows()
    flight = load_flight(f"euroc:{euroc(tmp_path, time, x, TURNED + DENSITIES + 'rate_hz: 50')}")
    imu = flight.streams["imu"]
    np.testing.assert_allclose(imu["gyro"], x[:, [1, 0, 2]] * [-1, 1, 1], atol=1e-10)
    np.testing.assert_allclose(imu["specific_force"], x[:, [4, 3, 5]] * [-1, 1, 1], atol=1e-10)
    said(flight, "info: imu: readings turned into the body's axes by T_BS of imu0")
    said(flight, "info: imu: sits at (0.1, 0, 0) m in the body")
    assert flight.info["vicon_lever"] == (-0.1, 0.0, 0.0)


@pytest.mark.parametrize(
    "data",
    [
        "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]",
        "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.1, 0, 0, 1]",
        "[[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
    ],
)
def test_a_mount_that_is_no_rigid_transform_is_refused(tmp_path, data):
    time, x = rows()
    folder = euroc(tmp_path, time, x, f"T_BS: {{data: {data}}}\nrate_hz: 50\n" + DENSITIES)
    refused(f"euroc:{folder}", "T_BS is missing or malformed", "imu0/sensor.yaml")


def test_a_sequence_without_a_sensor_file_has_settings(tmp_path):
    time, x = rows()
    spec = f"euroc:{euroc(tmp_path, time, x)}"
    flight = load_flight(spec, settings={"gyro.noise": "1e-3", "position.noise": "0.02"})
    assert flight.info["imu_noise"].gyro == 1e-3
    assert flight.info["position_noise"] == 0.02
    assert flight.info["imu_period_ns"] == 20 * MS
    assert "accelerometer.noise=0.002" in said(flight, "assumed: imu: noise of a typical unit")


def test_the_files_of_other_recorders_are_read(tmp_path):
    time, x = rows()
    folder = euroc(tmp_path, time, x)
    mav = folder / "mav0"
    (mav / "vicon0").rename(mav / "mocap0")
    last = "\n".join(
        f"{t}," + ",".join(f"{v:.12g}" for v in r[[6, 7, 8, 10, 11, 12, 9]])
        for t, r in zip(time, x, strict=True)
    )
    (mav / "mocap0" / "data.csv").write_text(
        "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_x [],q_y [],q_z [],q_w []\n" + last
    )
    (folder / "imu.yaml").write_text(
        "imu0:\n  update_rate: 100\n" + "".join(f"  {n}\n" for n in DENSITIES.splitlines())
    )
    (mav / "cam0").mkdir()
    (mav / "cam0" / "data.csv").write_text("#t\n")
    flight = load_flight(f"euroc:{folder}", settings={"gyro.walk": "1e-6"})
    np.testing.assert_allclose(flight.streams["vicon"]["attitude"], x[:, 9:], atol=1e-10)
    assert flight.info["imu_noise"].accelerometer == 1e-2
    assert flight.info["imu_noise"].gyro_bias == 1e-6
    said(flight, "warning: imu: imu.yaml says 100 Hz, and its stamps come at 50 Hz")
    said(flight, "assumed: mocap0 is the stream vicon")
    said(flight, "skipped: cam0: not read")
    said(flight, "info: imu: gyro.walk as set")
    (mav / "imu0" / "data.csv").rename(mav / "imu0.csv")
    (mav / "imu0").rmdir()
    assert len(load_flight(f"euroc:{folder}").streams["imu"]) == 60


@pytest.mark.parametrize(
    ("width", "fields"), [(3, {"position"}), (7, {"position", "attitude"}), (10, {"position", "attitude"})]
)
def test_truths_of_fewer_columns_are_read(tmp_path, width, fields):
    time, x = rows()
    x = np.concatenate([x[:, 6:], np.zeros((60, 3))], axis=1)
    text = "#t\n" + "\n".join(
        f"{t}," + ",".join(f"{v:.12g}" for v in r[:width]) for t, r in zip(time, x, strict=True)
    )
    flight = load_flight(f"euroc:{euroc(tmp_path, time, rows()[1], truth=text)}")
    assert flight.truth is not None
    assert set(flight.truth.leaves) == fields
    said(flight, "info: truth:", f"{width + 1} columns")


def test_a_truth_of_no_known_width_is_refused(tmp_path):
    time, x = rows()
    text = "#t\n" + "\n".join(f"{t},1,2,3,4,5" for t in time)
    refused(f"euroc:{euroc(tmp_path, time, x, truth=text)}", "wrong number of columns", "8 (poses)", "6:")


# -- notes ---------------------------------------------------------------------------------------------


def test_a_flight_has_notes_that_begin_with_their_word():
    with pytest.raises(DeclarationError, match="begins with the word of its kind"):
        Flight("a", {}, notes=("something was left out",))
    assert Flight("a", {}, notes=("info: a", "info: a", "skipped: b")).notes == ("info: a", "skipped: b")


@pytest.mark.parametrize("spec", ["sim", "sim:hover", "sim:plane", "course"])
def test_simulated_flights_say_that_they_are(spec):
    settings = {"duration": "1"} if spec in ("course", "sim:hover") else {}
    notes = load_flight(spec, settings=settings).notes
    assert notes[0].startswith("info: simulated with seed 0")


@pytest.mark.parametrize(("stream", "columns", "every"), [("imu", slice(6), 5), ("vicon", slice(6, 13), 3)])
def test_rows_of_a_table_that_hold_nothing_of_a_stream_are_counted(tmp_path, stream, columns, every):
    time, x = rows()
    x[1::every, columns] = np.nan
    lost = len(time[1::every])
    flight = load_flight(csv(tmp_path, time, x), settings=MAPPED)
    assert len(flight.streams[stream]) == 60 - lost
    assert f"skipped: {stream}: {lost} of 60 rows of log.csv hold nothing of it" in flight.notes
    assert not [n for n in flight.notes if "hold nothing" in n and f": {stream}:" not in n]


@pytest.mark.parametrize("unit", [None, "rad", "deg"])
def test_the_unit_of_a_latitude_that_nobody_says_is_said(tmp_path, unit):
    lines = ["t,lat,lon,h", *(f"{k / 10},{0.8 + 1e-9 * k:.12f},0.1,400" for k in range(30))]
    (tmp_path / "gps.csv").write_text("\n".join(lines) + "\n")
    given = {"gps.latitude": "lat", "gps.longitude": "lon", "gps.height": "h"}
    if unit:
        given |= {"gps.latitude.unit": unit, "gps.longitude.unit": unit}
    said = [n for n in load_flight(f"csv:{tmp_path / 'gps.csv'}", settings=given).notes if "is in rad" in n]
    assert len(said) == (0 if unit else 2)
    assert unit or said[0] == "assumed: gps.latitude is in rad; gps.latitude.unit says it"


@pytest.mark.parametrize(
    ("start", "step", "said"), [(0, 1, True), (1, 1, True), (0, 2, False), (7, 1, False)]
)
def test_poses_by_their_index_are_said(tmp_path, start, step, said):
    lines = [f"{start + step * k} {k / 100} 0 0 0 0 0 1" for k in range(20)]
    (tmp_path / "a.tum").write_text("\n".join(lines) + "\n")
    notes = load_flight(f"tum:{tmp_path / 'a.tum'}").notes
    assert any("as an index of rows is" in n for n in notes) == said
