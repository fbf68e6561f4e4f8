"""Studies in C: runs on threads, in one compiled program for all seeds and all real parameters."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest

from flowgraph import find_graph, load_flight
from flowgraph.blocks.scoring.scorer import Scorer
from flowgraph.study import Store, Study, read_trajectory, run_study, tasks

pytest.importorskip("pyarrow")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")

FLIGHT: dict[str, Any] = {"duration": 1.5, "imu.rate": 50}


def study(engine, **more):
    parameters = {**FLIGHT, **more.pop("parameters", {})}
    return Study(graphs=["ekf"], data=["sim"], engine=engine, parameters=parameters, **more)


def numbers(row):
    return {n: v for n, v in row.items() if isinstance(v, float) and not n.endswith("_s")}


def test_runs_on_threads_are_those_of_one_at_a_time(tmp_path):
    """Also where a parameter sets what the score reads: a smoothed run needs more streams than another."""
    many: dict[str, Any] = {
        "seeds": 2,
        "parameters": {
            "position_noise": [0.005, 0.02],
            "gyro_factor": [1.0, 30.0],
            "smooth": ["none", "rts"],
        },
    }
    one = run_study(study("reference", **many), tmp_path / "one")
    c = run_study(study("c", chunk=6, **many), tmp_path / "c")
    assert len(c.rows) == 16
    assert not c.failed
    for a, b in zip(one.rows, c.rows, strict=True):
        assert a["smooth"] == b["smooth"]
        found, wanted = numbers(b), numbers(a)
        assert found.keys() == wanted.keys()
        assert ("smoothed_position_rmse_m" in found) == (a["smooth"] == "rts")
        for name, value in wanted.items():
            assert found[name] == pytest.approx(value, rel=1e-7, abs=1e-12), name


def test_one_compilation_serves_all_seeds_and_noises(tmp_path, monkeypatch):
    from flowgraph.engines.c.lanes import library as engine

    tasks._programs.clear()
    compiled: list[Any] = []
    made = engine.Lanes.__init__

    def counted(self, *arguments, **keywords):
        compiled.append(arguments)
        made(self, *arguments, **keywords)

    monkeypatch.setattr(engine.Lanes, "__init__", counted)
    points = [{"position_noise": 0.001 * k, "gyro_factor": float(k)} for k in range(3, 8)]
    done = run_study(study("c", seeds=3, points=points, chunk=4), tmp_path)
    assert not done.failed
    assert len(compiled) == 1
    assert len({row["position_rmse_m"] for row in done.rows}) == 15


def test_a_run_does_not_depend_on_what_else_is_asked_for(tmp_path):
    few = run_study(study("c", seeds=[4], chunk=4), tmp_path / "few")
    many = run_study(study("c", seeds=6, chunk=4, keep=True), tmp_path / "many")
    (wanted,) = [r for r in many.rows if r["seed"] == 4]
    assert few.rows[0]["key"] == wanted["key"]
    assert numbers(few.rows[0]) == numbers(wanted)
    kept = read_trajectory(Store(tmp_path / "many").trajectory_file(wanted["key"]))
    assert {"belief", "prior", "posterior", "innovation"} <= set(kept)
    assert np.isfinite(kept["belief"]["position"]).all()


def test_a_score_says_what_it_reads():
    flight = load_flight("sim", settings={n: str(v) for n, v in FLIGHT.items()})
    plain, smooth = (find_graph("ekf").case(flight, **s) for s in ({}, {"lag": 0.1}))
    assert isinstance(plain.score, Scorer)
    assert isinstance(smooth.score, Scorer)
    assert plain.score.reads(plain.graph) == ["innovation", "belief"]
    assert smooth.score.reads(smooth.graph) == [c.name for c in smooth.graph.collected]


def test_a_score_that_does_not_say_gets_every_stream(tmp_path, monkeypatch):
    from dataclasses import replace

    made, seen = tasks.prepared, []

    def silent(*arguments):
        case, flight = made(*arguments)

        def score(result):
            seen.append(set(result.series))
            return {"one": 1.0}

        return replace(case, score=score), flight

    monkeypatch.setattr(tasks, "prepared", silent)
    assert not run_study(study("c"), tmp_path).failed
    (streams,) = seen
    assert {"belief", "prior", "posterior"} <= streams


@pytest.mark.parametrize("name", ["ekf", "rbpf_indoor"])
def test_graphs_of_many_seeds_are_lowered_once(name, monkeypatch):
    """The second particle filter has merges, whose rule for ties is a function."""
    from collections import OrderedDict

    from flowgraph.language.recording import remembering
    from flowgraph.study.lifting import Lowered

    lowered, steps, settings = Lowered(), OrderedDict[Any, Any](), dict(FLIGHT)
    if name == "rbpf_indoor":
        settings["particles"] = 10
    found = []
    for seed in range(3):
        with remembering(steps):
            case, _ = tasks.prepared(name, "sim", seed, settings)
        found.append(lowered.lower(case.graph))
    assert found[1] is found[0]
    assert found[2] is found[0]


def test_results_do_not_depend_on_the_number_of_workers_or_the_chunk(tmp_path):
    """To the last bit: each run starts from its own state, wherever its outputs are put."""
    one = run_study(study("c", seeds=5, chunk=5), tmp_path / "one")
    two = run_study(study("c", seeds=5, chunk=2), tmp_path / "two", workers=2)
    assert not [*one.failed, *two.failed]
    assert [numbers(row) for row in one.rows] == [numbers(row) for row in two.rows]
    assert len({row["position_rmse_m"] for row in one.rows}) == 5
