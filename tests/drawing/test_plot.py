"""Plots: a panel a field with its unit and frame, dots for rare events, errors in the band claimed."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from flowgraph import Array, DataError, Series, Signal, Stream, UnknownNameError, graph, real, simulate
from flowgraph.data.result import Result
from flowgraph.drawing.plot import plot_navigation, plot_result, plot_trajectory
from flowgraph.types import ArrayType, Scalar, StructType

SECOND = 1_000_000_000


class Track(Signal):
    position: Array = real(3, unit="m", frame="world")
    covariance: Array = real(2, 2)
    memory: Array = real(15, 15)


class Nav(Signal):
    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4)
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    covariance: Array = real(15, 15)


class Truth(Signal):
    position: Array = real(3, unit="m", frame="world")
    attitude: Array = real(4)


def result_of(**series: Series) -> Result:
    return Result("toy", "python", series, {}, {}, 7, 0.0)


def track(n: int = 101, first: int = 3 * SECOND, step: int = SECOND // 100) -> Series:
    time = first + np.arange(n) * step
    spread = np.broadcast_to(np.diag([4.0, 9.0]), (n, 2, 2))
    return Series(time, Track(np.arange(3.0 * n).reshape(n, 3), spread, np.zeros((n, 15, 15))))


def nav(n: int = 50) -> Series:
    seconds = np.arange(n) * 0.1
    position = np.stack([np.cos(seconds), np.sin(seconds), 0 * seconds], axis=-1)
    covariance = np.broadcast_to(np.diag(np.arange(1.0, 16.0) ** 2), (n, 15, 15))
    half = 0.5 * seconds
    turn = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    values = Nav(position + 0.25, position, turn, np.full((n, 3), 0.01), covariance)
    return Series.from_seconds(seconds, values, name="belief")


def truth(n: int = 20) -> Series:
    seconds = 1.0 + np.arange(n) * 0.1
    position = np.stack([np.cos(seconds), np.sin(seconds), 0 * seconds], axis=-1)
    half = 0.5 * seconds + np.pi  # one full turn more: the same attitudes
    turn = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    return Series.from_seconds(seconds, Truth(position, turn), name="truth")


def titles(figure) -> list[str]:
    return [axis.get_title(loc="left") for axis in figure.axes]


def panels(figure) -> list[Any]:
    return list(figure.axes)


def panel(figure, title) -> Any:
    return panels(figure)[titles(figure).index(title)]


def test_one_panel_a_field_with_unit_frame_and_components():
    figure = plot_result(result_of(track=track()))
    assert titles(figure) == ["track.position", "track.covariance: square roots of the diagonal"]
    position = panel(figure, "track.position")
    assert position.get_ylabel() == "[m, world]"
    assert [t.get_text() for t in position.get_legend().get_texts()] == ["x", "y", "z"]
    np.testing.assert_allclose(position.lines[1].get_ydata(), 1 + 3 * np.arange(101.0))
    sigma = panels(figure)[1]
    assert [line.get_ydata()[0] for line in sigma.lines] == [2.0, 3.0]
    assert sigma.get_xlabel() == "time since the start [s]"


def test_time_is_in_seconds_from_the_start_of_the_run_whatever_is_shown():
    late = Series(4 * SECOND + np.arange(5) * SECOND, np.zeros(5))
    figure = plot_result(result_of(track=track(), late=late), outputs=["late"])
    (axis,) = panels(figure)
    np.testing.assert_allclose(axis.lines[0].get_xdata(), [1.0, 2.0, 3.0, 4.0, 5.0])


def test_rare_events_are_dots_and_others_lines():
    rare = Series(3 * SECOND + np.arange(4) * SECOND, np.zeros(4))
    figure = plot_result(result_of(track=track(), rare=rare))
    assert panel(figure, "rare").lines[0].get_linestyle() == "None"
    assert panel(figure, "rare").lines[0].get_marker() == "."
    assert panel(figure, "track.position").lines[0].get_linestyle() == "-"
    assert panel(figure, "track.position").lines[0].get_marker() == "None"


def test_empty_streams_and_single_events_are_drawn():
    empty = Series(np.zeros(0, np.int64), np.zeros(0))
    figure = plot_result(result_of(none=empty, one=Series([5], np.ones(1))))
    assert titles(figure) == ["none", "one"]
    assert len(panels(figure)[1].lines[0].get_xdata()) == 1


def test_many_fields_go_into_columns():
    many = {f"s{k}": track() for k in range(6)}
    figure = plot_result(result_of(**many))
    assert len(figure.axes) == 12
    assert len({axis.get_subplotspec().colspan.start for axis in panels(figure)}) == 2


def test_a_run_draws_itself_without_pyplot(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)  # importing it now fails

    @graph
    def toy(x: Stream[Scalar]):
        return {"double": x.map(lambda v: 2 * v), "large": x.filter(lambda v: v > 2)}

    result = simulate(toy.build(), {"x": Series(np.arange(5), np.arange(5.0))})
    for ending, start in ((".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")):
        file = tmp_path / "new" / f"run{ending}"
        assert titles(result.plot(file)) == ["double", "large"]
        assert file.read_bytes().startswith(start)


def test_wrong_names_and_endings_list_the_valid_ones(tmp_path):
    with pytest.raises(UnknownNameError, match="no output is called 'trakc'"):
        plot_result(result_of(track=track()), outputs=["trakc"])
    with pytest.raises(UnknownNameError) as caught:
        plot_result(result_of(track=track()), tmp_path / "run.bmp")
    assert "one of .pdf, .png, .svg" in str(caught.value)


def test_nothing_to_plot_is_an_error_that_says_what_could_be():
    wide = Series(np.arange(3), np.zeros((3, 40)))
    with pytest.raises(DataError) as caught:
        plot_result(result_of(wide=wide))
    assert str(caught.value).splitlines() == [
        "toy: there is nothing to plot",
        "  expected: a stream with a field of at most 6 components",
        "  got:      wide",
        '  fix:      collect a part of the stream: collect(stream.map(lambda v: v.part), "part")',
    ]


def test_the_trajectory_is_to_scale_and_its_error_stands_in_the_band():
    figure = plot_trajectory(truth(), nav())
    space, *errors = panels(figure)
    spans = [np.ptp(getattr(space, f"get_{k}lim")()) for k in "xyz"]
    np.testing.assert_allclose(np.array(spans) / spans[0], space._box_aspect / space._box_aspect[0])
    assert titles(figure)[1:] == [f"position error {k}, with 3σ" for k in "xyz"]
    for k, axis in enumerate(errors):
        error = axis.lines[-1].get_ydata()
        assert np.isnan(error[:10]).all()  # the truth begins at one second
        np.testing.assert_allclose(error[10:30], 0.25, atol=1e-3)
        band = axis.collections[0].get_paths()[0].vertices[:, 1]
        assert (band.min(), band.max()) == (-3.0 * (k + 1), 3.0 * (k + 1))


def test_the_navigation_page_shows_what_there_is(tmp_path):
    extra = {"tilt error [deg]": np.zeros(50)}
    figure = plot_navigation(nav(), truth(), tmp_path / "nav.png", extra=extra)
    assert (tmp_path / "nav.png").stat().st_size > 10_000
    assert titles(figure)[1:] == [
        "from above",
        *(f"position error {k}, with 3σ" for k in "xyz"),
        *(f"velocity {k}, with 3σ" for k in "xyz"),  # the truth has none
        *(f"{angle}, with 3σ" for angle in ("roll", "pitch", "yaw")),
        *(f"gyro bias {k}, with 3σ" for k in "xyz"),
        "tilt error [deg]",
    ]  # fmt: skip
    yaw = panel(figure, "yaw, with 3σ")
    estimated, right = (line.get_ydata() for line in yaw.lines)
    assert estimated[-1] == pytest.approx(np.rad2deg(4.9))
    assert right[0] == pytest.approx(np.rad2deg(1.0))
    bias = panel(figure, "gyro bias y, with 3σ")
    band = bias.collections[0].get_paths()[0].vertices[:, 1]
    assert band.max() == pytest.approx(0.01 + 3 * 11)


def test_without_truth_and_covariance_the_values_themselves_are_drawn():
    seconds = np.arange(5.0)
    alone = Series.from_seconds(seconds, Truth(np.ones((5, 3)), np.tile([1.0, 0, 0, 0], (5, 1))))
    figure = plot_navigation(alone)
    assert titles(figure)[1:] == [
        "from above",
        "position x",
        "position y",
        "position z",
        "roll",
        "pitch",
        "yaw",
    ]
    assert not panel(figure, "position x").collections


def test_an_estimate_without_position_and_an_extra_panel_of_another_length_are_refused():
    with pytest.raises(UnknownNameError, match="no field is called 'position'"):
        plot_navigation(Series(np.arange(3), np.zeros(3)))
    with pytest.raises(DataError, match="one value for each time") as caught:
        plot_navigation(nav(), extra={"tilt": np.zeros(7)})
    assert caught.value.got == "shape (7,)"


def test_an_empty_series_is_refused_by_name():
    with pytest.raises(DataError, match="belief: there are no values to plot"):
        plot_navigation(nav(0))
    with pytest.raises(DataError, match="truth: there are no values to plot"):
        plot_trajectory(truth(0), nav())


@pytest.mark.parametrize("size", [6, 9, 15])
def test_a_band_for_each_part_that_the_covariance_covers(size):
    """Position, velocity and attitude by 6 or 9 numbers, as of a point or a pose; biases by 15."""
    n = 50
    time = np.arange(n) * SECOND
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    P = np.tile(np.eye(size) * 0.04, (n, 1, 1))
    fields = {"position": np.zeros((n, 3)), "velocity": np.zeros((n, 3)), "attitude": q, "covariance": P}
    kinds = tuple((k, ArrayType(v.shape[1:], "real")) for k, v in fields.items())
    estimate = Series(time, fields, type=StructType("estimate", kinds, dict), name="estimate")
    truth = Series(time, Truth(np.zeros((n, 3)), q), name="truth")
    figure = plot_navigation(estimate, truth)
    banded = [a.get_title(loc="left") for a in figure.axes if getattr(a, "collections", None)]
    for words, least in (("position error x", 6), ("velocity", 6), ("roll", 9)):
        assert any(words in title for title in banded) == (size >= least), (words, banded)
