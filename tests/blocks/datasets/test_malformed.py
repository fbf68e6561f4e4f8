"""One bad record in a file of the course or its kin: masked, left out where that is asked for, or named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from flowgraph import DataError, Flight, UnknownNameError, load_flight, simulate
from flowgraph.blocks.datasets import studentdata, umd
from flowgraph.blocks.datasets.course import simulated_content
from flowgraph.blocks.datasets.coursework import estimate_covariances, estimate_pose
from flowgraph.blocks.vision.camera import COURSE_CAMERA
from flowgraph.graphs import ins_ekf_pose, ins_ukf_pose

SKIP = {"malformed": "skip"}


def content(**settings: float) -> dict[str, Any]:
    return simulated_content(1, **{"duration": 0.3, **settings})


def written(folder: Path, made: dict[str, Any]) -> str:
    savemat(folder / "studentdata9.mat", made)
    return str(folder / "studentdata9.mat")


def rectify(made: dict[str, Any]) -> None:
    K = COURSE_CAMERA.K
    for p in made["data"]:
        for name in ("p1", "p2", "p3", "p4"):
            p[name] = (COURSE_CAMERA.undistort(p[name].T) @ K[:2, :2].T + K[:2, 2]).T


# Rows of motion capture that are NaN


def blank(made: dict[str, Any], rows: slice, fields: slice = slice(None)) -> None:
    made["vicon"] = made["vicon"].copy()
    made["vicon"][fields, rows] = np.nan


@pytest.mark.parametrize("fields", [slice(None), slice(3, 6), slice(6, 7)], ids=["all", "angles", "a speed"])
def test_rows_of_motion_capture_that_are_nan_are_masked(tmp_path, fields):
    made = content()
    blank(made, slice(8, 20), fields)
    flight = studentdata.load(written(tmp_path, made))
    assert flight.truth is not None
    assert len(flight.truth) == 30
    gone = np.isnan(flight.truth["position"]).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(gone), np.arange(8, 20))
    assert any(n.startswith("skipped: truth: 12 of 30 rows hold NaN, masked") for n in flight.notes)


def test_nothing_is_scored_across_what_is_masked(tmp_path):
    """The body moves by decimetres while nobody sees it; a line drawn across is no truth."""
    made = content(duration=2.0)
    whole = scored(studentdata.load(written(tmp_path, made)))
    blank(made, slice(100, 190))
    held = scored(studentdata.load(written(tmp_path, made)))
    assert held["position_rmse_m"] < 1.5 * whole["position_rmse_m"] < 0.005
    assert held["compared_ticks"] == pytest.approx(whole["compared_ticks"] - 90, abs=1)


def scored(flight: Flight) -> dict[str, float]:
    case = ins_ekf_pose.case(flight, settle=0.5)
    return dict(case.score(simulate(case.graph, case.inputs)))


def test_covariances_are_not_those_of_a_line_across_a_gap(tmp_path):
    made = content(duration=2.0)
    whole = np.sqrt(np.diag(estimate_covariances(written(tmp_path, made))))
    blank(made, slice(60, 190))
    masked = np.sqrt(np.diag(estimate_covariances(written(tmp_path, made))))
    np.testing.assert_allclose(masked, whole, rtol=0.5)


def test_nan_at_the_ends_of_a_motion_capture_is_cut_off(tmp_path):
    made = content()
    blank(made, slice(0, 4))
    blank(made, slice(27, 30))
    truth = studentdata.load(written(tmp_path, made)).truth
    assert truth is not None
    assert len(truth) == 23
    assert np.isfinite(truth["position"]).all()


# Files without a motion capture


@pytest.mark.parametrize("left", ["no variables", "only stamps", "nothing in it", "nothing but NaN"])
def test_a_file_without_motion_capture_runs_unscored(tmp_path, left):
    made = content()
    if left == "no variables":
        made = {"data": made["data"]}
    elif left == "only stamps":
        made = {"data": made["data"], "time": made["time"]}
    elif left == "nothing in it":
        made |= {"time": np.zeros((0, 0)), "vicon": np.zeros((0, 0))}
    else:
        blank(made, slice(None))
    flight = studentdata.load(written(tmp_path, made))
    assert flight.truth is None
    assert any("no motion capture, and no score" in n for n in flight.notes)
    case = ins_ukf_pose.case(flight)
    result = simulate(case.graph, case.inputs)
    assert "position_rmse_m" not in case.score(result)
    assert np.isfinite(result["belief"]["position"]).all()
    with pytest.raises(DataError, match="too few packets can be compared"):
        estimate_covariances(tmp_path / "studentdata9.mat")


# Packets


BAD = {
    "a NaN corner": ("tags", lambda p: p["p2"].__setitem__((0, 0), np.nan)),
    "corners of another number": ("tags", lambda p: p.__setitem__("p1", np.zeros((2, 3)))),
    "half an id": ("tags", lambda p: p.__setitem__("id", p["id"] + 0.5)),
    "an empty acc": ("imu", lambda p: p.__setitem__("acc", np.zeros((0, 0)))),
    "a NaN rate": ("imu", lambda p: p.__setitem__("omg", np.full(3, np.nan))),
    "no stamp": ("both", lambda p: p.__setitem__("t", np.zeros((0, 0)))),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_packet_is_left_out_where_that_is_asked_for(tmp_path, kind):
    """Of what it holds, only what is malformed."""
    of, spoil = BAD[kind]
    made = content()
    spoil(made["data"][2])
    file = written(tmp_path, made)
    with pytest.raises(DataError, match=r"packet 3: [\s\S]*malformed=skip"):
        studentdata.load(file)
    flight = load_flight(f"studentdata:{file}", settings=SKIP)
    assert len(flight.streams["imu"]) == 30 - (of in ("imu", "both"))
    assert len(flight.streams["tags"]) == 30 - (of in ("tags", "both"))
    (said,) = [n for n in flight.notes if n.startswith("skipped:")]
    assert "1 malformed, left out; the first" in said
    assert "packet 3" in said
    assert np.isfinite(scored_position(flight))


def scored_position(flight: Flight) -> float:
    case = ins_ekf_pose.case(flight, settle=0.0)
    return float(case.score(simulate(case.graph, case.inputs))["position_rmse_m"])


def test_a_bad_first_packet_does_not_decide_what_the_rate_is_called(tmp_path):
    made = content()
    made["data"][0] = {k: v for k, v in made["data"][0].items() if k != "omg"}
    flight = studentdata.load(written(tmp_path, made), settings=SKIP)
    assert len(flight.streams["imu"]) == 29
    assert not any("drpy" in n for n in flight.notes)


def test_a_file_of_which_most_is_malformed_is_refused(tmp_path):
    made = content()
    for p in made["data"][:16]:
        p["acc"] = np.zeros(2)
    with pytest.raises(DataError, match=r"most of it is malformed: field 'acc'[\s\S]*16 of 30"):
        studentdata.load(written(tmp_path, made), settings=SKIP)
    with pytest.raises(UnknownNameError, match="raise, skip"):
        studentdata.load(written(tmp_path, made), settings={"malformed": "ignore"})


def hand_held(folder: Path, spoil: str) -> str:
    """Ten images of two tags, and an IMU at 100 Hz."""
    row = np.array([7, 100, 200, 150, 200, 150, 150, 100, 150], dtype=float)
    images = [np.stack([row, row + np.array([1, 80, 0, 80, 0, 80, 0, 80, 0])]) for _ in range(10)]
    imu = np.tile([0.0, 0, 0, 0, 0, 0, 9.81, 0, 0, 0, 0], (100, 1))
    imu[:, 10] = np.arange(100) * 0.01
    if spoil == "image":
        images[3] = images[3].copy()
        images[3][0, 2] = np.nan
    elif spoil == "columns":
        images[3] = images[3][:, :5]
    else:
        imu[20, 5] = np.nan
    cells = np.empty(10, dtype=object)
    cells[:] = images
    savemat(folder / "DataNew.mat", {"DetAll": cells, "TLeftImgs": np.arange(10) * 0.1, "IMU": imu})
    K = np.array([[364.0, 0, 289], [0, 364, 290], [0, 0, 1]])
    calibration = {"K": K, "qIMUToC": [1.0, 0, 0, 0], "TIMUToC": [0.0, 0, 0], "TagSize": 0.19}
    savemat(folder / "CalibParams.mat", calibration)
    return str(folder / "DataNew.mat")


@pytest.mark.parametrize("spoil", ["image", "columns", "row"])
def test_a_bad_image_or_row_of_a_hand_held_recording(tmp_path, spoil):
    file = hand_held(tmp_path, spoil)
    with pytest.raises(DataError, match=r"malformed=skip"):
        umd.load(file)
    flight = umd.load(file, settings=SKIP)
    assert len(flight.streams["imu"]) == 100 - (spoil == "row")
    assert len(flight.streams["tags"]) == 10 - (spoil != "row")
    assert any(n.startswith("skipped: DataNew.mat") for n in flight.notes)


# Raw and rectified corners


@pytest.mark.parametrize("rectified", [False, True], ids=["raw", "rectified"])
@pytest.mark.parametrize("tags", [3, 6, 99])
def test_estimate_pose_finds_whether_corners_are_of_rectified_images(rectified, tags):
    made = content(pixel_noise=0.1, duration=0.2)
    if rectified:
        rectify(made)
    for k in range(0, 20, 4):
        p = made["data"][k]
        few = {name: p[name][:, :tags] for name in ("p1", "p2", "p3", "p4")}
        position, _ = estimate_pose({"id": p["id"][:tags], **few})
        assert np.linalg.norm(position[:, 0] - made["vicon"][:3, k]) < 0.03
        other = COURSE_CAMERA if rectified else COURSE_CAMERA.rectified()
        wrong, _ = estimate_pose({"id": p["id"][:tags], **few}, camera=other)
        assert np.linalg.norm(wrong[:, 0] - made["vicon"][:3, k]) > 0.05


@pytest.mark.parametrize("rectified", [False, True], ids=["raw", "rectified"])
def test_of_a_single_tag_the_pose_before_decides(rectified):
    made = content(pixel_noise=0.1, duration=0.2)
    if rectified:
        rectify(made)
    for k in range(2, 20, 6):
        p = made["data"][k]
        near = made["vicon"][:3, k - 1 : k], made["vicon"][3:6, k - 1 : k]
        one = {"id": float(p["id"][0]), **{name: p[name][:, 0] for name in ("p1", "p2", "p3", "p4")}}
        right = COURSE_CAMERA.rectified() if rectified else COURSE_CAMERA
        position, _ = estimate_pose(one, near=near)
        named, _ = estimate_pose(one, near=near, camera=right)
        apart = np.linalg.norm(position[:, 0] - made["vicon"][:3, k])
        assert apart <= np.linalg.norm(named[:, 0] - made["vicon"][:3, k]) + 0.02
