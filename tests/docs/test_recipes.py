"""The recipes of the architecture page for other packages, installed and used as they stand there."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import (
    Batch,
    FifoOverflowError,
    Flight,
    Scalar,
    Stream,
    find_graph,
    graph,
    load_flight,
    lower,
    match,
    simulate,
    simulate_many,
)
from flowgraph.cli import app
from flowgraph.study import InProcess, Study, read_table, run_study
from tests.support import MS, Install, same, scalars

PAGE = Path(__file__).resolve().parents[2] / "docs" / "architecture.md"


@pytest.fixture
def recipe(install: Install) -> Any:
    """Install what a recipe shows: its code as the package that its entry points name."""

    def followed(name: str) -> None:
        text = PAGE.read_text(encoding="utf-8").split(f"<!-- recipe: {name} -->")[1].split("\n### ")[0]
        code, project = (re.search(rf"^```{k}\n(.*?)^```$", text, re.M | re.S) for k in ("python", "toml"))
        assert code is not None
        assert project is not None
        points = tomllib.loads(project[1])["project"]["entry-points"]
        install("my-package", {"my_package": code[1]}, points)

    return followed


def command(*arguments: str) -> Any:
    done = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, arguments)
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout)


# -- a dataset -------------------------------------------------------------------------------------------


def test_a_dataset_is_found_and_a_filter_runs_on_it(recipe: Any, tmp_path: Path) -> None:
    recipe("dataset")
    known = load_flight("sim", seed=2, settings={"duration": "3"})
    imu, vicon = known.streams["imu"], known.streams["vicon"]
    file = tmp_path / "flight.npz"
    np.savez(
        file,
        t=imu.time,
        gyro=imu["gyro"],
        force=imu["specific_force"],
        t_fix=vicon.time,
        fix=vicon["position"],
    )
    assert "npz" in command("list", "--json")["data"]
    flight = load_flight(f"npz:{file}")
    np.testing.assert_array_equal(flight.streams["imu"]["gyro"], imu["gyro"])
    case = find_graph("ins_eskf").case(flight)
    belief = simulate(case.graph, case.inputs)["belief"]
    assert np.abs(belief["position"][-1] - known.truth["position"][-1]).max() < 0.1  # type: ignore[index]


# -- an engine -------------------------------------------------------------------------------------------


@pytest.fixture
def toy(recipe: Any) -> None:
    recipe("engine")


def flown(name: str, **settings: Any) -> Any:
    return find_graph(name).case(load_flight("sim", seed=1, settings={"duration": "2"}), **settings)


@pytest.mark.parametrize(("name", "settings"), [("ins_eskf", {}), ("rbpf_indoor", {"particles": 20})])
def test_an_engine_runs_graphs_to_the_bit_as_the_reference_does(
    toy: None, name: str, settings: dict[str, Any]
) -> None:
    """With the passes that it names: none of them changes a bit."""
    case = flown(name, **settings)
    same(
        simulate(case.graph, case.inputs, engine="toy", seed=3),
        simulate(case.graph, case.inputs, engine="reference", seed=3),
    )


def test_an_engine_goes_on_where_another_stopped(toy: None) -> None:
    case = flown("ins_eskf")
    streams = case.inputs.streams if isinstance(case.inputs, Flight) else case.inputs
    early = {n: s[s.time <= 1000 * MS] for n, s in streams.items()}
    late = {n: s[s.time > 1000 * MS] for n, s in streams.items()}
    for first, then in (("toy", "python"), ("python", "toy")):
        half = simulate(case.graph, early, engine=first)
        rest = simulate(case.graph, late, engine=then, state=half.state)
        whole = simulate(case.graph, case.inputs, engine="reference")
        np.testing.assert_allclose(rest["belief"]["position"][-1], whole["belief"]["position"][-1], atol=1e-9)


def test_an_engine_runs_many_seeds(toy: None) -> None:
    case = flown("rbpf_indoor", particles=20)
    found = simulate_many(case.graph, case.inputs, seeds=range(3), engine="toy")
    assert isinstance(found, Batch)
    for seed in range(3):
        alone = simulate(case.graph, case.inputs, engine="reference", seed=seed)
        np.testing.assert_array_equal(found["pose"].run(seed)["position"], alone["pose"]["position"])


def test_an_engine_plays_a_pipeline_without_its_graph_and_errors_of_queues_are_told(toy: None) -> None:
    @graph
    def paired(x: Stream[Scalar], y: Stream[Scalar]):
        return match(x, y, tolerance="1ms", size=2)

    pipeline = lower(paired.build())
    inputs = {"x": scalars([0, MS]), "y": scalars([0, MS])}
    assert pipeline.run(inputs, engine="toy").ticks == 2
    with pytest.raises(FifoOverflowError):
        pipeline.run({"x": scalars(np.arange(5) * MS), "y": scalars([9 * MS])}, engine="toy")


def test_an_engine_serves_a_study_and_the_command(toy: None, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    rows = {}
    for engine in ("toy", "reference"):
        study = Study(graphs=["ins_eskf"], data=["sim"], seeds=2, engine=engine, parameters={"duration": 2})
        run_study(study, tmp_path / engine, executor=InProcess())
        rows[engine] = [r["position_rmse_m"] for r in read_table(tmp_path / engine)]
    assert len(rows["toy"]) == 2
    assert rows["toy"] == rows["reference"]
    asked = ("run", "ins_eskf", "--data", "sim", "--set", "duration=2", "--seed", "0", "--json", "--engine")
    assert command(*asked, "toy")["position_rmse_m"] == command(*asked, "reference")["position_rmse_m"]
