"""`flowgraph batch` as it is typed: the smallest study, a terminal, Ctrl-C, exit status, the example."""

from __future__ import annotations

import json
import os
import pty
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from flowgraph.study import Store, Study, read_table
from flowgraph.study.store import RUNS
from tests.recordings import DATA, recordings

pytest.importorskip("pyarrow")

COMMAND = [sys.executable, "-c", "from flowgraph.cli import main; main()"]
HEARS = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {COMMAND[-1]}"
"""The same where Ctrl-C was not to be heard, as in the background of a shell."""

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "orientation_study.toml"
SHORT = 'graphs = ["ekf"]\ndata = ["sim"]\nseeds = {seeds}\n[parameters]\nduration = 1.5\n"imu.rate" = 50\n'


def flowgraph(*arguments, **more):
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, **more)


class Terminal:
    """A command whose messages go to a terminal of its own, with all that it shows there."""

    def __init__(self, *arguments):
        ours, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-c", HEARS, *map(str, arguments)], stdin=theirs, stdout=theirs, stderr=theirs,
            start_new_session=True, env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
        )  # fmt: skip
        os.close(theirs)
        self.shown, self._ours = b"", ours
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self):
        while True:
            try:
                part = os.read(self._ours, 4096)
            except OSError:  # how Linux says that the other end is closed
                part = b""
            if not part:
                return
            self.shown += part

    def end(self):
        status = self.process.wait(timeout=240)
        self._reader.join(timeout=240)
        os.close(self._ours)
        return status, self.shown.decode(errors="replace")


def test_ctrl_c_in_a_terminal_stops_cleanly_and_says_how_to_continue(tmp_path):
    file, out = tmp_path / "study.toml", tmp_path / "out"
    file.write_text(SHORT.format(seeds=2000))
    runs = out / RUNS
    written = lambda: runs.read_bytes().count(b"\n") if runs.exists() else 0
    terminal = Terminal("batch", file, "--out", out, "--workers", 2)
    try:
        wait_for(lambda: written() >= 5 or terminal.process.poll() is not None)
        os.killpg(terminal.process.pid, signal.SIGINT)  # as a terminal does: to all of them
        status, shown = terminal.end()
    finally:
        terminal.process.kill()
    assert status == 130
    assert "of 2000" in shown
    assert "a second" in shown  # the live table
    assert "Traceback" not in shown
    (line,) = [x for x in shown.splitlines() if "to continue" in x]
    again = shlex.split(line.partition("to continue: ")[2])
    assert again == ["flowgraph", "batch", str(file), "--out", str(out), "--workers", "2"]
    rows = read_table(out)
    assert 5 <= len(rows) < 2000
    assert not list(out.rglob("*.part"))
    file.write_text(SHORT.format(seeds=len(rows)))  # not all 2000: the seeds that there may be
    done = flowgraph(*again[1:], "--json")
    assert done.returncode == 0
    found = json.loads(done.stdout)
    assert found["kept"] >= len(rows) - 2  # two workers: one of them may have been ahead of a seed
    assert found["kept"] + found["done"] == len(rows)


def wait_for(condition, seconds=90.0):
    event = threading.Event()
    for _ in range(int(seconds / 0.02)):
        if condition():
            return
        event.wait(0.02)
    raise AssertionError("it did not come to that in time")


def test_the_exit_status_says_that_a_run_failed(tmp_path):
    file = tmp_path / "study.toml"
    file.write_text('graphs = ["roll_pitch", "orientation_complementary"]\ndata = ["sim"]\n')
    done = flowgraph("batch", file, "--out", tmp_path / "out", "--quiet")
    assert done.returncode == 1
    assert "runs failed; orientation_complementary on sim, seed 0" in done.stderr
    file.write_text('graphs = ["ekv"]\ndata = ["sim"]\n')
    wrong = flowgraph("batch", file, "--out", tmp_path / "out")
    assert wrong.returncode == 2
    assert "ekf" in wrong.stderr


@pytest.mark.slow
def test_the_smallest_study(tmp_path):
    (tmp_path / "study.toml").write_text('graphs = ["ekf"]\ndata = ["sim"]\nseeds = 20\nengine = "python"\n')
    done = flowgraph("batch", "study.toml", "--out", "DIR", "--workers", 2, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = read_table(tmp_path / "DIR")
    assert [(r["graph"], r["data"], r["seed"]) for r in rows] == [("ekf", "sim", k) for k in range(20)]
    assert {"error", "position_rmse_m", "attitude_rmse_deg", "run_s", "wall_s"} <= set(rows[0])
    assert all(r["error"] is None and 0.0 < r["position_rmse_m"] < 0.1 for r in rows)
    assert Store(tmp_path / "DIR").read(r["key"] for r in rows).keys() == {r["key"] for r in rows}


def test_the_example_is_a_study_of_three_filters_on_six_recordings():
    study = Study.load(EXAMPLE)
    assert len(study.graphs) == 3
    assert [d.rpartition(":")[2] for d in study.data] == list("123456")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_example_runs_with_one_command_and_its_report_opens(tmp_path):
    recordings("ese650")
    file, out = tmp_path / "study.toml", tmp_path / "out"
    file.write_text(EXAMPLE.read_text().replace("../../shared/datasets", str(DATA)))
    done = flowgraph("batch", file, "--out", out, "--workers", 2, "--quiet")
    assert done.returncode == 0, done.stderr
    rows = read_table(out)
    assert len(rows) == 18
    inclination: dict[str, list[Any]] = {}
    for row in rows:
        inclination.setdefault(row["graph"], []).append(row["inclination_rmse_deg"])
    ukf, tilt = inclination["quaternion_ukf"], inclination["roll_pitch"]
    assert sum(a < b for a, b in zip(ukf, tilt, strict=True)) >= 5  # the filter is worth its gyroscope
    shown = flowgraph("report", out)
    assert shown.returncode == 0, shown.stderr
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 1
    assert "quaternion_ukf" in page
    assert (out / "figures" / "boxes.png").read_bytes()[:4] == b"\x89PNG"
