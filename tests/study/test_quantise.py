"""Number formats that are found: the narrowest words that keep the bounds on other flights, or a refusal."""

from __future__ import annotations

import json
from typing import Annotated, Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import (
    DeclarationError,
    LoweringError,
    Scalar,
    Stream,
    UnknownNameError,
    block,
    boolean,
    delay,
    graph,
    real,
    simulate,
)
from flowgraph.blocks.geometry import lanes
from flowgraph.cli import app
from flowgraph.pipeline.format_files import load_formats
from flowgraph.study.differences import DECISIONS, RELATIVE, differences
from flowgraph.study.quantise import Flown, quantise

MS = 1_000_000


Flag = Annotated[Any, boolean()]


@block
def above(y: Scalar) -> Flag:
    """A decision."""
    return y > 0.3


@block
def curve(x: Scalar, *, xp) -> Scalar:
    """A smooth function."""
    return xp.sin(x) / (1.5 + xp.cos(3.0 * x)) + 0.1 * x * x


@graph
def curved(x: Stream[Scalar]):
    """A function, and whether it is large."""
    y = curve(x)
    return {"y": y, "above": above(y)}


def flown(seed, scale=1.0):
    x = scale * np.random.default_rng(seed).uniform(-2.0, 2.0, 200)
    return Flown(curved.build(), {"x": (np.arange(200, dtype=np.int64) * MS, x)}, "y")


def test_the_narrowest_words_that_keep_the_bound():
    found = quantise([flown(0), flown(1)], [flown(2)], width=28, bounds={RELATIVE: 1e-4})
    assert found.figures["saturations"] == 0
    assert found.figures[RELATIVE] <= 1e-4
    bits = found.formats.width
    assert 10 < bits < 24
    tried = {row["bits"]: row for row in found.tried}
    assert tried[bits]["holds"]
    assert not tried[bits - 1]["holds"]
    assert tried[28][RELATIVE] < 1e-2 * tried[bits][RELATIVE]  # each bit halves it
    flight = flown(2)
    ours = simulate(flight.graph, flight.inputs, engine="fixed", formats=found.formats)
    real = simulate(flight.graph, flight.inputs, engine="reference")
    assert differences(real, ours.series, "y")[RELATIVE] == found.figures[RELATIVE]
    named = {row["value"]: row["name"] for row in found.values()}
    assert any("test_quantise" in name for name in named.values())
    bound = {row["name"].split()[1].rstrip(","): row["bound"] for row in found.values()}
    assert bound["sin"] == bound["cos"] == "proven"
    assert bound["input"] == "observed"


def test_decisions_that_differ_are_counted():
    found = quantise([flown(0)], [flown(3)], width=8, least=8, bounds={DECISIONS: 200})
    assert 0 < found.figures[DECISIONS] < 60
    with pytest.raises(LoweringError, match="(?s)cannot be trusted at 8 bits.*decisions_differing <= 0"):
        quantise([flown(0)], [flown(3)], width=8, bounds={DECISIONS: 0})


def test_a_flight_elsewhere_widens_what_saturates_and_says_so():
    found = quantise([flown(0)], [flown(1, scale=3.0)], width=24, least=24, bounds={RELATIVE: 1e-2})
    assert found.figures["saturations"] == 0
    assert any("flights held out" in note and "input x" in note for note in found.notes)


def test_a_width_is_judged_by_itself_whatever_was_tried_before():
    flights, judge = [flown(0), flown(1)], [flown(2, scale=1.5)]
    searched = quantise(flights, judge, width=28, bounds={RELATIVE: 1e-4})
    alone = quantise(
        flights, judge, width=searched.formats.width, least=searched.formats.width, bounds={RELATIVE: 1e-4}
    )
    assert alone.figures == searched.figures
    assert alone.formats.to_json() == searched.formats.to_json()


@block
def over(x: Scalar, *, xp) -> Scalar:
    """A quotient by what words of few bits make zero."""
    return 1.0 / (x * x * x)


@graph
def quotients(x: Stream[Scalar]):
    """One block."""
    return {"y": over(x)}


def test_a_quotient_by_zero_is_not_widened_in_vain():
    x = np.where(np.arange(50) == 7, 1e-4, 3.0)
    flight = Flown(quotients.build(), {"x": (np.arange(50, dtype=np.int64) * MS, x)}, "y")
    said: list[str] = []
    with pytest.raises(LoweringError, match="(?s)cannot be trusted at 24 bits.*divide"):
        quantise([flight], [flight], width=24, bounds={DECISIONS: 0}, say=said.append)
    assert not any("widened" in words for words in said)


@block
def moved(x: Scalar, *, by: float, xp) -> Scalar:
    """With a number that is another on each flight."""
    return xp.sin(x - by)


@graph
def moving(x: Stream[Scalar], *, by: float):
    """A function about the place where a flight begins."""
    return {"y": moved(x, by=by)}


@pytest.mark.parametrize("places", [(0.3, 0.7, 1.9), (-1.3, 1.7, 0.3), (0.1, 2.3, -2.1)])
def test_each_flight_has_its_own_constants(places):
    def begun(seed, by):
        x = by + np.random.default_rng(seed).uniform(-1.0, 1.0, 100)
        return Flown(moving.build(by=by), {"x": (np.arange(100, dtype=np.int64) * MS, x)}, "y")

    first, second, judge = (begun(seed, by) for seed, by in enumerate(places))
    found = quantise([first, second], [judge], width=24, least=24, bounds={RELATIVE: 1e-5})
    assert found.figures["saturations"] == 0
    ours = simulate(judge.graph, judge.inputs, engine="fixed", formats=found.formats)
    real = simulate(judge.graph, judge.inputs, engine="reference")
    assert 0.0 < differences(real, ours.series, "y")[RELATIVE] == found.figures[RELATIVE]


Attitudes = Annotated[Any, real(4, 3)]


@block
def turned_on(q: Attitudes, rate: Annotated[Any, real(3)], *, dt: float, xp) -> Attitudes:
    """Three attitudes that turn at one rate."""
    return lanes.turned(q, rate[:, None] * dt + xp.zeros((3, 3), dtype=q.dtype), xp=xp)


@graph
def spinning(rate: Stream[Annotated[Any, real(3)]], *, start: Any):
    """Attitudes over time."""
    q = delay(start, name="q")
    now = turned_on(q, rate)
    q.feed(now)
    return {"q": now}


@pytest.mark.parametrize("rate", [(0.3, -0.2, 1.0), (2.0, 1.0, -3.0), (0.0, 0.0, 0.05)])
def test_attitudes_that_are_held_in_wide_words_are_rounded_to_those(rate):
    """A product of two attitudes in words of 20 bits would be off by 2^-19 at each of 1,000 turns."""
    start = np.array([[1.0, 0.0, 0.6], [0.0, 0.6, 0.0], [0.0, 0.0, 0.8], [0.0, -0.8, 0.0]])

    def turning(seed):
        rates = np.array(rate) * (1.0 + 0.1 * np.random.default_rng(seed).normal(size=(1000, 1)))
        inputs = {"rate": (np.arange(1000, dtype=np.int64) * 5 * MS, rates)}
        return Flown(spinning.build(start=start), inputs, "q")

    narrow, wide = (
        quantise([turning(0)], [turning(1)], width=20, least=20, held_width=held, bounds={RELATIVE: 1.0})
        for held in (0, 28)
    )
    assert narrow.figures["saturations"] == wide.figures["saturations"] == 0
    assert wide.figures[RELATIVE] < 1.2e-5 < 2e-5 < narrow.figures[RELATIVE]


@block
def looked_at(x: Scalar, *, xp) -> tuple[Scalar, Scalar]:
    """Something that is judged, of which one part needs bits, and something that is not judged."""
    near = xp.sin(x) - xp.sin(x - 1e-3)
    return near + 1e-3 * xp.cos(x), xp.exp(0.1 * x) * xp.cos(2.0 * x)


@graph
def looking(x: Stream[Scalar]):
    """One block."""
    y, aside = looked_at(x)
    return {"y": y, "aside": aside}


def looked(seed):
    x = np.random.default_rng(seed).uniform(-2.0, 2.0, 200)
    return Flown(looking.build(), {"x": (np.arange(200, dtype=np.int64) * MS, x)}, "y")


def widened(**options):
    said: list[str] = []
    found = quantise(
        [looked(0)], [looked(2)], width=16, least=16, bounds={RELATIVE: 1e-4}, say=said.append, **options
    )
    return found, said


def test_few_values_get_wider_words_where_that_keeps_the_bound():
    with pytest.raises(LoweringError, match="cannot be trusted at 16 bits"):
        widened()
    found, said = widened(widen=26)
    assert found.figures["saturations"] == 0
    assert found.figures[RELATIVE] <= 1e-4
    count = found.figures["wide_values"]
    bits: dict[str, set[int]] = {}
    for row in found.values():
        bits.setdefault(row["name"].split()[1].rstrip(","), set()).add(row["bits"])
    assert 0 < count < len(found.values()) - 3
    assert sorted(found.formats.by_width()) == [26]
    assert len(found.formats.wider) == count
    assert bits["sin"] == {26}
    assert bits["exp"] == {16}  # it is not judged
    (note,) = (words for words in found.notes if "values have 26 bits" in words)
    assert note.startswith(f"{count} of {len(found.values())} values have 26 bits beside 16: ")
    assert "tests.study.test_quantise:" in note
    assert any("does not hold" in words for words in said)
    again, _ = widened(widen=26)
    assert again.formats.to_json() == found.formats.to_json()
    flight = looked(2)
    ours = simulate(flight.graph, flight.inputs, formats=found.formats, engine="fixed")
    theirs = simulate(flight.graph, flight.inputs, formats=found.formats, engine="c", dtype="fixed")
    np.testing.assert_array_equal(ours.y.value, theirs.y.value)
    real = simulate(flight.graph, flight.inputs, engine="reference")
    assert differences(real, ours.series, "y")[RELATIVE] == found.figures[RELATIVE]


def test_where_the_bound_holds_nothing_is_widened_and_where_it_cannot_it_is_refused():
    found = quantise([looked(0)], [looked(2)], width=26, least=26, widen=30, bounds={RELATIVE: 1e-4})
    assert not found.formats.wider
    with pytest.raises(LoweringError, match="(?s)cannot be trusted at 16 bits.*wide_values"):
        widened(widen=17)
    for wrong in ({"widen": 16}, {"widen": 12}, {"widen": 33}):
        with pytest.raises(DeclarationError, match="(?s)cannot be widened to this.*17 to 32 bits"):
            widened(**wrong)
    with pytest.raises(DeclarationError, match="(?s)cannot be widened to this.*--width less than 32"):
        quantise([looked(0)], [looked(2)], width=32, widen=32, bounds={RELATIVE: 1e-4})


def test_a_bound_that_nobody_keeps_is_refused_with_a_place():
    with pytest.raises(
        LoweringError, match=r"(?s)cannot be trusted at 16 bits.*expected: .*<= 1e-12.*--width"
    ):
        quantise([flown(0)], [flown(1)], width=16, bounds={RELATIVE: 1e-12})


def test_what_is_asked_wrongly():
    with pytest.raises(UnknownNameError, match="position_difference_rms_m"):
        quantise([flown(0)], [flown(1)], bounds={"error": 1.0})
    with pytest.raises(DeclarationError, match="found on some flights and judged on others"):
        quantise([flown(0)], [], bounds={RELATIVE: 1.0})
    with pytest.raises(DeclarationError, match="(?s)no width can be tried.*8 to 20 bits.*24"):
        quantise([flown(0)], [flown(1)], width=20, least=24, bounds={RELATIVE: 1.0})
    refused: tuple[dict[str, Any], ...] = (
        {"width": 4},
        {"width": 64},
        {"width": 24, "held_width": 20},
        {"held_width": 64},
    )
    for wrong in refused:
        with pytest.raises(DeclarationError, match="no word has this width"):
            quantise([flown(0)], [flown(1)], bounds={RELATIVE: 1.0}, **wrong)


def test_the_command_writes_what_run_and_lower_read(tmp_path):
    run = CliRunner().invoke
    flight = ["--data", "sim", "--set", "duration=1"]
    asked = ["--seeds", "1", "--held-out-seeds", "1", "--width", "26", "--least", "26"]
    bound = ["--bound", "position_difference_rms_m=0.001"]
    made = run(app, ["quantise", "kalman", *flight, *asked, *bound, "-o", str(tmp_path / "f"), "--json"])
    assert made.exit_code == 0, made.output
    report = json.loads(made.stdout)
    assert report["bits"] == 26
    assert report["position_difference_rms_m"] <= 0.001
    assert report["saturations"] == report["decisions_differing"] == 0
    assert load_formats(tmp_path / "f").width == 26
    rows = [
        json.loads(run(app, ["run", "kalman", *flight, *how, "--json"]).stdout)
        for how in (
            ["--engine", "fixed", "--formats", str(tmp_path / "f")],
            ["--engine", "c", "--dtype", "fixed", "--formats", str(tmp_path / "f")],
            ["--engine", "reference"],
        )
    ]
    assert rows[0]["position_rmse_m"] == rows[1]["position_rmse_m"]
    assert abs(rows[0]["position_rmse_m"] - rows[2]["position_rmse_m"]) < 1e-3
    assert rows[0]["saturations"] == 0
    wrote = run(
        app, ["lower", "kalman", *flight, "--formats", str(tmp_path / "f"), "--target", "c",
              "--dtype", "fixed", "-o", str(tmp_path / "c")],
    )  # fmt: skip
    assert wrote.exit_code == 0, wrote.output
    assert {"pipeline.json", "kalman_fixed.c", "kalman_fixed.h"} <= {
        f.name for f in (tmp_path / "c").iterdir()
    }
    assert json.loads((tmp_path / "c" / "pipeline.json").read_text())["formats"]["width"] == 26
    cost = run(
        app, ["lower", "kalman", *flight, "--formats", str(tmp_path / "f"), "--report", "-o", str(tmp_path)]
    )
    assert cost.exit_code == 0, cost.output
    assert "Number formats" in (tmp_path / "report.txt").read_text()
    drawn = [(kind, tmp_path / f"drawn.{kind}") for kind in ("dot", "html")]
    for _, file in drawn:
        shown = run(app, ["show", "kalman", *flight, "--formats", str(tmp_path / "f"), "-o", str(file)])
        assert shown.exit_code == 0, shown.output
        assert "words of 26 bits" in file.read_text()
        assert "26 bits, fraction " in file.read_text()
    shown = run(app, ["show", "kalman", *flight, "--formats", str(tmp_path / "f")])
    assert "26 bits, fraction " in shown.output


def test_other_flights_may_judge_with_settings_of_their_own(tmp_path):
    flights = ["--data", "sim", "--set", "duration=1", "--seeds", "1", "--held-out-seeds", "1"]
    asked = ["--width", "26", "--least", "26", "--bound", "position_difference_rms_m=0.01"]
    others = ["--held-out-data", "sim", "--held-out-set", "duration=2"]

    def made(*how, to):
        run = CliRunner().invoke(
            app, ["quantise", "kalman", *flights, *asked, *how, "-o", str(tmp_path / to), "--json"]
        )
        assert run.exit_code == 0, run.output
        return json.loads(run.stdout)

    alike, elsewhere = made(to="a"), made(*others, to="b")
    assert alike["held_out_data"] == ["sim"]
    assert alike["held_out_settings"] == ["duration=1"]
    assert elsewhere["held_out_data"] == ["sim"]
    assert elsewhere["held_out_settings"] == ["duration=2"]
    assert elsewhere["position_difference_rms_m"] != alike["position_difference_rms_m"]
    refused = CliRunner().invoke(
        app, ["quantise", "kalman", *flights, *asked, *others[2:], "-o", str(tmp_path / "c")]
    )
    assert refused.exit_code != 0
    assert "--held-out-data" in refused.output


def test_lowering_to_fixed_point_needs_formats(tmp_path):
    made = CliRunner().invoke(app, ["lower", "kalman", "--dtype", "fixed", "-o", str(tmp_path)])
    assert made.exit_code != 0
    assert "flowgraph quantise kalman" in made.output


def test_a_bound_is_a_figure_and_a_number(tmp_path):
    made = CliRunner().invoke(
        app, ["quantise", "kalman", "--data", "sim", "--bound", "tight", "-o", str(tmp_path)]
    )
    assert made.exit_code != 0
    assert "FIGURE=MOST" in made.output
