"""What the page of a run is given: thinned lines with their peaks, scales, warnings, wires, clouds."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import Array, DataError, Result, Series, Signal, Stream, block, graph, latest, periodic, real
from flowgraph.drawing import recorder as recorders
from flowgraph.drawing.consistency import bounds, covariance_of, error_of, is_far, nees, places
from flowgraph.drawing.recorder import Recorder
from flowgraph.drawing.run_page import describe_run, run_page, runs_of_page
from flowgraph.drawing.scopes import POINTS, Scopes, extremes
from flowgraph.engines.watched import simulate_watched
from flowgraph.types import Scalar
from tests.drawing.test_page import HOSTILE, _Reader
from tests.support import MS, scalars


class Belief(Signal):
    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    covariance: Array = real(9, 9)


class Truth(Signal):
    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")


class Innovation(Signal):
    residual: Array = real(2, unit="m")
    covariance: Array = real(2, 2)
    nis: Array = real()
    parts: Array = real()


def numbers(packed: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed), "<f4")


def turned(vector: np.ndarray) -> np.ndarray:
    """(n, 4) quaternions of (n, 3) rotation vectors."""
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    share = np.where(angle > 0, np.sin(angle / 2) / np.where(angle > 0, angle, 1), 0.5)
    return np.concatenate([np.cos(angle / 2), vector * share], axis=1)


def flown(n: int = 2000, size: float = 1.0, seed: int = 0) -> tuple[Series, Series]:
    """A belief with errors drawn from `size` times its covariance, and the truth, which stands still."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * 5 * MS
    deviations = np.array([0.1] * 3 + [0.2] * 3 + [0.01] * 3)
    error = size * deviations * rng.standard_normal((n, 9))
    unit = np.tile([1.0, 0, 0, 0], (n, 1))
    truth = Series(time, Truth(np.zeros((n, 3)), np.zeros((n, 3)), unit), name="truth")
    P = np.tile(np.diag(deviations**2), (n, 1, 1))
    belief = Belief(error[:, :3], error[:, 3:6], turned(error[:, 6:]), P)
    return Series(time, belief, name="belief"), truth


def result_of(**series: Series) -> Result:
    return Result("filter", "python", series, {}, {}, 10, 0.1)


def panels_of(scopes: Scopes) -> dict[str, dict[str, Any]]:
    return {panel["title"]: panel for panel in scopes.panels()}


def test_thinning_keeps_every_peak_both_ends_and_gaps() -> None:
    rng = np.random.default_rng(1)
    values = rng.standard_normal(40_000)
    values[[17, 23_456]] = 50.0, -60.0
    values[30_000:30_010] = np.nan
    kept = extremes([values], POINTS)
    assert len(kept) <= 1.1 * POINTS
    assert {0, 17, 23_456, 39_999} <= set(kept)
    assert (np.diff(kept) > 0).all()
    assert np.isnan(values[kept]).any()
    for part in np.array_split(np.arange(40_000), 1280):  # a screen's pixels, about
        inside = kept[(kept >= part[0] - 15) & (kept <= part[-1] + 15)]
        assert np.nanmax(values[part]) <= np.nanmax(values[inside])
        assert np.nanmin(values[part]) >= np.nanmin(values[inside])
    assert (extremes([values[:100], values[:100]], POINTS) == np.arange(100)).all()
    assert len(extremes([], POINTS)) == 0


def test_errors_have_bands_of_three_deviations_in_the_unit_that_is_written() -> None:
    belief, truth = flown()
    panels = panels_of(Scopes(result_of(belief=belief), "belief", truth))
    x = panels["position error x"]
    assert x["group"] == "Errors"
    assert x["unit"] == "[m, world]"
    np.testing.assert_allclose(numbers(x["sigma"]), 0.3, rtol=1e-6)
    np.testing.assert_allclose(numbers(x["lines"][0]["y"]), belief["position"][:, 0], rtol=1e-6)
    turn = panels["attitude error x, in the body"]
    assert turn["unit"] == "[deg]"
    np.testing.assert_allclose(numbers(turn["sigma"]), np.rad2deg(0.03), rtol=1e-6)
    np.testing.assert_allclose(np.std(numbers(turn["lines"][0]["y"])), np.rad2deg(0.01), rtol=0.1)
    assert "roll" in panels
    assert [line["name"] for line in panels["velocity y"]["lines"]] == ["estimate", "truth"]


def test_a_scale_is_of_what_comes_after_the_start_and_says_what_the_start_reached() -> None:
    belief, truth = flown()
    position = np.array(belief["position"])
    position[3, 0] = 80.0
    early = Series(belief.time, belief.values.replace(position=position), name="belief")
    panel = panels_of(Scopes(result_of(belief=early), "belief", truth))["position error x"]
    assert panel["range"][1] < 1.0
    assert panel["words"].startswith("the start reaches ")
    assert panel["words"].endswith(" to 80")
    assert panel["whole"][1] >= 80


def test_what_only_moves_on_is_shown_whole() -> None:
    belief, _ = flown()
    position = np.array(belief["position"]) + np.linspace(0.0, 100.0, len(belief))[:, None]
    moving = Series(belief.time, belief.values.replace(position=position), name="belief")
    panel = panels_of(Scopes(result_of(belief=moving), "belief", None))["position x"]
    assert "words" not in panel
    assert panel["range"][0] <= position[:, 0].min()
    assert panel["range"][1] >= position[:, 0].max()


@pytest.mark.parametrize(("size", "warned"), [(1.0, False), (2.0, True), (0.5, True)])
def test_a_filter_that_is_wrong_about_itself_is_a_warning(size: float, warned: bool) -> None:
    belief, truth = flown(size=size)
    value, degrees = nees(belief, truth) or (np.zeros(1), 0)
    assert degrees == 9
    assert np.mean(value) == pytest.approx(9 * size**2, rel=0.05)
    scopes = Scopes(result_of(belief=belief), "belief", truth)
    panel = panels_of(scopes)["belief: NEES"]
    assert panel["wrong"] is warned
    np.testing.assert_allclose(
        panel["bounds"], [2.7004, 19.0228], rtol=1e-4
    )  # chi-squared of 9, 2.5 and 97.5 %
    assert [n.partition(":")[0] for n in scopes.notes] == ["warning"] * warned


@pytest.mark.parametrize(
    ("mean", "numbers_in_all", "far"),
    [(0.2, 6, False), (0.2, 600, True), (1.9, 600, False), (2.2, 600, True), (2.2, 8, False), (9.0, 8, True)],
)
def test_a_few_squares_may_be_small_by_chance(mean: float, numbers_in_all: int, far: bool) -> None:
    assert is_far(mean, numbers_in_all) is far


def test_innovations_and_their_nis() -> None:
    rng = np.random.default_rng(2)
    n, S = 500, np.array([[0.04, 0.01], [0.01, 0.09]])
    residual = rng.multivariate_normal(np.zeros(2), S, n)
    nis = np.einsum("ni,ij,nj->n", residual, np.linalg.inv(S), residual)
    value = Innovation(residual, np.tile(S, (n, 1, 1)), nis, np.full(n, 2.0))
    scopes = Scopes(result_of(fix_innovation=Series(np.arange(n) * MS, value, name="fix")), "belief")
    panels = panels_of(scopes)
    assert list(panels) == ["fix innovation 1", "fix innovation 2", "fix innovation: NIS"]
    np.testing.assert_allclose(numbers(panels["fix innovation 2"]["sigma"]), 0.9, rtol=1e-6)
    assert panels["fix innovation: NIS"]["words"].startswith(f"mean {nis.mean() / 2:.3g} of 1")
    assert scopes.notes == []


def test_what_is_not_there_is_not_plotted() -> None:
    belief, truth = flown(50)
    empty = Series(np.zeros(0, np.int64), np.zeros(0), name="none")
    assert Scopes(result_of(belief=belief, none=empty), "belief", None).panels()[0]["group"] == "Estimate"
    assert Scopes(result_of(none=empty), "none", truth).panels() == []
    assert error_of(belief, truth, "gyro_bias") is None
    nothing = Series(belief.time, belief.values.replace(position=np.full((50, 3), np.nan)), name="belief")
    panel = panels_of(Scopes(result_of(belief=nothing), "belief", None))["position x"]
    assert panel["words"] == "none of 50 values is finite"


def test_where_errors_stand_in_a_covariance() -> None:
    belief, _ = flown(5)
    assert places(belief) == {"position": 0, "velocity": 3, "attitude": 6}
    attitude = covariance_of(belief, "attitude")
    assert attitude is not None
    np.testing.assert_allclose(attitude[0], 1e-4 * np.eye(3))
    assert places(scalars([0, 1])) == {}
    assert bounds(2) == pytest.approx((0.05064, 7.3778), rel=1e-4)


class Points(Signal):
    log_weight: Array = real("particles")
    position: Array = real(2, "particles", unit="m", frame="world")


class Matrix(Signal):
    small: Array = real(2)
    square: Array = real(4, 4)
    wide: Array = real(3, 5)


@block
def spread(value: Scalar) -> Points:
    """Particles about a value."""
    return Points(np.zeros(700), value + np.arange(1400.0).reshape(2, 700))


@block
def shaped(value: Scalar) -> Matrix:
    return Matrix(np.array([1.0, 2.0]) * value, value**2 * np.eye(4), value + np.arange(15.0).reshape(3, 5))


@graph
def clouds(a: Stream[Scalar]):
    held = latest(a, init=0.0, name="held")
    return {"points": spread(a, name="spread"), "shaped": shaped(held, at=a, name="shaped")}


def recorded(n: int) -> tuple[Any, Recorder, Result]:
    built = clouds.build(a=periodic("5ms"), sizes={"particles": 700})
    inputs = {"a": scalars(np.arange(n) * 5 * MS)}
    recorder = Recorder(built, inputs)
    return built, recorder, simulate_watched(built, inputs, recorder)


def test_a_recorder_keeps_small_arrays_roots_ranges_and_some_particles() -> None:
    built, recorder, _ = recorded(30)
    data = recorder.data(0)
    index = [node.path for node in built.nodes].index("shaped")
    wire = data["wires"][f"{index}.0"]
    assert [(p["name"], p["way"], p["size"]) for p in wire["parts"]] == [
        ("small", "whole", 2), ("square", "deviation", 4), ("wide", "range", 2),
    ]  # fmt: skip
    values = numbers(wire["values"]).reshape(-1, 8)
    k = np.arange(1.0, 31.0)
    np.testing.assert_allclose(values, np.stack([k, 2 * k, *[k] * 4, k, k + 14], axis=1), rtol=1e-6)
    np.testing.assert_allclose(numbers(data["times"]), np.arange(30) * 5e-3, atol=1e-6)
    held = [node.path for node in built.nodes].index("held")
    np.testing.assert_allclose(numbers(data["wires"][f"{held}.0"]["values"]), k)
    cloud = data["cloud"]
    assert (cloud["name"], cloud["of"], cloud["size"]) == ("spread", 700, 234)
    first = numbers(cloud["places"]).reshape(-1, 234, 3)[0]
    np.testing.assert_allclose(first[1], [4.0, 704.0, 0.0])


def test_a_recorder_stays_small_however_long_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorders, "NUMBERS", 1)  # then 120 ticks are kept, to 240
    _, known, _ = recorded(1000)
    assert known.stride == 8
    monkeypatch.setattr(Recorder, "_ticks", lambda self: 0)
    _, unknown, _ = recorded(1000)
    for recorder in (known, unknown):
        times = numbers(recorder.data(0)["times"])
        assert 100 <= len(times) < 240
        np.testing.assert_allclose(np.diff(times), recorder.stride * 5e-3, rtol=1e-3)


def test_pages_hold_several_runs_and_give_them_back(tmp_path: Path) -> None:
    built, recorder, result = recorded(30)
    one = describe_run(
        built,
        result,
        title=HOSTILE,
        estimate="points",
        recorder=recorder,
        notes=[HOSTILE],
        figures={"x": 0.5},
    )
    file = tmp_path / "run.html"
    run_page([one], file)
    two = describe_run(built, result, title="second", estimate="points")
    run_page([*runs_of_page(file), two], file)
    reader = _Reader(file.read_text())
    assert [tag for tag, _ in reader.tags].count("script") == 3
    runs = reader.data("runs")
    assert [run["title"] for run in runs] == [HOSTILE, "second"]
    assert runs[0]["notes"] == [HOSTILE]
    assert runs[0]["figures"] == [["x", "0.5"]]
    assert runs[0]["blocks"]["spread"][1] == 30
    assert runs[1]["watch"] is None
    assert json.loads(json.dumps(one)) == runs[0]
    (tmp_path / "other.html").write_text("<html></html>")
    with pytest.raises(DataError, match="there are no runs in this file"):
        runs_of_page(tmp_path / "other.html")


def test_the_way_knows_satellite_receivers_and_planes() -> None:
    belief, truth = flown(200)
    fixes = Series(belief.time[::50], Truth(*(v[::50] for v in truth.leaves.values())), name="gps")
    built, _, _ = recorded(2)
    made = describe_run(
        built, result_of(belief=belief), title="", estimate="belief", truth=truth, inputs={"gps": fixes}
    )
    way = made["way"]
    np.testing.assert_allclose(numbers(way["estimate"]).reshape(-1, 3), belief["position"], rtol=1e-6)
    assert [(s["name"], s["gnss"]) for s in way["seen"]] == [("gps", True)]
    assert describe_run(built, result_of(), title="", estimate="belief")["way"] is None
