"""Results for other tools: TUM text that evo reads to our own figures, and xarray."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from flowgraph import (
    DataError,
    MissingDependencyError,
    OutputError,
    Series,
    UnknownNameError,
    find_graph,
    load_flight,
    simulate,
    write_tum,
)
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.signals import Attitude, Pose, Position


@pytest.fixture(scope="module")
def flown():
    flight = load_flight("sim", seed=2, settings={"duration": "3"})
    case = find_graph("ins_eskf").case(flight, settle=0.0)
    return flight, simulate(case.graph, case.inputs)


def test_evo_finds_our_own_errors_in_the_file_we_wrote(flown, tmp_path):
    evo = pytest.importorskip("evo.core.metrics", reason="needs evo")
    from evo.core.sync import associate_trajectories
    from evo.tools.file_interface import read_tum_trajectory_file

    flight, result = flown
    truth = flight.truth
    # the filter's ticks are the truth's times here, so that no interpolation is between the two
    assert set(result["belief"].time) <= set(truth.time)
    write_tum(result["belief"], tmp_path / "estimate.tum")
    write_tum(truth, tmp_path / "truth.tum")
    read = [read_tum_trajectory_file(str(tmp_path / f"{name}.tum")) for name in ("truth", "estimate")]
    pair = associate_trajectories(*read, max_diff=1e-6)
    ours = pose_errors(result["belief"], truth, settle=0.0)
    place = evo.APE(evo.PoseRelation.translation_part)
    place.process_data(pair)
    assert place.get_statistic(evo.StatisticsType.rmse) == pytest.approx(ours["position_rmse_m"], rel=1e-9)
    turn = evo.APE(evo.PoseRelation.rotation_angle_deg)
    turn.process_data(pair)
    assert turn.get_statistic(evo.StatisticsType.rmse) == pytest.approx(ours["attitude_rmse_deg"], rel=1e-6)
    assert len(turn.error) == ours["compared_ticks"]


def test_an_attitude_alone_is_written_with_a_word_about_it(tmp_path):
    series = Series(np.array([5]), Attitude(attitude=np.array([[0.8, 0.6, 0.0, 0.0]])))
    write_tum(series, tmp_path / "a.tum")
    first, row = (tmp_path / "a.tum").read_text().splitlines()
    assert "positions are zero" in first
    assert row == "0.000000005 0.0 0.0 0.0 0.6 0.0 0.0 0.8"


def test_what_is_no_trajectory_is_refused(tmp_path):
    with pytest.raises(UnknownNameError, match="no field is called 'attitude'"):
        write_tum(Series(np.array([0]), Position(position=np.zeros((1, 3)))), tmp_path / "a.tum")
    gap = Pose(position=np.array([[0.0, 0.0, np.nan]]), attitude=np.array([[1.0, 0.0, 0.0, 0.0]]))
    with pytest.raises(DataError, match="row 0: this is no trajectory"):
        write_tum(Series(np.array([0]), gap), tmp_path / "a.tum")
    with pytest.raises(DataError, match="no row"):
        write_tum(Series(np.zeros(0, np.int64), Attitude(attitude=np.zeros((0, 4)))), tmp_path / "a.tum")
    good = Series(np.array([0]), Attitude(attitude=np.array([[1.0, 0.0, 0.0, 0.0]])))
    with pytest.raises(OutputError, match="cannot be written"):
        write_tum(good, tmp_path / "none" / "a.tum")


def test_a_result_becomes_a_tree_of_datasets(flown):
    pytest.importorskip("xarray", reason="needs the extra xarray")
    _, result = flown
    tree = result.to_xarray()
    assert set(tree.children) == set(result.series)
    belief = tree["belief"]
    np.testing.assert_array_equal(belief["time"], result["belief"].time)
    np.testing.assert_array_equal(belief["covariance"], result["belief"]["covariance"])
    assert belief["position"].dims == ("time", "position_axis")
    assert belief["position"].attrs == {"units": "m", "frame": "world"}
    np.testing.assert_array_equal(
        belief["attitude"].sel(attitude_axis="w"), result["belief"]["attitude"][:, 0]
    )
    assert tree.attrs["graph"] == "ins_eskf"
    assert len(tree["position_innovation"]["time"]) == len(result["position_innovation"])


def test_without_xarray_it_says_what_to_install(flown, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingDependencyError, match=r"flowgraph-filters\[xarray\]"):
        flown[1].to_xarray()
