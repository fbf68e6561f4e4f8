"""A study: what may be asked, that a run is done once, and that nothing that dies changes the table."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, UnknownNameError, find_graph, load_flight, simulate
from flowgraph.study import (
    OnDask,
    ProcessPool,
    Store,
    Study,
    Watcher,
    plan,
    read_table,
    read_trajectory,
    run_study,
    tasks,
)
from flowgraph.study.execution import tasks_of
from flowgraph.study.store import RUNS
from flowgraph.types import flatten, unflatten

pytest.importorskip("pyarrow")
SMALL: dict[str, Any] = {"graphs": ["ekf"], "data": ["sim"], "parameters": {"duration": 1.5, "imu.rate": 50}}


def small(**more):
    parameters = {**SMALL["parameters"], **more.pop("parameters", {})}
    return Study(**{**SMALL, "parameters": parameters, **more})


def told(rows):
    """Rows in order of graph, flight and key, without what depends on the machine."""
    plain = [{n: v for n, v in r.items() if not n.endswith("_s")} for r in rows]
    return sorted(plain, key=lambda r: (r["graph"], r["data"], r["key"]))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    study = small(seeds=10, parameters={"position_noise": [0.005, 0.02]})
    folder = tmp_path_factory.mktemp("undisturbed")
    run_study(study, folder)
    return study, told(read_table(folder))


# -- results -------------------------------------------------------------------------------------------


def test_a_row_is_what_a_single_run_gives(undisturbed):
    _, rows = undisturbed
    assert len(rows) == 20
    row = next(r for r in rows if r["seed"] == 3 and r["position_noise"] == 0.02)
    flight = load_flight("sim", seed=3, settings={"duration": "1.5", "imu.rate": "50"})
    case = find_graph("ekf").case(flight, position_noise=0.02)
    for name, value in case.score(simulate(case.graph, case.inputs, seed=3)).items():
        assert row[name] == value
    assert row["error"] is None
    assert row["duration"] == 1.5


def test_the_table_has_its_columns_in_order_and_of_one_type(tmp_path):
    import pyarrow.parquet

    run_study(small(seeds=2), tmp_path)
    schema = pyarrow.parquet.read_schema(tmp_path / "results.parquet")
    assert schema.names[:5] == ["graph", "data", "seed", "duration", "imu.rate"]
    assert str(schema.field("seed").type) == "uint64"
    assert str(schema.field("error").type) == "string"
    assert {"wall_s", "run_s", "load_s"} <= set(schema.names)


def test_running_again_does_only_what_is_missing(tmp_path):
    first = run_study(small(seeds=3), tmp_path)
    assert (first.done, first.kept) == (3, 0)
    again = run_study(small(seeds=5), tmp_path)
    assert (again.done, again.kept) == (2, 3)
    assert run_study(small(seeds=5), tmp_path, force=True).done == 5
    assert told(again.rows)[:3] != []


def test_a_changed_parameter_graph_or_engine_is_another_key(monkeypatch):
    keys = lambda **more: {r.key for r in plan(small(**more)).runs}
    first = keys()
    assert keys() == first
    for other in ({"parameters": {"settle": 0.5}}, {"engine": "reference"}, {"seeds": [1]}):
        assert not keys(**other) & first
    assert not keys(parameters={"gyro.noise": 0.002}) & first
    monkeypatch.setattr("flowgraph.blocks.scoring.cases.GRAVITY", (0.0, 0.0, -9.8))
    assert not keys() & first


def test_a_default_spelled_out_has_a_key_of_its_own_but_the_same_result(tmp_path):
    a = run_study(small(), tmp_path / "a")
    b = run_study(small(parameters={"settle": 1.0}), tmp_path / "b")
    assert a.rows[0]["position_rmse_m"] == b.rows[0]["position_rmse_m"]


@pytest.mark.parametrize("damage", ["half", "cut", "empty", "other", "text", "bytes"])
def test_what_is_not_whole_is_no_result(tmp_path, damage):
    study = small(seeds=2)
    whole = run_study(study, tmp_path)
    key = whole.rows[0]["key"]
    file = tmp_path / RUNS
    content = file.read_bytes()
    first, last = sorted(content.splitlines(), key=lambda line: key.encode() not in line)
    spoiled = {
        "half": last + b"\n" + first[: len(first) // 2],  # as a process that is killed leaves it
        "cut": first[: len(first) // 2] + b"\n" + last,
        "empty": last,
        "other": first.replace(b'"seed": 0', b'"seed": 9') + b"\n" + last + b"\n",
        "text": b"[1, 2]\n" + last + b"\n",
        "bytes": b"\xff\0\n" + last + b"\n",
    }
    assert spoiled[damage] != content
    file.write_bytes(spoiled[damage])
    again = run_study(study, tmp_path)
    assert (again.done, again.kept) == (1, 1)
    assert told(again.rows) == told(whole.rows)
    assert run_study(study, tmp_path).kept == 2


def test_the_resolved_study_is_itself_a_study(tmp_path):
    study = small(
        seeds=2, sample={"count": 3, "parameters": {"gate": {"low": 10, "high": 1000, "scale": "log"}}}
    )
    run_study(study, tmp_path)
    again = Study.load(tmp_path / "study.json")
    assert again == study
    assert len(again.points) == 3
    assert run_study(again, tmp_path).done == 0


def test_trajectories_are_kept_where_asked(tmp_path):
    study = small(seeds=2)
    run_study(study, tmp_path)
    done = run_study(Study(**{**SMALL, "seeds": 2, "keep": True}), tmp_path)
    assert done.done == 2  # the rows were there, the trajectories were not
    found = read_trajectory(Store(tmp_path).trajectory_file(done.rows[1]["key"]))
    flight = load_flight("sim", seed=1, settings={"duration": "1.5", "imu.rate": "50"})
    case = find_graph("ekf").case(flight)
    alone = simulate(case.graph, case.inputs, seed=1)
    np.testing.assert_array_equal(found["belief"]["position"], alone["belief"].position)
    assert run_study(Study(**{**SMALL, "seeds": 2, "keep": True}), tmp_path).done == 0


# -- many at once ----------------------------------------------------------------------------------------


def test_vectorised_runs_are_those_of_one_at_a_time(tmp_path):
    pytest.importorskip("jax")
    many = {"seeds": 5, "parameters": {"position_noise": [0.005, 0.01, 0.02], "settle": [0.5, 1.0]}}
    one = run_study(small(**many), tmp_path / "one")
    all_ = run_study(small(**many, engine="xla", chunk=8), tmp_path / "all")
    assert len(all_.rows) == 30
    for a, b in zip(one.rows, all_.rows, strict=True):
        assert (a["seed"], a["position_noise"], a["settle"]) == (b["seed"], b["position_noise"], b["settle"])
        for name in ("position_rmse_m", "tilt_rmse_deg", "position_3sigma"):
            assert a[name] == pytest.approx(b[name], rel=1e-9)


def test_one_compilation_serves_all_seeds_and_noises(tmp_path, monkeypatch):
    pytest.importorskip("jax")
    from flowgraph.engines.xla import scan as xla

    tasks._programs.clear()
    compiled: list[Any] = []
    made = xla.Scan.__init__

    def counted(self, *arguments, **keywords):
        compiled.append(arguments)
        made(self, *arguments, **keywords)

    monkeypatch.setattr(xla.Scan, "__init__", counted)
    points = [{"position_noise": 0.001 * k, "gyro_factor": float(k)} for k in range(3, 10)]
    run_study(small(seeds=3, points=points, engine="xla", chunk=4), tmp_path)
    assert len(compiled) <= 2  # for runs of several cases, and for those of one, which share its streams


def test_a_vectorised_run_does_not_depend_on_what_else_is_asked_for(tmp_path):
    pytest.importorskip("jax")
    few = run_study(small(seeds=3, engine="xla", chunk=4), tmp_path / "few")
    many = run_study(small(seeds=9, engine="xla", chunk=4), tmp_path / "many")
    assert told(few.rows) == told(many.rows[:3]) or {r["key"] for r in few.rows} <= {
        r["key"] for r in many.rows
    }
    by_key = {r["key"]: r for r in told(many.rows)}
    assert all(by_key[r["key"]] == r for r in told(few.rows))
    resumed = run_study(small(seeds=9, engine="xla", chunk=4), tmp_path / "few")
    assert (resumed.done, resumed.kept) == (6, 3)
    assert told(resumed.rows) == told(many.rows)


def test_parameters_that_change_shapes_are_grouped():
    study = Study(
        graphs=["rbpf_indoor"], data=["sim"], seeds=3, engine="xla", chunk=4,
        parameters={"duration": 1.2, "position_noise": [0.017, 0.023], "particles": [10, 20]},
    )  # fmt: skip
    planned = plan(study)
    made = tasks_of(study, planned, [r.key for r in planned.runs])
    assert [len(t.runs) for t in made] == [4, 4, 2, 2]
    assert all(len({r.parameters["particles"] for r in t.runs}) == 1 for t in made)
    later = tasks_of(study, planned, [r.key for r in planned.runs if r.seed != 1])
    assert sum(len(t.runs) for t in later) == 8
    assert all({r.key for r in t.runs} <= {r.key for r in o.runs} for t, o in zip(later, made, strict=True))


def test_runs_of_several_shapes_are_those_of_one_at_a_time(tmp_path):
    pytest.importorskip("jax")
    study = Study(
        graphs=["particle"], data=["sim:plane"], seeds=2, engine="xla", chunk=4,
        parameters={"duration": 1.2, "particles": [10, 20], "position_noise": [0.1, 0.2]},
    )  # fmt: skip
    done = run_study(study, tmp_path)
    assert [r["error"] for r in done.rows] == [None] * 8
    alone = run_study(Study(**{**study.resolved(), "engine": "reference"}), tmp_path / "alone")
    for a, b in zip(alone.rows, done.rows, strict=True):
        assert a["position_rmse_m"] == pytest.approx(b["position_rmse_m"], rel=1e-6)


# -- deaths ----------------------------------------------------------------------------------------------


class Murderer(Watcher):
    """Kills a worker of an executor after the first rows."""

    def __init__(self, executor, after=2):
        self.executor, self.left, self.killed = executor, after, None

    def row(self, row):
        self.left -= 1
        if self.left == 0:
            self.killed = self.executor.pids()[0]
            os.kill(self.killed, signal.SIGKILL)


@pytest.mark.parametrize("kind", [ProcessPool, OnDask])
def test_a_worker_killed_in_the_middle_changes_nothing(kind, undisturbed, tmp_path):
    if kind is OnDask:
        pytest.importorskip("distributed")
    study, rows = undisturbed
    with kind(workers=2) as executor:
        watcher = Murderer(executor)
        done = run_study(study, tmp_path, executor=executor, watcher=watcher)
    assert watcher.killed
    assert done.done == 20
    assert told(read_table(tmp_path)) == rows


def address_in(file, seconds=90.0):
    """Of a scheduler, once it has written all of it down."""
    deadline = time.monotonic() + seconds
    while True:
        with contextlib.suppress(OSError, json.JSONDecodeError):
            return json.loads(file.read_text())["address"]
        assert time.monotonic() < deadline, "no scheduler came"
        time.sleep(0.05)


@pytest.fixture
def cluster(tmp_path):
    """The address of a Dask scheduler with two workers, each a process of its own without a nurse."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    near = ["--scheduler-file", str(file), "--no-dashboard"]
    commands = [["dask_scheduler", "--host", "127.0.0.1", "--port", "0", *near]]
    commands += [["dask_worker", *near, "--nthreads", "1", "--no-nanny", "--name", f"{k}"] for k in range(2)]
    with contextlib.ExitStack() as all_of:
        for name, *options in commands:
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{name}", *options],
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=tmp_path,
            )  # fmt: skip
            all_of.callback(process.wait)
            all_of.callback(process.kill)
        yield address_in(file)


@pytest.mark.slow
def test_a_scheduler_elsewhere_loses_a_worker_and_nothing_else(cluster, undisturbed, tmp_path):
    """Scheduler and workers are processes that were there before; one is killed while it works."""
    study, rows = undisturbed
    with OnDask(cluster, patience=30.0) as executor:
        deadline = time.monotonic() + 90
        while len(executor.pids()) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        watcher = Murderer(executor)
        done = run_study(study, tmp_path / "out", executor=executor, watcher=watcher)
        alive = executor.pids()
    assert watcher.killed
    assert len(alive) == 1
    assert watcher.killed not in alive
    assert done.done == 20
    assert told(read_table(tmp_path / "out")) == rows


@pytest.mark.slow
def test_the_command_uses_a_scheduler_elsewhere(cluster, undisturbed, tmp_path):
    study, rows = undisturbed
    (tmp_path / "study.json").write_text(json.dumps(study.resolved()))
    command = [sys.executable, "-c", "from flowgraph.cli import main; main()", "batch", "study.json"]
    command += ["--out", "out", "--scheduler", cluster, "--quiet"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert told(read_table(tmp_path / "out")) == rows


def written(out: Path) -> int:
    """How many runs are written down."""
    file = out / RUNS
    return file.read_bytes().count(b"\n") if file.exists() else 0


def test_a_study_killed_and_run_again_changes_nothing(undisturbed, tmp_path):
    """Killed by itself, between two runs: who watches it from outside may come when it has ended."""
    study, rows = undisturbed
    file, out = tmp_path / "study.json", tmp_path / "out"
    file.write_text(json.dumps(study.resolved()))
    process = subprocess.run([sys.executable, "-c", SUICIDE, str(file), str(out)], check=False)
    assert process.returncode == -signal.SIGKILL
    assert written(out) == 3
    assert not (out / "results.parquet").exists()
    done = run_study(study, out)
    assert (done.kept, done.done) == (3, 17)
    assert told(read_table(out)) == rows


SUICIDE = """
import os, signal, sys
from flowgraph.study import Study, Watcher, run_study
class Kills(Watcher):
    left = 3
    def row(self, row):
        self.left -= 1
        if not self.left:
            os.kill(os.getpid(), signal.SIGKILL)
run_study(Study.load(sys.argv[1]), sys.argv[2], workers=2, watcher=Kills())
"""


def test_ctrl_c_stops_with_what_there_is(undisturbed, tmp_path):
    study, rows = undisturbed

    class Impatient(Watcher):
        count = 0

        def row(self, row):
            self.count += 1
            if self.count == 5:
                raise KeyboardInterrupt

    stopped = run_study(study, tmp_path, watcher=Impatient())
    assert stopped.interrupted
    assert len(stopped.rows) == 5
    assert len(read_table(tmp_path)) == 5
    assert run_study(study, tmp_path).done == 15
    assert told(read_table(tmp_path)) == rows


def test_a_poison_run_is_a_row_and_is_tried_again_next_time(tmp_path, monkeypatch):
    from flowgraph.study import execution
    from tests.study import poison

    monkeypatch.setattr(execution, "run_task", poison.run_task)
    study = small(seeds=6, engine="reference")
    with ProcessPool(2, deaths=2) as pool:
        done = run_study(study, tmp_path, executor=pool)
    assert [r["seed"] for r in done.failed] == [poison.SEED]
    assert "2 workers died of it" in done.failed[0]["error"]
    monkeypatch.undo()
    again = run_study(study, tmp_path)
    assert (again.done, again.kept, again.failed) == (1, 5, [])


# -- runs that raise -------------------------------------------------------------------------------------


@pytest.fixture
def broken_recording(tmp_path):
    """A recording with an infinity in a file."""
    data = Path(os.environ.get("FLOWGRAPH_DATA", Path(__file__).parents[2] / ".." / "shared" / "datasets"))
    source = next(iter(sorted(data.glob("euroc/*"))), None) if data.exists() else None
    if source is None or not list(source.rglob("imu0/data.csv")):
        pytest.skip("the EuRoC recordings are not there")
    folder = tmp_path / "broken"
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("*.png"))
    file = next(folder.rglob("imu0/data.csv"))
    lines = file.read_text().splitlines()
    lines[100] = lines[100].split(",")[0] + ",inf" * 6
    file.write_text("\n".join(lines) + "\n")
    return folder


def test_a_run_that_raises_is_a_row_with_its_error(tmp_path, broken_recording):
    study = Study(graphs=["ins_eskf"], data=["sim", f"euroc:{broken_recording}"], points=[{"settle": 0.1}])
    done = run_study(study, tmp_path / "out")
    assert [r["error"] is None for r in done.rows] == [True, False]
    assert "finite" in done.rows[1]["error"] or "NaN" in done.rows[1]["error"]
    assert run_study(study, tmp_path / "out").done == 0
    assert run_study(study, tmp_path / "out", retry=True).done == 1


@pytest.mark.parametrize("engine", ["reference", "xla"])
def test_a_graph_that_the_flight_does_not_suit_is_a_row(tmp_path, engine):
    if engine == "xla":
        pytest.importorskip("jax")
    study = Study(
        graphs=["orientation_complementary", "ekf"],
        data=["sim"],
        seeds=2,
        engine=engine,
        parameters={"duration": 1.5},
    )
    done = run_study(study, tmp_path)
    assert [r["graph"] for r in done.failed] == ["orientation_complementary"] * 2
    assert done.failed[0]["error"].startswith("DataError: ")
    assert "\n" not in done.failed[0]["error"]


def test_an_unknown_metric_is_a_row_error_that_lists_those_there_are(tmp_path):
    done = run_study(small(metrics=["speed"]), tmp_path)
    assert "position_rmse_m" in done.rows[0]["error"]


def test_an_estimate_that_is_not_finite_is_an_error(tmp_path, monkeypatch):
    made = tasks.prepared

    def diverging(*arguments):
        case, flight = made(*arguments)
        return replace(case, score=lambda result: {"position_rmse_m": math.nan, "tilt_rmse_deg": 1.0}), flight

    monkeypatch.setattr(tasks, "prepared", diverging)
    done = run_study(small(), tmp_path)
    assert "went astray: position_rmse_m is nan" in done.rows[0]["error"]
    assert done.rows[0]["tilt_rmse_deg"] == 1.0
    monkeypatch.undo()
    assert run_study(small(), tmp_path).done == 0


# -- what may be asked -----------------------------------------------------------------------------------

BAD = [
    ({"graphs": []}, "graphs"),
    ({"graphs": ["ekv"]}, "ekf"),
    ({"graphs": ["ekf", "ekf"]}, "graphs"),
    ({"data": ["simm"]}, "sim"),
    ({"data": "sim"}, "data"),
    ({"seeds": 0}, "seeds"),
    ({"seeds": [1, 1]}, "seeds"),
    ({"seeds": [-1]}, "seeds"),
    ({"seeds": 2.5}, "seeds"),
    ({"engine": "cuda"}, "engine"),
    ({"dtype": "float32"}, "dtype"),
    ({"shard": {"runs": 2}}, "engine"),
    ({"shard": {"runs": 0}, "engine": "xla"}, "shard"),
    ({"shard": 4, "engine": "xla"}, "shard"),
    ({"chunk": 0}, "chunk"),
    ({"keep": "yes"}, "keep"),
    ({"parameters": {"noize": 1.0}}, "noize"),
    ({"parameters": {"position_noise": "loud"}}, "position_noise"),
    ({"parameters": {"position_noise": []}}, "position_noise"),
    ({"parameters": {"position_noise": [1.0, 1.0]}}, "position_noise"),
    ({"parameters": {"position_noise": math.inf}}, "position_noise"),
    ({"parameters": {"position_noise": {"linspace": [1, 2]}}}, "parameters.position_noise.linspace"),
    ({"parameters": {"position_noise": {"logspace": [0, 2, 3]}}}, "parameters.position_noise.logspace"),
    ({"parameters": {"position_noise": {"range": [0, 2, 3]}}}, "parameters.position_noise"),
    ({"parameters": {"seed": 3}}, "parameters.seed"),
    ({"parameters": {"duration": {"linspace": [1, 2, 10**7]}, "settle": [0, 1]}}, "parameters"),
    ({"sample": {"count": 3}}, "sample.parameters"),
    ({"sample": {"parameters": {"gate": {"low": 1, "high": 2}}}}, "sample.count"),
    ({"sample": {"count": 3, "method": "halton", "parameters": {}}}, "sample.method"),
    ({"sample": {"count": 3, "points": 1}}, "sample.points"),
    ({"sample": {"count": 3, "parameters": {"gate": {"low": 2, "high": 1}}}}, "sample.parameters.gate"),
    ({"sample": {"count": 3, "parameters": {"gate": {"low": 0, "high": 1, "scale": "log"}}}}, "gate"),
    ({"points": [{}]}, "points"),
    ({"points": [{"gate": [1, 2]}]}, "points"),
    ({"points": [{"settle": 1.0}], "parameters": {"settle": [0.5]}}, "points"),
    ({"metrics": []}, "metrics"),
    ({"out": 3}, "out"),
]  # fmt: skip


@pytest.mark.parametrize(("wrong", "key"), BAD, ids=[str(k) for k in range(len(BAD))])
def test_a_wrong_key_is_named(wrong, key):
    with pytest.raises((DeclarationError, UnknownNameError)) as caught:
        Study(**{"graphs": ["ekf"], "data": ["sim"], **wrong})
    assert key in str(caught.value)
    assert caught.value.fix


def test_ranges_and_samples_are_spelled_out():
    study = Study(
        graphs=["ekf"], data=["sim"],
        parameters={"settle": {"linspace": [0, 1, 3]}, "gyro_factor": {"logspace": [1, 100, 3]}},
        sample={"method": "random", "count": 50, "seed": 4, "parameters": {
            "position_noise": {"low": 0.001, "high": 0.1, "scale": "log"}, "gate": {"low": 5, "high": 9}}},
    )  # fmt: skip
    assert study.parameters == {"settle": (0.0, 0.5, 1.0), "gyro_factor": pytest.approx((1.0, 10.0, 100.0))}
    assert len(list(study.combinations("ekf"))) == 9 * 50
    noises = [float(p["position_noise"]) for p in study.points]
    assert 0.001 <= min(noises) < 0.003
    assert 0.03 < max(noises) <= 0.1
    assert all(5 <= float(p["gate"]) <= 9 for p in study.points)


def test_a_longer_sobol_sample_starts_with_the_shorter():
    drawn = lambda n: (
        Study(
            graphs=["ekf"], data=["sim"], sample={"count": n, "parameters": {"gate": {"low": 0, "high": 1}}}
        ).points
    )
    assert drawn(20)[:5] == drawn(5)


def test_parameters_of_one_graph_alone():
    study = Study(
        graphs=["ekf", "ins_eskf"],
        data=["sim"],
        parameters={"settle": 1.0, "ekf": {"attitude_noise": [0.01, 0.02]}},
    )
    assert len(list(study.combinations("ekf"))) == 2
    assert list(study.combinations("ins_eskf")) == [{"settle": 1.0}]
    assert study.names() == ["settle", "attitude_noise"]


@pytest.mark.parametrize(
    "text", ["graphs = ", "data = ['sim']", "graphs = ['ekf']\ndata = ['sim']\nseed = 3"]
)
def test_a_wrong_file_is_an_error(tmp_path, text):
    file = tmp_path / "study.toml"
    file.write_text(text)
    with pytest.raises((DataError, DeclarationError, UnknownNameError)) as caught:
        Study.load(file)
    assert caught.value.fix


def test_a_folder_is_needed():
    with pytest.raises(DeclarationError, match="needs a folder"):
        run_study(small())
    with pytest.raises(DataError, match="no results"):
        read_table("nowhere")


@pytest.mark.parametrize(
    ("given", "place"),
    [
        ({"parameters": {"gate": [1, 1.0]}}, "parameters.gate"),
        ({"parameters": {"gate": ["1", 1]}}, "parameters.gate"),
        ({"parameters": {"gate": [0.1, 1e-1]}}, "parameters.gate"),
        ({"parameters": {"gate": {"linspace": [2, 2, 3]}}}, "parameters.gate.linspace"),
        ({"parameters": {"gate": {"logspace": [2, 2.0, 2]}}}, "parameters.gate.logspace"),
        ({"parameters": {"ekf": {"gate": {"linspace": [1, 1 + 1e-16, 2]}}}}, "parameters.ekf.gate.linspace"),
        ({"points": [{"gate": 1}, {"gate": 2}, {"gate": 1.0}]}, "points[2]"),
        ({"points": [{"gate": 1, "settle": 2}, {"settle": 2.0, "gate": "1"}]}, "points[1]"),
    ],
)
def test_what_would_run_and_count_twice_is_refused(given, place):
    with pytest.raises(DeclarationError) as caught:
        Study(graphs=["ekf"], data=["sim"], **given)
    assert caught.value.path == place


def test_values_that_only_look_alike_are_kept():
    study = Study(
        graphs=["ekf"], data=["sim"],
        parameters={"gate": [1, 1.5], "position_noise": {"linspace": [0.01, 0.01, 1]}},
        points=[{"settle": 1}, {"settle": 2}, {"settle": 1, "gyro_factor": 2}],
    )  # fmt: skip
    assert len(list(study.combinations("ekf"))) == 6


@pytest.mark.parametrize("engine", ["python", "c", "xla"])
def test_a_run_that_diverges_is_a_row_and_the_others_go_on(tmp_path, monkeypatch, engine):
    """One of them starts from numbers whose squares are infinite."""
    made = tasks.prepared

    def huge(node):
        leaves = [np.full_like(leaf, 1e200) for leaf in flatten(node.initial, node.type)]
        return replace(node, initial=unflatten(node.type, iter(leaves)))

    def diverging(graph, data, seed, *more):
        case, flight = made(graph, data, seed, *more)
        if seed == 1:
            held = {k for k, node in case.graph.registers if node.role == "delay"}
            nodes = tuple(huge(n) if k in held else n for k, n in enumerate(case.graph.nodes))
            case = replace(case, graph=replace(case.graph, nodes=nodes, plans={}))
        return case, flight

    monkeypatch.setattr(tasks, "prepared", diverging)
    monkeypatch.setattr(tasks, "_wholes", type(tasks._wholes)())  # none that was prepared before
    with np.errstate(all="ignore"):
        done = run_study(small(seeds=3, engine=engine), tmp_path)
    rows = {row["seed"]: row for row in done.rows}
    assert "not finite" in rows[1]["error"]
    assert rows[0]["error"] is rows[2]["error"] is None
    assert rows[2]["position_rmse_m"] < 1.0
