"""MCAP, Parquet, csv and Rerun, each read back by its own reader: the numbers, the times and the schemas."""

from __future__ import annotations

import json
import sys
import time

import jsonschema
import numpy as np
import pytest

from flowgraph import (
    Array,
    DataError,
    DeclarationError,
    MissingDependencyError,
    Result,
    Series,
    Signal,
    UnknownNameError,
    find_graph,
    integer,
    load_flight,
    real,
    simulate,
)
from flowgraph.blocks.signals import Attitude, GnssFix, Imu, Pose, Position
from flowgraph.data.export.forms import forms_of
from flowgraph.data.export.mcap_file import write_mcap
from flowgraph.data.export.rerun_file import write_rerun
from flowgraph.data.export.tables import write_parquet

START = 1_700_000_000_123_456_789


class Odd(Signal):
    time: Array = real(unit="s")
    mode: Array = integer()


class Nested(Signal):
    pose: Pose
    weight: Array = real()


@pytest.fixture(scope="module")
def flown():
    flight = load_flight("sim", seed=2, settings={"duration": "2"})
    case = find_graph("ins_eskf").case(flight, settle=0.0)
    return flight, simulate(case.graph, case.inputs)


@pytest.fixture
def mixed():
    """Streams of many kinds, with dates as times, one late and one in part not finite."""
    rng = np.random.default_rng(0)
    times = START + np.arange(5) * 100_000_000
    turn = rng.normal(size=(5, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    place = rng.normal(size=(5, 3))
    gap = place.copy()
    gap[2, 1] = np.nan
    gps = GnssFix(
        latitude=np.full(5, 0.8),
        longitude=np.linspace(0.1, 0.2, 5),
        height=np.arange(5.0),
        covariance=np.tile(np.diag([4.0, 4.0, 9.0]), (5, 1, 1)),
    )
    return {
        "pose": Series(times, Pose(position=place, attitude=turn), name="pose"),
        "point": Series(times, Position(position=gap), name="point"),
        "turn": Series(times, Attitude(attitude=turn), name="turn"),
        "flight.gps": Series(times, gps, name="gps", stamp=times - 50_000_000),
        "imu": Series(times, Imu(gyro=place, specific_force=gap), name="imu"),
        "odd": Series(times, Odd(time=np.arange(5.0), mode=np.arange(5, dtype=np.int32)), name="odd"),
        "nested": Series(times, Nested(pose=Pose(position=place, attitude=turn), weight=np.ones(5))),
        "alone": Series(times, np.arange(5.0), name="alone"),
    }


# -- MCAP ------------------------------------------------------------------------------------------------


def messages(file):
    """Of each topic: its schema, and (log time, publish time, message) in the order of the file."""
    reader = pytest.importorskip("mcap.reader", reason="needs the extra mcap")
    found: dict = {}
    schemas: dict = {}
    with open(file, "rb") as stream:
        for schema, channel, message in reader.make_reader(stream).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            schemas[channel.topic] = (schema.name, json.loads(schema.data))
            row = (message.log_time, message.publish_time, json.loads(message.data))
            if channel.topic not in found:
                jsonschema.validate(row[2], schemas[channel.topic][1])
            found.setdefault(channel.topic, []).append(row)
    return found, schemas


def nanoseconds(stamp):
    return stamp["sec"] * 10**9 + stamp["nsec"]


def test_a_run_is_read_back_from_mcap_with_the_standard_schemas(flown, tmp_path):
    flight, result = flown
    file = tmp_path / "run.mcap"
    assert result.to_mcap(file, also={"truth": flight.truth}) == ()
    found, schemas = messages(file)
    belief = result.belief
    for topic, name in {
        "/belief/pose": "foxglove.PoseInFrame",
        "/truth/pose": "foxglove.PoseInFrame",
        "/tf": "foxglove.FrameTransform",
        "/belief": "flowgraph.Belief",
    }.items():
        assert schemas[topic][0] == schemas[topic][1]["title"] == name
    poses = found["/belief/pose"]
    assert [log for log, _, _ in poses] == belief.time.tolist()
    assert [nanoseconds(m["timestamp"]) for _, _, m in poses] == belief.time.tolist()
    read = np.array(
        [[*m["pose"]["position"].values(), *m["pose"]["orientation"].values()] for *_, m in poses]
    )
    names = [*poses[0][2]["pose"]["orientation"]]
    np.testing.assert_array_equal(read[:, :3], belief.position)
    np.testing.assert_array_equal(read[:, 3:][:, [names.index(n) for n in "wxyz"]], belief.attitude)
    assert {m["frame_id"] for *_, m in poses} == {"world"}
    children = {m["child_frame_id"] for *_, m in found["/tf"]}
    assert children == {"belief", "truth"}
    np.testing.assert_array_equal([m["covariance"] for *_, m in found["/belief"]], belief.covariance)
    assert schemas["/belief"][1]["properties"]["position"]["description"] == "m, world"
    assert len(found["/position_innovation"]) == len(result.position_innovation)


@pytest.mark.parametrize("shape", [(), (2,), (3, 3)])
def test_a_stream_without_values_is_a_topic_without_messages(shape, tmp_path):
    reader = pytest.importorskip("mcap.reader", reason="needs the extra mcap")
    write_mcap(
        {"none": Series([], np.zeros((0, *shape))), "one": Series([5], np.ones((1, *shape)))}, tmp_path / "a"
    )
    with open(tmp_path / "a", "rb") as stream:
        found = [channel.topic for _, channel, _ in reader.make_reader(stream).iter_messages()]
        stream.seek(0)
        topics = {c.topic for c in reader.make_reader(stream).get_summary().channels.values()}
    assert found == ["/one"]
    assert topics == {"/none", "/one"}


def test_what_is_said_of_a_run_is_in_the_mcap(flown, tmp_path):
    reader = pytest.importorskip("mcap.reader", reason="needs the extra mcap")
    flown[1].to_mcap(tmp_path / "a.mcap")
    with open(tmp_path / "a.mcap", "rb") as stream:
        opened = reader.make_reader(stream)
        (about,) = opened.iter_metadata()
        logged = [message.log_time for _, _, message in opened.iter_messages(log_time_order=False)]
    assert about.metadata["graph"] == "ins_eskf"
    assert about.metadata["ticks"] == str(flown[1].ticks)
    assert logged == sorted(logged)


def test_fixes_points_and_turns_each_have_their_schema_and_are_true_when_they_were(mixed, tmp_path):
    pytest.importorskip("mcap", reason="needs the extra mcap")
    notes = write_mcap(mixed, tmp_path / "a.mcap")
    assert notes == ("skipped: 1 of 5 rows of point have no place: not finite",)
    found, schemas = messages(tmp_path / "a.mcap")
    assert schemas["/point/point"][0] == "foxglove.Point3InFrame"
    assert schemas["/flight/gps/fix"][0] == "foxglove.LocationFix"
    assert len(found["/point/point"]) == 4
    assert "/turn/pose" not in found
    assert [m["translation"] for *_, m in found["/tf"] if m["child_frame_id"] == "turn"] == [
        {"x": 0.0, "y": 0.0, "z": 0.0}
    ] * 5
    for row, (log, publish, fix) in enumerate(found["/flight/gps/fix"]):
        assert log == START + row * 100_000_000
        assert publish == nanoseconds(fix["timestamp"]) == log - 50_000_000
        assert fix["latitude"] == pytest.approx(np.degrees(0.8), abs=1e-12)
        assert fix["position_covariance"] == [4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0]
        assert fix["position_covariance_type"] == 3
    assert "specific_force" not in found["/imu"][2][2]
    assert found["/imu"][2][2]["gyro"] == mixed["imu"]["gyro"][2].tolist()
    assert found["/nested"][1][2]["pose"]["attitude"] == mixed["turn"]["attitude"][1].tolist()
    assert found["/odd"][3][2]["mode"] == 3


def test_mcap_refuses_times_before_zero(tmp_path):
    pytest.importorskip("mcap", reason="needs the extra mcap")
    early = Series(np.array([-5, 0]), np.zeros(2))
    with pytest.raises(DataError, match=r"MCAP has no times before 0(.|\n)*-5 ns(.|\n)*time_offset"):
        write_mcap({"x": early}, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


# -- tables ----------------------------------------------------------------------------------------------


def test_pandas_reads_the_parquet_of_a_run(flown, tmp_path):
    pandas = pytest.importorskip("pandas", reason="needs the extra pandas")
    pytest.importorskip("pyarrow", reason="needs the extra parquet")
    _, result = flown
    files = result.to_parquet(tmp_path / "new")
    assert set(files) == set(result.series)
    frame = pandas.read_parquet(files["belief"]).set_index("time")
    pandas.testing.assert_frame_equal(frame, result.belief.to_pandas())
    assert frame["position.x"].tolist() == result.belief.position[:, 0].tolist()


def test_columns_say_their_units_and_late_values_their_stamps(mixed, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra parquet")
    files = write_parquet(mixed, tmp_path, about={"graph": "g"})
    table = parquet.read_table(files["flight.gps"])
    assert table.column_names[:3] == ["time", "stamp", "latitude"]
    assert table.schema.field("latitude").metadata == {b"unit": b"rad", b"frame": b"WGS84"}
    assert table.schema.metadata[b"graph"] == b"g"
    assert table["stamp"].to_pylist() == mixed["flight.gps"].stamp.tolist()
    assert parquet.read_table(files["odd"]).column_names == ["time", "time_", "mode"]
    assert parquet.read_table(files["nested"]).column_names[1] == "pose.position.x"


def test_a_row_is_a_time_however_many_numbers_it_has():
    pytest.importorskip("pandas", reason="needs the extra pandas")
    n = 200_000

    class Wide(Signal):
        place: Array = real(3)
        spread: Array = real(3, 3)

    wide = Series(np.arange(n), Wide(place=np.zeros((n, 3)), spread=np.ones((n, 3, 3))))
    before = time.process_time()
    frame = Result("g", "python", {"x": wide}, {}, {}, n, 0.0).to_pandas()["x"]
    assert frame.shape == (n, 12)
    assert time.process_time() - before < 1.0  # by way of 27 rows a tick it takes many


def test_the_csv_of_a_run_is_read_as_a_flight(flown, tmp_path):
    _, result = flown
    result.to_csv(tmp_path / "a.csv")
    read = load_flight(f"table:{tmp_path / 'a.csv'}")
    np.testing.assert_array_equal(read.streams["belief"].time, result.belief.time)
    np.testing.assert_array_equal(read.streams["belief"]["attitude"], result.belief.attitude)


# -- Rerun -----------------------------------------------------------------------------------------------


def chunks(file):
    """The columns of a recording by entity, and those that have no time."""
    reader = pytest.importorskip("rerun.chunk", reason="needs the extra rerun")
    timed: dict = {}
    static: dict = {}
    for chunk in reader.RrdReader(str(file)).stream().to_chunks():
        batch = chunk.to_record_batch()
        into = static if chunk.is_static else timed
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            into.setdefault(str(chunk.entity_path), {}).setdefault(name, []).extend(column.to_pylist())
    return timed, static


def test_rerun_reads_back_what_was_written(flown, tmp_path):
    pytest.importorskip("rerun", reason="needs the extra rerun")
    _, result = flown
    assert result.to_rerun(tmp_path / "run.rrd") == ()
    timed, static = chunks(tmp_path / "run.rrd")
    pose, belief = timed["/world/belief"], result.belief
    np.testing.assert_allclose(np.squeeze(pose["Transform3D:translation"]), belief.position, rtol=1e-6)
    np.testing.assert_allclose(
        np.squeeze(pose["Transform3D:quaternion"])[:, [3, 0, 1, 2]], belief.attitude, atol=1e-6
    )
    field = timed["/fields/belief/covariance"]
    assert np.array_equal(field["Scalars:scalars"], belief.covariance.reshape(len(belief), -1))
    stamps = np.array([np.timedelta64(t, "ns").astype(np.int64) for t in field["time"]])
    np.testing.assert_array_equal(stamps, belief.time)
    assert static["/fields/belief/position"]["SeriesLines:names"][0] == [
        "position.x",
        "position.y",
        "position.z",
    ]
    (way,) = static["/paths/belief"]["LineStrips3D:strips"][0]
    np.testing.assert_allclose(way, belief.position, rtol=1e-6)
    assert "graph: ins_eskf" in static["/about"]["TextDocument:text"][0][0]


def test_rerun_has_fixes_on_the_earth_and_dates(mixed, tmp_path):
    pytest.importorskip("rerun", reason="needs the extra rerun")
    notes = write_rerun(mixed, tmp_path / "a.rrd")
    assert notes == ("skipped: 1 of 5 rows of point are not drawn: not finite",)
    timed, _ = chunks(tmp_path / "a.rrd")
    fixes = timed["/earth/flight/gps"]
    assert fixes["GeoPoints:positions"][0][0] == pytest.approx([np.degrees(0.8), np.degrees(0.1)])
    assert len(timed["/world/point"]["Points3D:positions"]) == 4
    assert str(fixes["time"][0]).startswith("2023-11-14")


# -- what can go wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("package", "extra", "method"),
    [
        ("mcap.writer", "mcap", "to_mcap"),
        ("rerun", "rerun", "to_rerun"),
        ("pyarrow", "parquet", "to_parquet"),
    ],
)
def test_without_its_package_a_way_out_says_what_to_install(
    flown, monkeypatch, tmp_path, package, extra, method
):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingDependencyError, match=rf"flowgraph-filters\[{extra}\]"):
        getattr(flown[1], method)(tmp_path / "a")


def test_two_series_of_one_name_are_refused(flown, tmp_path):
    with pytest.raises(DeclarationError, match=r"ins_eskf: belief: two series are called the same"):
        flown[1].to_csv(tmp_path / "a.csv", also={"belief": flown[0].truth})


def test_a_form_that_is_none_is_refused_with_those_there_are():
    with pytest.raises(UnknownNameError, match=r"no form of export is called 'mcp'(.|\n)*mcap"):
        forms_of("csv,mcp")


def test_outputs_are_completed(flown):
    assert {"belief", "position_innovation", "to_mcap"} <= set(dir(flown[1]))
