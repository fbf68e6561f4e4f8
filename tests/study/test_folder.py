"""The folder of a study: for one at a time, with nothing in it that is half or somebody else's."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from flowgraph import DataError, OutputError
from flowgraph.study import Store, Study, Watcher, read_table, read_trajectory, run_study
from flowgraph.study.report import write_report
from flowgraph.study.store import LOCK, RUNS, as_table
from tests.study.test_study import small

pyarrow = pytest.importorskip("pyarrow")
COMMAND = [sys.executable, "-c", "from flowgraph.cli import main; main()", "batch"]


def lines(out: Path) -> int:
    """How many runs are written down."""
    file = out / RUNS
    return file.read_bytes().count(b"\n") if file.exists() else 0


def toml(folder: Path, graph: str, seeds: int) -> Path:
    file = folder / f"{graph}.toml"
    settings = '[parameters]\nduration = 1.5\n"imu.rate" = 50\n'
    file.write_text(f'graphs = ["{graph}"]\ndata = ["sim"]\nseeds = {seeds}\n{settings}')
    return file


def test_a_second_study_into_the_folder_is_refused_and_changes_nothing(tmp_path):
    out = tmp_path / "out"
    command = [*COMMAND, str(toml(tmp_path, "ukf", 2)), "--out", str(out)]
    refused: list[subprocess.CompletedProcess[str]] = []

    class Second(Watcher):
        """Starts another process while the first study goes on, which waits for it."""

        def row(self, row: Any) -> None:
            if not refused:
                refused.append(subprocess.run(command, capture_output=True, text=True, check=False))

    done = run_study(Study.load(toml(tmp_path, "ekf", 3)), out, watcher=Second())
    (second,) = refused
    assert second.returncode == 1
    assert "another study is running into this folder" in second.stderr
    assert f"held by process {os.getpid()} on " in second.stderr
    assert (done.done, done.failed) == (3, [])
    assert json.loads((out / "study.json").read_text())["graphs"] == ["ekf"]
    assert {r["graph"] for r in read_table(out)} == {"ekf"}
    assert lines(out) == 3
    assert not (out / LOCK).exists()


def test_the_same_study_at_once_is_refused_too_and_a_lock_of_the_dead_is_none(tmp_path):
    class Again(Watcher):
        said = ""

        def row(self, row: Any) -> None:
            with pytest.raises(OutputError) as caught:
                run_study(study, tmp_path)
            self.said = str(caught.value)

    study, again = small(seeds=2), Again()
    (tmp_path / LOCK).write_text("process 1 on a machine that is no more")
    assert len(run_study(study, tmp_path, watcher=again).rows) == 2
    assert f"process {os.getpid()} on " in again.said
    assert run_study(study, tmp_path).kept == 2


@pytest.mark.parametrize("workers", ["1", "2"])
def test_sigterm_leaves_the_table_as_ctrl_c_does(tmp_path, workers):
    out = tmp_path / "out"
    command = [*COMMAND, str(toml(tmp_path, "ekf", 2000)), "--out", str(out), "--quiet", "--workers", workers]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while lines(out) < 2:
        assert process.poll() is None, "it ended too soon"
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate()
    assert process.returncode == 143, said
    assert "to continue: flowgraph batch" in said
    rows = read_table(out)
    assert 2 <= len(rows) < 2000
    assert len(rows) == lines(out)
    assert sorted(f.name for f in out.iterdir()) == ["results.parquet", "runs.jsonl", "study.json"]


@pytest.mark.parametrize("damage", ["cut", "another's", "a byte", "gone", "text", "old"])
def test_a_kept_trajectory_that_is_not_the_runs_is_made_again(tmp_path, damage):
    study = small(seeds=2, keep=True)
    keys = [r["key"] for r in run_study(study, tmp_path).rows]
    store = Store(tmp_path)
    file = store.trajectory_file(keys[0])
    whole = file.read_bytes()
    if damage == "gone":
        file.unlink()
    elif damage == "old":  # of before there was a digest
        runs = [json.loads(line) for line in (tmp_path / RUNS).read_text().splitlines()]
        del next(run for run in runs if run["key"] == keys[0])["trajectory"]
        (tmp_path / RUNS).write_text("".join(json.dumps(run) + "\n" for run in runs))
    else:
        other = store.trajectory_file(keys[1]).read_bytes()
        cut, flipped = whole[: len(whole) // 2], whole[:500] + bytes([whole[500] ^ 4]) + whole[501:]
        file.write_bytes({"cut": cut, "another's": other, "a byte": flipped, "text": b"no"}[damage])
    again = run_study(study, tmp_path)
    assert (again.done, again.kept) == (1, 1)
    assert file.read_bytes() == whole
    assert run_study(study, tmp_path).kept == 2


@pytest.mark.parametrize("content", ["{}", "notes of mine", "[1]", '{"graphs": []}', "\ud800"])
def test_somebody_elses_study_json_is_not_written_over(tmp_path, content):
    raw = content.encode("utf-8", "surrogatepass")
    (tmp_path / "study.json").write_bytes(raw)
    with pytest.raises(OutputError, match="another file is already here"):
        run_study(small(), tmp_path)
    assert (tmp_path / "study.json").read_bytes() == raw
    assert os.listdir(tmp_path) == ["study.json"]


ROW = {"graph": "ekf", "data": "sim", "seed": 0, "error": None, "e": 1.0, "key": "ab" * 16}


def table(folder: Path, *rows: dict[str, Any]) -> None:
    store = Store(folder)
    store.write_study(Study(graphs=["ekf"], data=["sim"]).resolved())
    store.write_table([{**ROW, **row} for row in rows])


@pytest.mark.parametrize(
    ("change", "harm"),
    [
        ({"key": '"><img src=x onerror=alert(1)>'}, "<img src=x"),
        ({"key": "../../../etc/passwd"}, "../.."),
        ({"key": "/etc/passwd"}, 'href="/etc'),
        ({"graph": "<script>alert(1)</script>"}, "<script>alert"),
        ({"data": "a'\"><svg onload=x>"}, "<svg"),
        ({"error": "</td><iframe src=x>"}, "<iframe"),
        ({"<b onclick=x>": 2.0}, "<b onclick"),
        ({"graph": "$\\frac{$ \x1b[31m", "data": "$x$"}, "\x1b"),
    ],
)
def test_what_a_table_says_is_text_in_the_page(tmp_path, change, harm):
    table(tmp_path, change, {"seed": 1, "e": 2.0})
    trap = tmp_path / "trajectories" / "x.npz"
    trap.parent.mkdir()
    trap.write_bytes(b"x")
    page = write_report(tmp_path).page.read_text()
    assert harm not in page
    assert "Worst runs" in page
    assert "<a " not in page


def test_a_table_is_what_pyarrow_makes_of_its_columns():
    rows = [
        {**ROW, "seed": 2**64 - 1, "n": 2**63 - 1, "sure": True, "some": None, "mixed": 1, "error": None},
        {**ROW, "seed": 0, "n": -(2**63), "sure": None, "some": float("nan"), "mixed": "ä€𝄞", "error": ""},
        *({**ROW, "seed": k, "n": None, "sure": k % 3 == 0, "some": -0.0, "mixed": True} for k in range(9)),
    ]
    made = as_table([{**row, "nothing": None} for row in rows])
    made.validate(full=True)
    kinds = {"seed": "uint64", "n": "int64", "sure": "bool", "some": "double", "nothing": "double"}
    assert {n: str(made.schema.field(n).type) for n in kinds} == kinds
    text = lambda v: None if v is None else str(v)
    for name in made.column_names:
        wanted = [row.get(name) for row in rows]
        wanted = [text(v) for v in wanted] if name == "mixed" else wanted
        assert repr(made[name].to_pylist()) == repr(wanted)
    assert as_table([]).num_rows == 0


def test_writing_a_table_does_not_load_pandas(tmp_path):
    code = f"""
import sys
from flowgraph.study.store import Store
Store({str(tmp_path)!r}).write_table([{ROW!r}])
assert "pyarrow" in sys.modules and "pandas" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert read_table(tmp_path) == [ROW]


@pytest.mark.parametrize("damage", ["text", "cut", "other columns", "nested", "a pipe"])
def test_a_table_that_is_none_is_refused(tmp_path, damage):
    import pyarrow.parquet

    table(tmp_path, {})
    file = tmp_path / "results.parquet"
    whole = file.read_bytes()
    file.unlink()
    if damage == "a pipe":
        os.mkfifo(file)
    elif damage == "other columns":
        pyarrow.parquet.write_table(pyarrow.table({"a": [1]}), file)
    elif damage == "nested":
        pyarrow.parquet.write_table(as_table([ROW]).append_column("x", pyarrow.array([[1, 2]])), file)
    else:
        file.write_bytes({"text": b"text", "cut": whole[: len(whole) // 2]}[damage])
    with pytest.raises(DataError, match="no results can be read here"):
        read_table(tmp_path)


def test_a_trajectory_that_is_none_is_refused(tmp_path):
    file = tmp_path / "a.npz"
    for content in (b"", b"text", b"PK\x03\x04" + bytes(40)):
        file.write_bytes(content)
        with pytest.raises(DataError, match="no trajectory can be read here"):
            read_trajectory(file)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(DataError, match="no regular file"):
        read_trajectory(file)
    with pytest.raises(DataError, match="No such file"):
        read_trajectory(tmp_path / "none.npz")


@pytest.mark.parametrize(
    "text", ["a" + ".a" * 100_000 + " = 1", "[" + "a." * 5000 + "a]", "x = {" + "'a'.\"b\"." * 300 + "c = 1}",
             "x = " + "[" * 100_000, "a = 2001-99-99", "a = " + "9" * 5000, "a = 1979-05-27T07:32:00+99:99"],
)  # fmt: skip
def test_a_study_that_only_takes_time_is_refused_at_once(tmp_path, text):
    (tmp_path / "s.toml").write_text(text)
    start = time.process_time()  # whatever else the machine does
    with pytest.raises(DataError, match="no study can be read here"):
        Study.load(tmp_path / "s.toml")
    assert time.process_time() - start < 5.0


def test_a_pipe_or_a_wrong_key_is_named_with_the_file(tmp_path):
    os.mkfifo(tmp_path / "s.toml")
    with pytest.raises(DataError, match="no regular file"):
        Study.load(tmp_path / "s.toml")
    (tmp_path / "t.toml").write_text('graphs = ["ekf"]\ndata = ["sim"]\nsedes = 2\n')
    with pytest.raises(Exception, match=r"t\.toml: no key of a study is called 'sedes'"):
        Study.load(tmp_path / "t.toml")
