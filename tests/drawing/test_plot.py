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
from tests.support import isolated

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
    spread = np.diag([4.0, 9.0]) * (1.0 + 0.01 * np.arange(n))[:, None, None]
    return Series(time, Track(np.arange(3.0 * n).reshape(n, 3), spread, np.zeros((n, 15, 15))))


def nav(n: int = 50) -> Series:
    seconds = np.arange(n) * 0.1
    position = np.stack([np.cos(seconds), np.sin(seconds), 0 * seconds], axis=-1)
    covariance = np.tile(np.diag(np.arange(1.0, 16.0) ** 2), (n, 1, 1))
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


@pytest.mark.parametrize("count", [9, 11, 17])
def test_each_column_has_the_numbers_of_its_time_axis(count):
    many = {f"s{k}": Series(np.arange(50) * SECOND, np.linspace(0, 1, 50)) for k in range(count)}
    figure = plot_result(result_of(**many))
    figure.draw_without_rendering()
    columns: dict[int, Any] = {}
    for axis in panels(figure):
        place = axis.get_subplotspec()
        if place.rowspan.start >= columns.get(place.colspan.start, (-1, None))[0]:
            columns[place.colspan.start] = (place.rowspan.start, axis)
    assert len(columns) == -(-count // 8)
    for _, lowest in columns.values():
        assert lowest.get_xlabel() == "time since the start [s]"
        assert any(t.get_visible() and t.get_text() for t in lowest.get_xticklabels())


def feet(figure) -> str:
    return figure.get_supxlabel()


def test_what_is_not_drawn_is_said_at_the_foot():
    still = Series(np.arange(101) * SECOND, np.tile([1.0, 2.5], (101, 1)))
    figure = plot_result(result_of(track=track(), still=still))
    assert titles(figure) == ["track.position", "track.covariance: square roots of the diagonal"]
    assert "always the same: still = 1, 2.5" in feet(figure)
    assert "not drawn: track.memory (15 × 15)" in feet(figure)
    assert titles(plot_result(result_of(still=still))) == ["still"]  # all that there is


def test_components_of_several_units_have_a_panel_each():
    class Polar(Signal):
        seen: Array = real(3, unit="m, rad, rad")

    time = np.arange(30) * SECOND
    polar = Series(time, Polar(np.stack([1e3 + time * 1e-9, time * 1e-11, time * 1e-12], axis=1)))
    figure = plot_result(result_of(polar=polar))
    assert titles(figure) == ["polar.seen x", "polar.seen y, z"]
    assert [axis.get_ylabel() for axis in panels(figure)] == ["[m]", "[rad]"]


@pytest.mark.parametrize("value", [-4.0, np.nan])
def test_a_variance_that_is_none_is_a_gap_and_a_mark(value):
    time = np.arange(100) * SECOND
    P = np.tile(np.diag([4.0, 1.0]), (100, 1, 1)) * (1 + 0.001 * np.arange(100))[:, None, None]
    P[50:, 0, 0] = value
    figure = plot_result(result_of(b=Series(time, P)))
    (axis,) = panels(figure)
    assert np.isnan(axis.lines[0].get_ydata()[50:]).all()
    assert np.isfinite(axis.lines[0].get_ydata()[:50]).all()
    assert [t.get_text() for t in axis.texts] == ["no variance at 50 of 100 times"]
    assert len(axis.lines[-1].get_xdata()) == 50


def test_a_broken_covariance_draws_no_band_of_certainty():
    whole = nav()
    P = np.array(whole["covariance"])
    P[30:, 0, 0] = -1.0
    fields = [P if name == "covariance" else array for name, array in whole.leaves.items()]
    estimate = Series(whole.time, Nav(*fields), name="belief")
    axis = panel(plot_navigation(estimate, truth()), "position error x, with 3σ")
    reach = np.concatenate([path.vertices for path in axis.collections[0].get_paths()])
    assert reach[:, 0].max() < 3.0  # the band ends where the variance does
    assert any("no variance at 20 of 50 times" in t.get_text() for t in axis.texts)


def test_a_stream_without_a_number_says_so():
    blank = Series(np.arange(60) * SECOND, np.full((60, 3), np.nan))
    figure = plot_result(result_of(track=track(), blank=blank))
    assert [t.get_text() for t in panel(figure, "blank").texts] == ["none of 60 values is finite"]


def test_an_error_of_the_start_does_not_set_the_scale():
    n = 1000
    seconds = np.arange(n) * 0.01
    off = np.where(seconds < 0.5, 0.5, 0.015)[:, None] * np.ones(3)
    q = np.tile([1.0, 0, 0, 0], (n, 1))
    estimate = Series.from_seconds(seconds, Truth(off, q), name="estimate")
    figure = plot_navigation(estimate, Series.from_seconds(seconds, Truth(0 * off, q), name="truth"))
    axis = panel(figure, "position error x")
    assert axis.get_ylim() == pytest.approx((-0.15 * 0.015, 1.15 * 0.015))
    assert [t.get_text() for t in axis.texts] == ["the start reaches 0 to 0.5"]


def test_no_text_lies_on_another():
    """Titles, legends, numbers and labels of a figure with long names and many components."""
    long = "a_stream_whose_name_is_as_long_as_such_names_become_in_a_graph_of_several_levels_of_nesting"
    many = {f"{long}_{k}": track() for k in range(5)}
    figure = plot_result(
        result_of(**many, wide=Series(np.arange(50), np.sin(np.arange(300.0)).reshape(50, 6)))
    )
    figure.draw_without_rendering()
    for axis in panels(figure):
        words = [axis._left_title, axis.yaxis.label]
        words += axis.get_legend().get_texts() if axis.get_legend() else []
        boxes = [w.get_window_extent() for w in words if w.get_text()]
        for k, box in enumerate(boxes):
            assert not any(box.overlaps(other) for other in boxes[k + 1 :]), axis.get_title(loc="left")
            assert box.x0 >= 0
            assert box.x1 <= figure.bbox.x1


@pytest.mark.parametrize(
    "before",
    [
        "import os; os.environ['MPLBACKEND'] = 'module://a_backend.of_another_environment'",
        "import matplotlib; matplotlib.rcParams['text.usetex'] = True",
        "import matplotlib; matplotlib.use('svg'); matplotlib.rcParams['axes.titlelocation'] = 'right'",
    ],
)
def test_a_picture_is_the_same_whatever_its_session_has_set(before, tmp_path):
    isolated(
        f"{before}\n"
        "import numpy as np, os, sys\n"
        "kept = os.environ.get('MPLBACKEND')\n"
        "from flowgraph import Series\n"
        "from flowgraph.data.result import Result\n"
        "s = {'s': Series(np.arange(50), np.linspace(0, 1, 50))}\n"
        f"Result('toy', 'python', s, {{}}, {{}}, 50, 0.0).plot({str(tmp_path / 'a.png')!r})\n"
        "import matplotlib\n"
        "assert os.environ.get('MPLBACKEND') == kept\n"
        "assert matplotlib.rcParams['text.usetex'] == ('usetex' in sys.argv)\n".replace(
            "('usetex' in sys.argv)", str("usetex" in before)
        )
    )
    plot_result(result_of(s=Series(np.arange(50), np.linspace(0, 1, 50))), tmp_path / "b.png")
    sizes = [(tmp_path / f"{name}.png").read_bytes()[16:24] for name in "ab"]
    assert sizes[0] == sizes[1]


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
        *(f"attitude error {k}, with 3σ" for k in "xyz"),
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
