"""The compile cache: what is broken in it is made again, and where it cannot be, the error is ours."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flowgraph import MissingDependencyError, OutputError
from flowgraph.data.files import lock
from flowgraph.engines.c import compile as compiling
from flowgraph.engines.c.compile import FLAGS, CompileError, build, cache_folder, load

TEXT = {"a.c": "int f(void) { return 3; }\n"}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path / "cache"))
    compiling._say.cache_clear()
    return tmp_path / "cache"


def program(folder: Path, text: str) -> str:
    file = folder / "cc"
    file.write_text(f"#!/bin/sh\n{text}\n")
    file.chmod(0o755)
    return str(file)


@pytest.mark.parametrize("damage", ["cut", "empty", "no mark", "a byte", "another", "text", "unreadable"])
def test_a_library_that_is_not_whole_is_made_again(cache, damage):
    library = build(TEXT)
    whole = library.read_bytes()
    other = build({"a.c": "int g(void) { return 4; }\n"}).read_bytes()
    library.unlink()
    library.write_bytes(
        {
            "cut": whole[: len(whole) // 3],
            "empty": b"",
            "no mark": whole[:-80],
            "a byte": whole[:3000] + bytes([whole[3000] ^ 1]) + whole[3001:],
            "another": other[:-70] + whole[-70:],
            "text": b"int f;",
            "unreadable": whole[:100],
        }[damage]
    )
    done = subprocess.run(
        [sys.executable, "-c", f"from flowgraph.engines.c.compile import load; print(load({TEXT!r}).f())"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "3\n"), done.stderr
    assert library.read_bytes() == whole


def test_a_whole_file_that_is_no_library_is_made_again(cache):
    import hashlib

    library = build(TEXT)
    content = b"not a library"
    library.write_bytes(content + compiling._MARK + hashlib.sha256(content).hexdigest().encode())
    assert load(TEXT).f() == 3


def test_another_compiler_than_gcc_gets_no_flags_of_gcc(cache, tmp_path, monkeypatch):
    """What says nothing of the Free Software Foundation has its third level instead."""
    seen = tmp_path / "seen"
    says = 'test "$1" = --version && exec echo clang version 14\n'
    monkeypatch.setenv("CC", program(tmp_path, f'{says}echo "$@" > {seen}; exec cc "$@"'))
    build(TEXT)
    words = seen.read_text().split()
    assert "-O3" in words
    assert not {"-O1", "-fstore-merging", "-ftree-vrp"} & set(words)
    monkeypatch.delenv("CC")
    assert "-O3" not in FLAGS
    assert build(TEXT)


def test_the_name_is_of_the_text_the_flags_and_the_compiler(cache, tmp_path, monkeypatch):
    names = {build(TEXT).name, build(TEXT, ("-O0",)).name, build({"a.c": TEXT["a.c"] + "\n"}).name}
    monkeypatch.setenv("CC", program(tmp_path, 'test "$1" = --version && echo mine; exec cc "$@"'))
    names.add(build(TEXT).name)
    monkeypatch.setenv("CC", "cc -O0")
    names.add(build(TEXT).name)
    assert len(names) == 5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("exit 0", "made nothing"),
        (": > made.so", "made nothing"),
        ("echo text > made.so", "cannot be loaded"),
        ("kill -9 $$", "signal 9"),
        ("echo 'x: error: no' >&2; exit 1", "x: error: no"),
        ("printf '\\377\\376 error: bytes' >&2; exit 3", "error: bytes"),
        ("exit 4", "exit status 4"),
    ],
)
def test_a_compiler_that_fails_is_our_error_and_leaves_nothing(cache, tmp_path, monkeypatch, text, said):
    monkeypatch.setenv("CC", program(tmp_path, f'test "$1" = --version && exit 0\n{text}'))
    monkeypatch.chdir(tmp_path)  # where it is asked about itself
    with pytest.raises(CompileError) as caught:
        load(TEXT)
    assert said in str(caught.value)
    assert caught.value.fix
    assert list(cache.iterdir()) == []


def test_a_compiler_may_be_named_from_the_folder_one_is_in(cache, tmp_path, monkeypatch):
    program(tmp_path, 'exec cc "$@"')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CC", "./cc")
    assert load(TEXT).f() == 3


def test_a_compiler_that_cannot_be_started_or_is_not_there(cache, tmp_path, monkeypatch):
    broken = tmp_path / "cc"
    broken.write_bytes(b"\x7fELF nothing")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(CompileError, match="cannot be started"):
        build(TEXT)
    monkeypatch.setenv("CC", "no-such-compiler 'x")
    with pytest.raises(MissingDependencyError, match="needs a C compiler"):
        build(TEXT)


def test_a_full_disk_is_said(cache, tmp_path, monkeypatch):
    text = 'test "$1" = --version && exit 0\necho "as: made.o: No space left on device" >&2; exit 1'
    monkeypatch.setenv("CC", program(tmp_path, text))
    with pytest.raises(OutputError, match="the disk is full"):
        build(TEXT)


@pytest.mark.parametrize("place", ["a folder", "a file", "below a file"])
def test_something_in_its_place_is_our_error_where_the_place_was_asked_for(cache, place, monkeypatch):
    if place == "a folder":
        library = build(TEXT)
        library.unlink()
        (library / "x").mkdir(parents=True)
    elif place == "a file":
        cache.write_text("x")
    else:
        cache.write_text("x")
        monkeypatch.setenv("FLOWGRAPH_CACHE", str(cache / "in"))
    with pytest.raises(OutputError):
        build(TEXT)


@pytest.mark.parametrize("home", ["a file in it", "empty", "relative", "none"])
def test_without_a_usable_home_another_place_is_taken_and_said(home, tmp_path, monkeypatch):
    for name in ("FLOWGRAPH_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(compiling, "_home", lambda: "")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    if home == "none":
        monkeypatch.delenv("HOME", raising=False)
    else:
        (tmp_path / "h").mkdir()
        (tmp_path / "h" / ".cache").write_text("x")
        monkeypatch.setenv("HOME", {"a file in it": str(tmp_path / "h"), "empty": "", "relative": "h"}[home])
    with pytest.warns(RuntimeWarning, match="compiled filters are kept in"):
        library = build(TEXT)
    own = tmp_path / f"flowgraph-{os.getuid()}"
    assert library.parent == own
    assert own.stat().st_mode & 0o777 == 0o700
    own.chmod(0o777)
    with pytest.raises(OutputError, match="not ours alone"):
        build(TEXT)


def test_the_cache_is_where_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "flowgraph" / "c"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "flowgraph" / "c"


def alive(mark: str) -> list[int]:
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = place.read_bytes()
        except OSError:
            continue
        if mark.encode() in words and place.parent.name != str(os.getpid()):
            found.append(int(place.parent.name))
    return found


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_no_compiler_outlives_what_started_it(cache, tmp_path, number):
    mark = f"863{number}.{os.getpid()}"  # no other process sleeps so long
    cc = program(tmp_path, f'case "$1" in --version|-march*) exit 0;; esac\nsleep {mark} & sleep {mark}')
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # the background does not
        "from flowgraph.cli.terminal import reports_errors\nfrom flowgraph.engines.c.compile import build\n"
        f"reports_errors(lambda: build({TEXT!r}, ()))()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "CC": cc}, stderr=subprocess.PIPE
    )
    until = time.monotonic() + 120
    while len(alive(mark)) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    assert len(alive(mark)) >= 2
    process.send_signal(number)
    process.communicate(timeout=120)
    assert process.returncode != 0
    until = time.monotonic() + 60
    while alive(mark) and time.monotonic() < until:
        time.sleep(0.05)
    assert alive(mark) == []
    assert list(cache.iterdir()) == []


def test_what_a_killed_process_left_is_swept_and_what_another_uses_is_not(cache):
    cache.mkdir()
    for k in range(3):
        (cache / f"work-{k}").mkdir()
        (cache / f"work-{k}" / "made.so").write_text("half")
    (cache / ".abc.so.part").write_text("half")
    used = os.open(cache / "work-1", os.O_RDONLY)
    assert lock(used, wait=False)
    library = build(TEXT)
    assert sorted(f.name for f in cache.iterdir()) == sorted([library.name, "work-1"])
    os.close(used)
