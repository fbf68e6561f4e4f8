"""Slopes of a likelihood: those of differences, in one run; and what a search makes of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import DeclarationError
from flowgraph.cli import app
from flowgraph.study.coordinates import Coordinates
from flowgraph.study.search import Search
from flowgraph.study.trials import Trials
from flowgraph.study.tune import Fit, Recording, tune

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
CAR = f"{EXAMPLES / 'own_tracker.py'}:"

WALK = '''
"""A point that wanders on a line of two numbers, and is measured: its noises are matrices."""
import numpy as np
from flowgraph import Array, Flight, Series, Signal, Stream, graph, real
from flowgraph.blocks.filtering import DiscreteModel, LinearMeasurement, StateSpace, euclidean
from flowgraph.blocks.filtering import filtered, linear

class Seen(Signal):
    z: Array = real(2)

SPACE = StateSpace(x=euclidean(2))

@graph
def walk(seen: Stream[Seen], *, Q: np.ndarray = np.eye(2), R: np.ndarray = np.eye(2), size: float = 1.0):
    motion = DiscreteModel(np.eye(2), Q, space=SPACE)
    gauge = LinearMeasurement(SPACE, np.eye(2), noise=size * R)
    start = SPACE.gaussian(x=((0.0, 0.0), 1.0))
    return filtered(motion, {gauge: seen}, start=start, method=linear())

def wander(*, seed: int = 0, count: int = 200) -> Flight:
    rng = np.random.default_rng(seed)
    Q, R = np.array([[0.5, 0.2], [0.2, 0.3]]), np.array([[0.4, -0.1], [-0.1, 0.6]])
    x = np.cumsum(rng.multivariate_normal(np.zeros(2), Q, count), axis=0)
    z = x + rng.multivariate_normal(np.zeros(2), R, count)
    return Flight("walk", {"seen": Series(np.arange(count) * 10**9, Seen(z=z))})
'''


@pytest.fixture
def walk(tmp_path: Path) -> str:
    (tmp_path / "walk.py").write_text(WALK)
    return f"{tmp_path / 'walk.py'}:"


def searched(graph: str, data: str, fits: list[Fit], start: dict[str, Any], settings: dict[str, Any]) -> Any:
    trials = Trials(graph, [Recording(data)], settings, "likelihood", None, "reference")
    return [Search(trials, Coordinates(fits, start), [0], forward=forward) for forward in (True, False)]


def test_slopes_of_an_own_filter_are_those_of_differences():
    fits = [Fit("fix_noise", 0.2, 20.0), Fit("turn_noise", 1e-3, 1.0), Fit("push_noise", 0.01, 5.0)]
    start = {"fix_noise": 3.0, "turn_noise": 0.05, "push_noise": 0.3}
    forward, differences = searched(CAR + "tracker", CAR + "drive", fits, start, {"duration": 6.0})
    (value, slope), (other, wanted) = (s.with_slope(s.at.start) for s in (forward, differences))
    assert value == pytest.approx(other, rel=1e-12)
    np.testing.assert_allclose(slope, wanted, rtol=1e-4, atol=1e-6)
    assert (forward.count, differences.count) == (1, 7)
    assert np.abs(slope).min() > 1e-3  # each of them matters here


def test_slopes_by_matrices_are_those_of_differences_also_where_constants_are_equal(walk: str):
    """Q and R are both the identity at the start, as one constant of the pipeline."""
    fits = [Fit("Q", 0.01, 10.0), Fit("R", 0.01, 10.0)]
    start = {"Q": np.eye(2), "R": np.eye(2)}
    forward, differences = searched(walk + "walk", walk + "wander", fits, start, {})
    assert len(forward.at.start) == 6
    (value, slope), (other, wanted) = (s.with_slope(s.at.start) for s in (forward, differences))
    assert value == pytest.approx(other, abs=1e-8)
    np.testing.assert_allclose(slope, wanted, rtol=1e-4, atol=1e-6)
    assert forward.count == 1


@pytest.mark.slow
def test_covariances_are_found_within_their_deviations_with_a_third_of_the_points(walk: str):
    true = {"Q": [[0.5, 0.2], [0.2, 0.3]], "R": [[0.4, -0.1], [-0.1, 0.6]]}
    fits = [Fit("Q", 0.01, 10.0), Fit("R", 0.01, 10.0)]
    how: Any = {"settings": {"count": 250}, "most": 400}
    found = tune(walk + "walk", fits, [Recording(walk + "wander")], **how)
    assert found.converged
    for name, wanted in true.items():
        assert np.abs((found.parameters[name] - np.array(wanted)) / found.deviations[name]).max() < 3.0
        assert found.deviations[name].max() < 0.25
    other = tune(walk + "walk", fits, [Recording(walk + "wander")], slopes="differences", **how)
    np.testing.assert_allclose(found.parameters["Q"], other.parameters["Q"], rtol=0.02, atol=0.005)
    np.testing.assert_allclose(found.deviations["Q"], other.deviations["Q"], rtol=0.1)
    assert 3 * found.evaluations <= other.evaluations


@pytest.mark.slow
def test_simulated_noises_are_found_within_a_tenth_and_two_of_their_deviations():
    fits = [Fit("fix_noise", 0.2, 20.0, 6.0), Fit("turn_noise", 1e-3, 1.0, 0.1), Fit("push_noise", 0.01, 5.0)]
    found = tune(
        CAR + "tracker", fits, [Recording(CAR + "drive", 3)], settings={"duration": 1500.0}, engine="c"
    )
    for name, true in {"fix_noise": 2.0, "turn_noise": 0.02, "push_noise": 0.2}.items():
        assert found.parameters[name] == pytest.approx(true, rel=0.1), name
        assert abs(found.parameters[name] - true) < 2.0 * found.deviations[name], name


def test_coordinates_come_back_and_keep_their_bounds():
    S = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, -0.3], [0.1, -0.3, 0.7]])
    fits = [
        Fit("a", 0.1, 10.0), Fit("S", 1e-3, 1e3), Fit("v", 0.01, 5.0), Fit("o", -1.0, 3.0, scale="linear"),
    ]  # fmt: skip
    start: dict[str, Any] = {"a": 0.7, "S": S, "v": np.array([0.2, 4.0]), "o": -0.25}
    at = Coordinates(fits, start)
    assert at.owners == ["a", *["S"] * 6, "v", "v", "o"]
    back = at.decode(at.start)
    for name, value in start.items():
        np.testing.assert_allclose(back[name], value, rtol=1e-12)
    assert (at.low <= at.start).all()
    assert (at.start <= at.high).all()
    assert at.decode(at.low)["a"] == pytest.approx(0.1)
    assert at.decode(at.high)["o"] == pytest.approx(3.0)
    covariance = np.diag(np.full(len(at.start), 0.01**2))
    deviations = at.deviations(at.start, covariance)
    assert deviations["a"] == pytest.approx(0.007)
    assert deviations["o"] == pytest.approx(0.04)
    assert deviations["S"].shape == (3, 3)
    covariance[0, 0] = np.nan
    assert at.deviations(at.start, covariance)["a"] is None


def test_a_start_that_is_no_covariance_is_refused(walk: str):
    start = np.array([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(DeclarationError, match="a start that is a covariance"):
        tune(walk + "walk", [Fit("Q", 0.1, 1.0, start)], [Recording(walk + "wander")])


def test_run_reads_what_tune_found(walk: str, tmp_path: Path):
    runner = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"})
    file = tmp_path / "found.json"
    words = [walk + "walk", "--data", walk + "wander", "--set", "count=60"]
    done = runner.invoke(app, ["tune", *words, "--fit", "size=0.1:10", "--out", str(file), "--json"])
    assert done.exit_code == 0, done.output
    one = json.loads(file.read_text())["parameters"]["size"]
    assert 0.2 < one["value"] < 5.0
    assert 0.0 < one["deviation"] < one["value"]
    runs = [
        json.loads(runner.invoke(app, ["run", *words, "--json", *more]).stdout)["nis_mean"]
        for more in ([], ["--settings", str(file)], ["--settings", str(file), "--set", "size=1.0"])
    ]
    assert runs[0] == runs[2] != runs[1]
    for text in (
        "[]",
        "{",
        '{"parameters": {"size": {"value": ["x"], "deviation": 1}}}',
        *(
            f'{{"parameters": {{"size": {one}}}}}'
            for one in ('{"valu": 1}', "null", '{"value": NaN}', "[1, null]")
        ),
    ):
        file.write_text(text)
        wrong = runner.invoke(app, ["run", *words, "--settings", str(file)])
        assert wrong.exit_code == 1
        assert "these are no settings" in wrong.stderr
    gone = runner.invoke(app, ["run", *words, "--settings", str(tmp_path / "gone.json")])
    assert gone.exit_code == 1
    assert "these are no settings" in gone.stderr
