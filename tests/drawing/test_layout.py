"""The layout of every kind of picture, computed: no text on another, none cut off, numbers at each foot."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from flowgraph import Array, Series, Signal, real
from flowgraph.drawing import canvas
from flowgraph.drawing.attitude import plot_comparison, plot_orientation
from flowgraph.drawing.navigation import plot_navigation, plot_trajectory
from flowgraph.drawing.plot import plot_result
from flowgraph.drawing.states import Quantity, plot_states
from flowgraph.drawing.trajectory import plot_space
from flowgraph.graphs.benches.thesis_picture import drawn
from flowgraph.study.charts import _draw_against, _draw_boxes, _draw_ratios
from tests.drawing.test_attitude import belief
from tests.drawing.test_plot import nav, result_of, track, truth


class Plane(Signal):
    position: Array = real(2, unit="m", frame="world")
    covariance: Array = real(2, 2)


class Known(Signal):
    position: Array = real(2, unit="m", frame="world")


LONG = "a_stream_whose_name_is_as_long_as_names_become"


def texts(figure: Figure) -> list[tuple[str, Any, Any]]:
    """All that is written in a figure with the place of each; of an axis in space its title and legend."""
    found = [figure._suptitle, figure._supxlabel, figure._supylabel]  # type: ignore[attr-defined]
    for axis in figure.axes:
        legend = axis.get_legend()
        found += [axis.title, axis._left_title, *axis.texts]  # type: ignore[attr-defined]
        found += legend.get_texts() if legend is not None else []
        if axis.name != "3d":
            found += [axis.xaxis.label, axis.yaxis.label]
            low, high = sorted(axis.get_ylim())
            found += [t for t in axis.get_yticklabels() if low <= t.get_position()[1] <= high]
            low, high = sorted(axis.get_xlim())
            found += [t for t in axis.get_xticklabels() if low <= t.get_position()[0] <= high]
    there = [t for t in found if t is not None and t.get_visible() and t.get_text()]
    return [(t.get_text(), t.get_window_extent(), t) for t in there]


def check(figure: Figure) -> None:
    figure.draw_without_rendering()
    places = texts(figure)
    assert places
    for words, place, _ in places:
        assert place.x0 >= -1, words
        assert place.y0 >= -1, words
        assert place.x1 <= figure.bbox.x1 + 1, words
        assert place.y1 <= figure.bbox.y1 + 1, words
    for (words, one, first), (other, two, second) in combinations(places, 2):
        turned = np.radians(first.get_rotation())
        if turned and first.get_rotation() == second.get_rotation():  # lines of text side by side
            apart = np.array([two.x0 + two.x1 - one.x0 - one.x1, two.y0 + two.y1 - one.y0 - one.y1]) / 2
            height = first.get_fontsize() * figure.dpi / 72
            free = abs(apart @ (-np.sin(turned), np.cos(turned))) - height
            if free >= 0:
                continue
        across = min(one.x1, two.x1) - max(one.x0, two.x0)
        along = min(one.y1, two.y1) - max(one.y0, two.y0)
        assert across <= 0.5 or along <= 1.5, (words, other)
    lowest: dict[int, Any] = {}
    for axis in figure.axes:
        spec = axis.get_subplotspec()
        if axis.name != "3d" and spec is not None:
            column, row = spec.colspan.start, spec.rowspan.stop
            if row >= lowest.get(column, (0, None))[0]:
                lowest[column] = row, axis
    for _, axis in lowest.values():
        assert any(t.get_visible() and t.get_text() for t in axis.get_xticklabels())


def in_the_plane(n: int = 60) -> tuple[Series, Series]:
    t = np.arange(n) * 0.1
    place = np.stack([np.cos(t), np.sin(t)], axis=1)
    P = np.tile(0.01 * np.eye(2), (n, 1, 1))
    return Series.from_seconds(t, Plane(place + 0.05, P), name="belief"), Series.from_seconds(t, Known(place))


def orientation() -> Figure:
    return plot_orientation(*belief())


def comparison() -> Figure:
    estimate, known = belief()
    return plot_comparison(
        {"quaternion_ukf": estimate, "gyro_integration": estimate, "marg": estimate}, known
    )


def planar() -> Figure:
    estimate, known = in_the_plane()
    return plot_navigation(estimate, known)


def states() -> Figure:
    t = np.linspace(0, 10, 200)
    many = [
        Quantity(f"{LONG} {k}", t, np.sin(t + k), "m/s^2", np.full(200, 0.1), np.cos(t), dots=k == 3)
        for k in range(14)
    ]
    return plot_states(many, heading=f"{LONG} of {LONG}")


def boxes(flights: int) -> Callable[[], Figure]:
    rows = [
        {"graph": g, "data": f"euroc:../shared/datasets/euroc/MH_0{k}_easy", "seed": s, "e": 0.1 + s + k}
        for g in ("ins_eskf", "outdoor_eskf") for k in range(flights) for s in range(4)
    ]  # fmt: skip

    def make() -> Figure:
        figure = canvas.new_figure(9.0, 4.5)
        _draw_boxes(figure, rows, "e")
        return figure

    return make


def against() -> Figure:
    rows = [
        {"graph": "ekf", "data": "sim", "seed": s, "position_noise": p, "e": 0.1 + s + p}
        for p in (0.001, 0.01, 0.1) for s in range(4)
    ]  # fmt: skip
    figure = canvas.new_figure(9.0, 4.5)
    _draw_against(figure, rows, "position_noise", "e")
    return figure


def ratio() -> Figure:
    table = [
        {"graph": "ekf", "metric": f"metric_{k}_rmse_m", "ratio": 1.0 + 0.1 * k, "low": 0.9, "high": 1.9}
        for k in range(24)
    ]
    figure = canvas.new_figure(9.0, 4.5)
    _draw_ratios(figure, table)
    return figure


def thesis() -> Figure:
    names = ("acf", "ekf", "ukf", "rbpf", "eskf", "eskf_smoothed", "ukf_smoothed")
    rows = [
        {
            "setting": code, "filter": name, "position_rmse_m": 0.1, "position_rmse_low_m": 0.09,
            "position_rmse_high_m": 0.12, "bound_position_rmse_m": 0.08, "attitude_rmse_deg": 2.0,
            "bound_attitude_rmse_deg": 1.8, "thesis_metric_position": 1e-2, "thesis_position": 3e-2,
            "thesis_metric_attitude": 1e-5, "thesis_attitude": None if "smoothed" in name else 1e-3,
        }
        for code in ("HHH", "HHL", "HLL", "LHH", "LHL", "LLL") for name in names
    ]  # fmt: skip
    return drawn(rows)  # type: ignore[no-any-return]


PICTURES: dict[str, Callable[[], Figure]] = {
    "result": lambda: plot_result(result_of(**{f"{LONG}_{k}": track() for k in range(7)})),
    "navigation": lambda: plot_navigation(nav(), truth(), observed=truth(), extra={"tilt": np.zeros(50)}),
    "navigation without a truth": lambda: plot_navigation(nav()),
    "planar": planar,
    "trajectory": lambda: plot_trajectory(truth(), nav()),
    "space": lambda: plot_space(nav(), truth(), truth()),
    "orientation": orientation,
    "comparison": comparison,
    "states": states,
    "boxes of one flight": boxes(1),
    "boxes of eight flights": boxes(8),
    "against": against,
    "ratios": ratio,
    "thesis": thesis,
}


@pytest.mark.parametrize("name", PICTURES)
def test_no_text_lies_on_another_and_none_is_cut(name: str) -> None:
    with canvas.plain_matplotlib():
        check(PICTURES[name]())


def test_what_overlaps_is_found() -> None:
    with canvas.plain_matplotlib():
        figure = canvas.new_figure(6.0, 4.0)
        axis = figure.add_subplot()
        axis.set_title("a title", loc="left")
        check(figure)
        axis.text(0.0, 1.02, "another text", transform=axis.transAxes)
        with pytest.raises(AssertionError, match="another text"):
            check(figure)


def test_what_is_cut_off_is_found() -> None:
    with canvas.plain_matplotlib():
        figure = canvas.new_figure(6.0, 4.0)
        figure.add_subplot().text(0.9, 0.5, "far too long a text for this place " * 3)
        figure.set_layout_engine("none")
        with pytest.raises(AssertionError, match="far too long"):
            check(figure)


def test_a_column_without_numbers_is_found() -> None:
    with canvas.plain_matplotlib():
        figure = canvas.new_figure(6.0, 4.0)
        top, foot = figure.subplots(2, 1, sharex=True)
        top.plot([0, 1], [0, 1])
        foot.tick_params(labelbottom=False)
        with pytest.raises(AssertionError):
            check(figure)
