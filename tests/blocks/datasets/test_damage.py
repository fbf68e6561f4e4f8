"""Files that are small and mean much: aliases, bombs, pipes, and parts that a library would fall over."""

from __future__ import annotations

import os
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_array

from flowgraph import DataError, load_flight
from flowgraph.blocks.datasets import euroc
from flowgraph.blocks.datasets.matfile import read_mat, read_structs
from flowgraph.blocks.datasets.parameters import parse_parameters
from flowgraph.blocks.vision.tags import TagMap
from tests.blocks.datasets import test_datasets, test_euroc

LAUGHS = "a: &a [x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}]\n"
    for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.parametrize(
    "text",
    [
        LAUGHS + "rate_hz: *j",
        "rate_hz: 2001-99-99",
        "rate_hz: " + "[" * 20_000,
        "rate_hz: " + "9" * 5000,
        "rate_hz: " + "9" * 400,
        "? [a, b]\n: 1",
        "rate_hz: !!python/object/apply:os.system ['true']",
        "\x00",
        "rate_hz: 200\n" + "#" * 2**20,
    ],
)
def test_a_sensor_description_that_is_none_is_named_at_once(tmp_path, text):
    (tmp_path / "imu0").mkdir()
    (tmp_path / "imu0" / "data.csv").write_text(test_euroc.IMU)
    (tmp_path / "imu0" / "sensor.yaml").write_text(text)
    start = time.process_time()
    with pytest.raises(DataError) as caught:
        euroc.load(str(tmp_path))
    assert time.process_time() - start < 10.0
    assert "sensor.yaml" in str(caught.value)
    assert len(str(caught.value)) < 2000


def compressed(file: Path, inside: bytes) -> Path:
    """A .mat file of version 5 with one compressed variable."""
    part = zlib.compress(inside)
    file.write_bytes(b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(part)) + part)
    return file


def test_a_small_mat_file_that_holds_much_is_refused_before_it_is_read(tmp_path):
    file = tmp_path / "a.mat"
    savemat(file, {"x": np.zeros((5000, 5000))}, do_compression=True)
    assert file.stat().st_size < 400_000
    for read in (lambda: read_structs(file, "x"), lambda: read_mat(file, {"x": (None, None)})):
        with pytest.raises(DataError, match="hold far more than the file is long"):
            read()
    savemat(file, {"x": np.zeros((1000, 1000))}, do_compression=True)
    assert read_mat(file, {"x": (None, None)})["x"].shape == (1000, 1000)


@pytest.mark.parametrize("kind", [0, 8, 10, 11, 15, 19, 200, 65535])
@pytest.mark.parametrize("packed", [False, True])
def test_a_part_of_no_kind_does_not_end_the_process(tmp_path, kind, packed):
    file = tmp_path / "a.mat"
    savemat(file, {"x": np.arange(30.0)})
    content = bytearray(file.read_bytes())
    at = content.rindex(struct.pack("<II", 9, 240))
    content[at : at + 4] = struct.pack("<I", kind)
    if packed:
        compressed(file, bytes(content[128:]))
    else:
        file.write_bytes(content)
    with pytest.raises(DataError, match=f"a part of kind {kind if kind < 65536 else ''}"):
        read_structs(file, "x")


def test_cells_structs_and_texts_of_either_writing_are_read(tmp_path):
    cell = np.empty(3, dtype=object)
    cell[:] = [np.arange(3.0), "text", np.zeros((0, 0))]
    part = {"a": 1.0, "b": np.zeros((0, 0))}
    for compression in (False, True):
        held = {"c": cell, "z": 1j, "b": True, "i": np.int8(3), "s": part}
        savemat(tmp_path / "a.mat", held, do_compression=compression)
        found = read_structs(tmp_path / "a.mat", *held)
        assert found["c"][1] == "text"
        assert found["s"]["a"] == 1.0
    savemat(tmp_path / "a.mat", {"x": np.arange(3.0)}, format="4")
    assert read_mat(tmp_path / "a.mat", {"x": (None,)})["x"].tolist() == [0.0, 1.0, 2.0]


def test_pipes_in_place_of_files_are_refused_at_once(tmp_path):
    for name in ("a.csv", "a.mat", "a.bag", "tags.json", "parameters.txt"):
        os.mkfifo(tmp_path / name)
    for spec in ("csv:{}/a.csv", "tum:{}/a.csv", "broad:{}/a.mat", "studentdata:{}/a.mat"):
        with pytest.raises(DataError):
            load_flight(spec.format(tmp_path), settings=test_datasets.MAP if "csv:" in spec else {})
    with pytest.raises(DataError, match="no regular file"):
        TagMap.load(tmp_path / "tags.json")
    with pytest.raises(DataError, match="no regular file"):
        parse_parameters(tmp_path / "parameters.txt")


def flags_changed(file: Path, change: int) -> None:
    """The flags of the first array, which stand behind the head, the variable's tag and their own."""
    content = bytearray(file.read_bytes())
    (flags,) = struct.unpack_from("<I", content, 144)
    struct.pack_into("<I", content, 144, flags ^ change)
    file.write_bytes(content)


@pytest.mark.parametrize(
    ("held", "change"),
    [
        pytest.param(np.arange(30.0), 1 << 11, id="a complex array without its second part"),
        pytest.param(np.arange(30.0), 6 ^ 1, id="numbers as cells"),
        pytest.param(np.arange(30.0), 6 ^ 2, id="numbers as a struct"),
        pytest.param(np.arange(30.0), 6 ^ 5, id="numbers as a sparse array"),
        pytest.param(np.arange(30.0), 6 ^ 17, id="numbers as an object"),
        pytest.param({"a": 1.0}, 2 ^ 6, id="a struct as numbers"),
        pytest.param(csc_array(np.eye(3)), 1 << 11, id="a complex sparse array without its last part"),
    ],
)
def test_an_array_without_the_parts_of_its_class_is_refused_before_it_is_read(tmp_path, held, change):
    """SciPy would read on behind the array, where a wrong kind of part ends the process."""
    file = tmp_path / "a.mat"
    savemat(file, {"x": held, "y": np.arange(3.0)})
    read_structs(file, "x", "y")
    flags_changed(file, change)
    with pytest.raises(DataError, match="this is no whole .mat file"):
        read_structs(file, "x", "y")


def test_thousands_of_digits_take_no_time(tmp_path):
    file = tmp_path / "parameters.txt"
    text = "1" * 20_000 + " side 0.2 m\n" + "[" * 20_000
    start = time.process_time()
    file.write_text(text)
    parse_parameters(file)
    file.write_text("yaw = " + "9" * 20_000 + "\n" + text)
    with pytest.raises(DataError, match="the mount is malformed"):
        parse_parameters(file)
    assert time.process_time() - start < 10.0


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("x"), IndexError("y"), RecursionError("z"), MemoryError()]
)
def test_whatever_a_library_says_against_a_recording_is_our_error(tmp_path, monkeypatch, error):
    def fails(*_: object, **__: object) -> None:
        raise error

    spec = test_datasets.table(tmp_path)
    monkeypatch.setattr("flowgraph.blocks.datasets.csv_file.known", fails)
    with pytest.raises(DataError) as caught:
        load_flight(spec, settings=test_datasets.MAP)
    assert type(error).__name__ in str(caught.value)
    assert spec in str(caught.value)
    assert caught.value.__cause__ is error
