"""The contract of engines: one from a package of its own is found and used as ours are."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.engines.contract import BlockEngine, PipelineEngine
from flowgraph.engines.options import RunOptions
from flowgraph.engines.registry import GROUP, engine_names, find_engine, find_pipeline_engine, writers

TOY = '''
"""An engine in forty lines: each instruction by its definition, counting what it does."""

from time import perf_counter

import numpy as np

from flowgraph.engines.contract import ManyOutcome, Outcome, PipelineEngine, Player
from flowgraph.data.batch import Runs
from flowgraph.pipeline.evaluate import evaluate
from flowgraph.pipeline.program import specialise
from flowgraph.recorder.random import seed_words

CALLS = []


class Toy(PipelineEngine):
    name = "toy"
    dtypes = ("float64",)
    takes_many = True

    def prepare(self, pipeline, patterns, ticks, dtype, passes):
        CALLS.append("prepare")
        return ToyPlayer(pipeline, {key: specialise(pipeline, key) for key in patterns})

    def play_many(self, runs, passes, options):
        CALLS.append("many")
        player = self.prepare(runs.pipeline, runs.first.patterns, len(runs.first.time), options.dtype, passes)
        all_ = [
            player.play(runs.tape(n), runs.cells(n), seed_words(seed), None)
            for n, seed in enumerate(runs.seeds)
        ]
        for n, outcome in enumerate(all_):
            runs.finish(n, outcome.cells)
        series = {}
        for k, port in enumerate(runs.pipeline.outputs):
            times = all_[0].outputs[k][0]
            leaves = {
                leaf.name: np.stack([o.outputs[k][1][i] for o in all_])
                for i, leaf in enumerate(port.leaves)
                if leaf.name in runs.keep.get(port.name, ())
            }
            series[port.name] = Runs(port.name, times, np.ones((len(all_), len(times)), bool), leaves)
        return ManyOutcome(series, len(runs.first.time), sum(o.wall_s for o in all_))


class ToyPlayer(Player):
    def __init__(self, pipeline, programs):
        self.pipeline, self.programs = pipeline, programs

    def play(self, tape, cells, seed, progress):
        p, start = self.pipeline, perf_counter()
        at = [0] * len(p.inputs)
        found = [([], []) for _ in p.outputs]
        for time, key in zip(tape.time.tolist(), tape.key.tolist()):
            program = self.programs[key]
            env = dict(program.constants) | {p.time: np.int64(time), p.seed: seed}
            env.update(zip([c.read for r in p.registers for c in r.cells], cells))
            for k, port in enumerate(p.inputs):
                blank = [np.zeros(leaf.shape) for leaf in port.leaves]
                here = key >> k & 1
                values = [a[at[k]] for a in tape.series[k].leaves.values()] if here else blank
                env.update(zip([leaf.value for leaf in port.leaves], values))
                at[k] += here
            for i in program.instructions:
                env[i.out] = evaluate(i, *(env[a] for a in i.args))
            cells = [env[n] for n in program.writes]
            for (times, rows), (flag, leaves) in zip(found, program.outputs):
                if flag is not None and env.get(flag, True):
                    times.append(time)
                    rows.append([env[n] for n in leaves])
            if progress is not None:
                progress.update(1, time)
        outputs = [(np.asarray(t, np.int64), [np.asarray(c) for c in zip(*rows)]) for t, rows in found]
        return Outcome(cells, outputs, perf_counter() - start)


ENGINE = Toy()
'''

USE = """
import sys
import numpy as np
import toy_engine
from flowgraph import find_graph, load_flight, lower, simulate, simulate_many
from flowgraph.study import Study, read_table, run_study

if __name__ == "__main__":
    case = find_graph("kalman").case(load_flight("sim", settings={"duration": "0.5"}))
    ours, theirs = (simulate(case.graph, case.inputs, engine=e) for e in ("reference", "toy"))
    assert theirs.engine == "toy" and toy_engine.CALLS == ["prepare"]
    for leaf, array in ours["belief"].leaves.items():
        np.testing.assert_array_equal(array, theirs["belief"].leaves[leaf])
    loaded = lower(case.graph).run(case.inputs, engine="toy")
    np.testing.assert_array_equal(loaded["belief"]["position"], ours["belief"]["position"])
    batch = simulate_many(case.graph, case.inputs, range(3), engine="toy", keep=["belief.position"])
    assert toy_engine.CALLS[-2:] == ["many", "prepare"]
    np.testing.assert_array_equal(batch["belief"].position[2], ours["belief"]["position"])
    study = Study(graphs=["kalman"], data=["sim"], seeds=2, parameters={"duration": 3.0}, engine="toy")
    done = run_study(study, sys.argv[1], workers=2)
    assert not done.failed and len(done.rows) == 2
    print("all of it")
"""


@pytest.fixture
def toy(tmp_path: Path) -> dict[str, str]:
    """The environment of a process that has the toy's package installed."""
    folder = tmp_path / "site"
    info = folder / "toy_engine-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "toy_engine.py").write_text(TOY)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-engine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\ntoy = toy_engine:ENGINE\nbroken = toy_engine:CALLS\n")
    return {**os.environ, "PYTHONPATH": str(folder)}


def ran(toy: dict[str, str], *command: str) -> Any:
    return subprocess.run(command, env=toy, capture_output=True, text=True, timeout=600)


FLOWGRAPH = str(Path(sys.executable).with_name("flowgraph"))


def test_a_package_brings_an_engine_for_runs_many_runs_and_studies(toy, tmp_path):
    program = tmp_path / "use.py"
    program.write_text(textwrap.dedent(USE))
    done = ran(toy, sys.executable, str(program), str(tmp_path / "study"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "all of it"


def test_the_command_runs_it(toy):
    arguments = [FLOWGRAPH, "run", "kalman", "--data", "sim", "--set", "duration=3", "--json"]
    ours, theirs = (ran(toy, *arguments, "--engine", e) for e in ("reference", "toy"))
    assert theirs.returncode == 0, theirs.stderr
    a, b = (json.loads(r.stdout) for r in (ours, theirs))
    assert b["engine"] == "toy"
    assert a["position_rmse_m"] == b["position_rmse_m"]
    refused = ran(toy, *arguments, "--engine", "toy", "--dtype", "float32")
    assert refused.returncode == 2
    assert "the toy engine computes in float64" in refused.stderr


def test_what_is_no_engine_is_refused_by_name(toy):
    done = ran(toy, FLOWGRAPH, "run", "kalman", "--data", "sim", "--engine", "broken")
    assert done.returncode != 0
    assert "what is installed under this name is no engine" in done.stderr


def test_ours_are_found_the_same_way():
    assert {"python", "reference", "xla", "c"} <= set(engine_names())
    assert isinstance(find_engine("python"), BlockEngine)
    assert isinstance(find_engine("c"), PipelineEngine)
    assert "c" in writers()
    assert {"verilog", "hls"} <= set(writers())
    with pytest.raises(UnknownNameError, match="no engine is called 'matlab'"):
        find_engine("matlab")
    with pytest.raises(UnknownNameError, match="no engine of a pipeline is called 'python'"):
        find_pipeline_engine("python")


def test_options_are_checked_once():
    assert RunOptions(engine="c").but(seed=3) == RunOptions(engine="c", seed=3)
    for wrong in ({"dtype": "float16"}, {"passes": ["fast"]}):
        with pytest.raises(UnknownNameError):
            RunOptions(**wrong)  # type: ignore[arg-type]
    with pytest.raises(DeclarationError, match="seed"):
        RunOptions(seed=-1)
