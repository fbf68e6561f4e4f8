"""Bags in every container, told apart by what is in them; what is damaged is our error."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from flowgraph.blocks.datasets import rosbag
from flowgraph.errors import DataError, FlowgraphError
from tests.blocks.datasets.bags import MS, Pen, refused

pytest.importorskip("rosbags", reason="needs the extra ros")


def poses(path: Path, first: int = 0, version: int = 2, storage: str = "sqlite3") -> Path:
    """A bag of five poses."""
    with Pen(path, version, storage) as pen:
        for k in range(first, first + 5):
            pen.pose("/pose", 10**9 + k * MS, [k, 2, 3])
    return path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("name", ["flight{}", "FLIGHT{}", "flight.log", "folder/"])
def test_a_file_of_ros_2_needs_no_metadata(tmp_path, storage, name):
    inside = next(f for f in poses(tmp_path / "bag", storage=storage).iterdir() if f.suffix != ".yaml")
    ending = inside.suffix.upper() if name.isupper() else inside.suffix
    if name == "folder/":
        target = tmp_path / "folder"
        target.mkdir()
        shutil.copy(inside, target / inside.name)
    else:
        target = tmp_path / name.format(ending)
        shutil.copy(inside, target)
    flight = rosbag.load(str(target))
    assert flight.streams["vicon"]["position"][:, 0].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("name", ["flight.bag", "FLIGHT.BAG", "flight", "flight.bag.orig"])
def test_a_file_of_ros_1_may_have_any_name(tmp_path, name):
    poses(tmp_path / "x.bag", version=1).rename(tmp_path / name)
    assert len(rosbag.load(str(tmp_path / name)).streams["vicon"]) == 5


@pytest.mark.parametrize("version", [1, 2])
def test_the_files_of_a_folder_are_one_recording_and_a_note_says_so(tmp_path, version):
    folder = tmp_path / "split"
    folder.mkdir()
    for part in (0, 1):
        made = poses(tmp_path / f"p_{part}.bag", 5 * part, version)
        file = made if version == 1 else next(made.glob("*.db3"))
        shutil.copy(file, folder / f"p_{part}{file.suffix}")
    flight = rosbag.load(str(folder))
    assert flight.streams["vicon"]["position"][:, 0].tolist() == list(range(10))
    assert any(
        n.startswith("assumed: ") and f"p_0.{'bag' if version == 1 else 'db3'}" in n for n in flight.notes
    )


def test_files_of_both_versions_are_no_bag(tmp_path):
    folder = tmp_path / "both"
    folder.mkdir()
    poses(folder / "a.bag", version=1)
    shutil.copy(next(poses(tmp_path / "b").glob("*.db3")), folder / "b.db3")
    refused(folder, "this is no bag", "files of ROS 1 and of ROS 2: a.bag, b.db3")


@pytest.mark.parametrize("name", ["a.mcap.zst", "notes.txt"])
def test_what_is_no_bag_is_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"\x28\xb5\x2f\xfd 1234")
    refused(tmp_path / name, "this is no bag", name, ".mcap, .db3", "unpacked")


def test_a_message_of_another_definition_is_refused(tmp_path):
    from rosbags.typesys import get_types_from_msg

    with Pen(tmp_path / "own.bag", version=1) as pen:
        kind = "geometry_msgs/msg/PointStamped"
        pen.store = type(pen.store)()
        pen.store.register(get_types_from_msg("float64 x\nfloat64 y", kind))
        pen.put("/p", kind, 5, pen.make(kind, 1.0, 2.0))
    refused(tmp_path / "own.bag", "own.bag: /p", "not as ROS defines them", "digest")


@pytest.mark.parametrize("storage", ["bag", "mcap", "sqlite3"])
def test_damage_ends_in_our_error_or_a_flight(tmp_path, storage):
    version = 1 if storage == "bag" else 2
    made = poses(tmp_path / "x.bag", version=version, storage=storage if version == 2 else "sqlite3")
    whole_file = made if version == 1 else next(f for f in made.iterdir() if f.suffix != ".yaml")
    whole, rng = whole_file.read_bytes(), np.random.default_rng(3)
    file, said = tmp_path / f"y{whole_file.suffix}", []
    for _ in range(150):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 20)):
            data[at] = rng.integers(256)
        file.write_bytes(bytes(data[: rng.integers(1, len(data))] if rng.random() < 0.3 else data))
        try:
            rosbag.load(str(file))
        except FlowgraphError as error:
            said.append(str(error))
    assert len(said) > 10
    assert all(str(file) in text for text in said)


def test_a_message_that_cannot_be_decoded_names_its_topic(tmp_path):
    with Pen(tmp_path / "b") as pen:
        pen.pose("/pose", 5, [1, 2, 3])
        pen.writer.write(next(iter(pen.connections.values())), 6, b"\x00\x01\x00\x00cut")
    with pytest.raises(DataError, match=r"/pose: this bag cannot be read"):
        rosbag.load(str(tmp_path / "b"))
