"""Files that are whole or not there, and that are read within bounds."""

from __future__ import annotations

import io
import os
import stat
import subprocess
import sys
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from flowgraph import OutputError
from flowgraph.data.files import arrays_of, claimed, content_of, need_place, put, put_new, text_of, whole


def test_a_block_that_fails_leaves_what_was_there_and_nothing_else(tmp_path):
    file = put(tmp_path / "a.txt", "old")

    def fails() -> None:
        with whole(file) as stream:
            stream.write(b"half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert file.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("name", ["a.npz", "n" * 250, "é" * 120, ".hidden", "a b;$(x)"])
def test_a_part_that_a_killed_process_left_is_taken_over(tmp_path, name):
    code = (
        "import os, signal, sys\nfrom flowgraph.data.files import whole\n"
        "with whole(sys.argv[1]) as f:\n"
        " f.write(b'half' * 1000); f.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    file = put(tmp_path / name, "old")
    assert subprocess.run([sys.executable, "-c", code, str(file)], check=False).returncode == -9
    assert file.read_text() == "old"
    assert len(os.listdir(tmp_path)) == 2
    put(file, "new")
    assert file.read_text() == "new"
    assert os.listdir(tmp_path) == [name]


def test_writers_of_one_file_take_turns_and_each_is_whole(tmp_path):
    code = (
        "import sys\nfrom pathlib import Path\nfrom flowgraph.data.files import put\n"
        "while not Path(sys.argv[3]).exists(): put(sys.argv[1], sys.argv[2] * 200_000, lasting=False)"
    )
    (tmp_path / "out").mkdir()
    file, enough = tmp_path / "out" / "a", tmp_path / "enough"
    writers = [subprocess.Popen([sys.executable, "-c", code, str(file), c, str(enough)]) for c in "abc"]
    try:
        seen: set[str] = set()
        while seen < set("abc"):
            assert all(w.poll() is None for w in writers)
            if file.exists():
                text = file.read_text()
                assert len(text) == 200_000
                assert len(set(text)) == 1
                seen.add(text[0])
            time.sleep(0.002)
    finally:
        enough.touch()
        ended = [w.wait() for w in writers]
    assert ended == [0, 0, 0]
    assert os.listdir(file.parent) == ["a"]


def test_links_are_followed_and_rights_kept(tmp_path):
    (tmp_path / "real").mkdir()
    real = put(tmp_path / "real" / "a", "old")
    real.chmod(0o640)
    (tmp_path / "link").symlink_to(real)
    put(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert real.read_text() == "new"
    assert stat.S_IMODE(real.stat().st_mode) == 0o640


def test_what_is_no_regular_file_is_written_to_as_it_is(tmp_path):
    put("/dev/null", "text")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


@pytest.mark.parametrize("kind", ["folder", "no folder", "a file as folder", "a zero byte"])
def test_where_nothing_can_be_written_the_error_is_ours(tmp_path, kind):
    (tmp_path / "file").write_text("x")
    (tmp_path / "d").mkdir()
    places = {"folder": "d", "no folder": "x/y", "a file as folder": "file/y", "a zero byte": "x\0y"}
    place = places[kind]
    with pytest.raises(OutputError) as caught:
        put(tmp_path / place, "text")
    assert caught.value.path == str(tmp_path / place)
    assert sorted(os.listdir(tmp_path)) == ["d", "file"]


def test_a_place_is_refused_before_anything_is_written_there(tmp_path):
    (tmp_path / "d").mkdir()
    for place in ("d", "x/y", "x\0y"):
        with pytest.raises(OutputError, match="this cannot be written"):
            need_place(tmp_path / place)
    assert need_place(tmp_path / "d" / "new") == (tmp_path / "d" / "new").resolve()
    assert sorted(os.listdir(tmp_path)) == ["d"]


def test_a_full_disk_leaves_what_was_there(tmp_path):
    code = (
        "import resource, sys\nfrom flowgraph import OutputError\nfrom flowgraph.data.files import put\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: put(sys.argv[1], 'x' * 5000)\nexcept OutputError as e: print(e)"
    )
    file = put(tmp_path / "a", "old")
    done = subprocess.run(
        [sys.executable, "-c", code, str(file)], check=True, capture_output=True, text=True
    ).stdout
    assert "this cannot be written" in done
    assert file.read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]


def test_somebody_elses_file_is_not_written_over_and_nothing_is_half_done(tmp_path):
    put_new(tmp_path, {"a": "1", "b": "2"}, what="thing")
    put_new(tmp_path, {"a": "1", "b": "2"}, what="thing")
    for other in (b"3", b"\xff\xfe", b""):
        (tmp_path / "b").write_bytes(other)
        (tmp_path / "a").unlink()
        with pytest.raises(OutputError, match="another file is already here"):
            put_new(tmp_path, {"a": "1", "b": "2"}, what="thing")
        assert (tmp_path / "b").read_bytes() == other
        assert not (tmp_path / "a").exists()
        put(tmp_path / "a", "1")
    (tmp_path / "b").unlink()
    (tmp_path / "b").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputError, match="another file is already here"):
        put_new(tmp_path, {"b": "2"}, what="thing")


def test_a_claim_is_for_one_and_says_whose_and_ends_with_its_process(tmp_path):
    file = tmp_path / "a.lock"
    with claimed(file, by="me") as first:
        assert first is None
        with claimed(file, by="you") as second:
            assert second == "me"
        assert file.exists()
    assert not file.exists()
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom flowgraph.data.files import claimed\n"
        "with claimed(Path(sys.argv[1]), by='dead'): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(file)], check=False)
    assert file.read_text() == "dead"
    with claimed(file, by="me") as third:
        assert third is None
    assert os.listdir(tmp_path) == []


def test_pipes_and_devices_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(OSError, match=r"no regular file|Is a directory"):
            content_of(file)
    big = tmp_path / "big"
    big.write_bytes(bytes(1000))
    with pytest.raises(OSError, match="1000 bytes, which is more than 999"):
        content_of(big, most=999)
    big.write_bytes(b"\xef\xbb\xbf\xc3\xa9")
    assert text_of(big) == "é"


def archive(file: Path, content: bytes, kind: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(file, "w", kind) as made:
        made.writestr("a.npy", content)
    return file


def header(shape: str, dtype: str = "'<f8'") -> bytes:
    text = f"{{'descr': {dtype}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def test_arrays_are_read_to_the_bit(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array(7, np.uint64), "c": np.array([True, False])}
    arrays["d"] = np.asfortranarray(np.arange(12).reshape(3, 4))
    np.savez(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    found = arrays_of(tmp_path / "a.npz")
    assert {n: (a.dtype, a.shape, a.tolist()) for n, a in found.items()} == {
        n: (a.dtype, a.shape, a.tolist()) for n, a in arrays.items()
    }


@pytest.mark.parametrize(
    "content",
    [
        header("(10000000000,)"),
        header("(-1,)") + bytes(8),
        header("(2**9,)"),
        header("(2,)") + bytes(8),
        header("(1,)", "'|O'") + bytes(8),
        header("(" * 90 + ")" * 90),
        b"\x93NUMPY\x09\x00",
        b"",
    ],
)
def test_an_array_that_is_not_what_it_says_is_refused(tmp_path, content):
    with pytest.raises(ValueError, match=r".+"):
        arrays_of(archive(tmp_path / "a.npz", content))


def test_a_small_file_that_holds_gigabytes_is_refused_before_they_are_made(tmp_path):
    made = io.BytesIO(header("(40000000,)"))
    file = archive(tmp_path / "a.npz", made.getvalue() + bytes(320_000_000), zipfile.ZIP_DEFLATED)
    tracemalloc.start()  # not the most of the process: that was when the file was made
    try:
        with pytest.raises(ValueError, match="its arrays take 320"):
            arrays_of(file)
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()
    with pytest.raises(ValueError, match="over 1000"):
        arrays_of(file, most=1000)
