"""Files of the course, and every way in which they differ; the other families; what the course asks for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from flowgraph import DataError, DeclarationError, UnknownNameError, load_flight
from flowgraph.blocks.datasets import course, rob6213, studentdata, umd
from flowgraph.blocks.datasets.course import simulated_content
from flowgraph.blocks.datasets.coursework import estimate_covariances, estimate_pose
from flowgraph.blocks.datasets.parameters import parse_parameters
from flowgraph.blocks.vision import course_map
from flowgraph.blocks.vision.camera import COURSE_CAMERA, COURSE_MOUNT

ROOT = Path(__file__).resolve().parents[3]
DATA = Path(os.environ.get("FLOWGRAPH_DATA", ROOT.parent / "shared" / "datasets"))

TEXT = """AprilTag map
The mat has tags in a grid; each is a square with a side of 0.152 m, 0.152 m apart, except
for the space between columns 3 and 4, and 6 and 7, which is 0.178 m.

Tag ids:
[{ids}]

Camera matrix (zero-indexed):
[314.1779 0         199.4848; ...
0         314.2218  113.7838; ...
0         0         1]

Distortion parameters (k1,k2,p1,p2,k3):
[-0.438607, 0.248625, 0.00072, -0.000476, -0.0911]

Camera-IMU calibration:
XYZ = [-0.04, 0.0, -0.03];
Yaw = pi/4;
"""


def content(**settings: float) -> dict[str, Any]:
    return simulated_content(1, **{"duration": 0.3, **settings})


def written(folder: Path, content: dict[str, Any]) -> str:
    savemat(folder / "studentdata9.mat", content)
    return str(folder / "studentdata9.mat")


def changed(packet: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {**{k: v for k, v in packet.items() if more.get(k, 0) is not None}, **{
        k: v for k, v in more.items() if v is not None}}  # fmt: skip


def array_of(packets: list[dict[str, Any]]) -> np.ndarray:
    found = np.empty(len(packets), dtype=object)
    found[:] = packets
    return found


def test_a_file_is_read(tmp_path):
    made = content()
    flight = load_flight("studentdata:" + written(tmp_path, made))
    assert set(flight.streams) == {"imu", "tags"}
    np.testing.assert_allclose(flight.streams["imu"].gyro[3], made["data"][3]["omg"])
    np.testing.assert_allclose(flight.streams["imu"].specific_force[3], made["data"][3]["acc"])
    seen = flight.streams["tags"].seen[3]
    np.testing.assert_array_equal(flight.streams["tags"].ids[3][seen], made["data"][3]["id"])
    np.testing.assert_allclose(flight.streams["tags"].corners[3][seen][:, 0], made["data"][3]["p1"].T)
    assert flight.truth is not None
    np.testing.assert_allclose(flight.truth.position, made["vicon"][:3].T)
    assert any("images taken as raw" in note and "rectified" in note for note in flight.notes)


def test_drpy_stands_for_omg_and_no_packet_has_tags(tmp_path):
    made = content()
    none = np.zeros((0, 0))
    made["data"] = array_of(
        [
            changed(p, omg=None, drpy=p["omg"], id=none, p1=none, p2=none, p3=none, p4=none)
            for p in made["data"]
        ]
    )
    flight = studentdata.load(written(tmp_path, made))
    assert set(flight.streams) == {"imu"}
    np.testing.assert_allclose(flight.streams["imu"].gyro, [p["drpy"] for p in made["data"]])
    assert any("drpy is taken for omg" in n for n in flight.notes)
    assert any("no packet has tags" in n for n in flight.notes)


def test_a_packet_with_one_tag_is_a_scalar_and_one_without_is_empty(tmp_path):
    made = content()
    none = np.zeros((0, 0))
    one = {f"p{k}": made["data"][0][f"p{k}"][:, 0] for k in range(1, 5)}
    packets = list(made["data"])
    packets[0] = changed(packets[0], id=float(packets[0]["id"][0]), **one)
    packets[1] = changed(packets[1], id=none, p1=none, p2=none, p3=none, p4=none)
    packets[2] = {k: packets[2][k] for k in packets[2]}
    made["data"] = array_of(packets)
    flight = studentdata.load(written(tmp_path, made))
    tags = flight.streams["tags"]
    assert tags.seen.sum(axis=1)[:3].tolist() == [1, 0, len(made["data"][2]["id"])]
    np.testing.assert_allclose(tags.corners[0, 0], [one[f"p{k}"] for k in range(1, 5)])
    position, angles = estimate_pose(packets[0])
    assert position.shape == angles.shape == (3, 1)


def test_packets_before_the_motion_capture_are_counted(tmp_path):
    made = content()
    made["time"], made["vicon"] = made["time"][7:], made["vicon"][:, 7:]
    flight = studentdata.load(written(tmp_path, made))
    assert any("7 packets precede the first row of vicon" in n for n in flight.notes)
    assert len(flight.streams["imu"]) == 30


def test_a_single_packet_is_a_struct(tmp_path):
    made = content()
    made["data"] = made["data"][0]
    assert len(studentdata.load(written(tmp_path, made)).streams["imu"]) == 1


def test_packets_may_lack_the_fields_of_tags(tmp_path):
    made = content()
    names = ("id", "p1", "p2", "p3", "p4")
    made["data"] = array_of([{k: v for k, v in p.items() if k not in names} for p in made["data"]])
    assert set(studentdata.load(written(tmp_path, made)).streams) == {"imu"}


def test_stamps_that_repeat_are_left_out_and_named(tmp_path):
    made = content()
    made["data"][5]["t"] = made["data"][4]["t"]
    flight = studentdata.load(written(tmp_path, made))
    assert len(flight.streams["imu"]) == 29
    assert any("data, row 6 is +0.000 ms after the one before" in n for n in flight.notes)


def test_twelve_rows_of_motion_capture_lie_either_way(tmp_path):
    made = content()
    made["vicon"] = made["vicon"].T
    truth = studentdata.load(written(tmp_path, made)).truth
    assert truth is not None
    np.testing.assert_allclose(truth.position, made["vicon"][:, :3])


def test_rectified_corners_are_told_from_raw_ones(tmp_path):
    made = content(pixel_noise=0.1)
    for p in made["data"]:
        for name in ("p1", "p2", "p3", "p4"):
            ideal = COURSE_CAMERA.undistort(p[name].T)
            p[name] = (ideal @ COURSE_CAMERA.K[:2, :2].T + COURSE_CAMERA.K[:2, 2]).T
    file = written(tmp_path, made)
    flight = studentdata.load(file)
    assert any("images taken as rectified;" in n for n in flight.notes)
    assert flight.info["camera"].distortion == (0.0,) * 5
    asked = studentdata.load(file, settings={"images": "raw"})
    assert any("images taken as raw (asked for)" in n for n in asked.notes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"p1": np.zeros((2, 3))}, r"packet 3: the tags of a packet are malformed[\s\S]*p1 to p4 of 2 x"),
        ({"acc": np.array([0.0, np.nan, 0.0])}, r"packet 3: field 'acc' of a packet is missing or malformed"),
        ({"t": np.zeros(2)}, r"packet 3: field 't'"),
    ],
)
def test_a_malformed_packet_is_named(tmp_path, change, message):
    made = content()
    made["data"][2] = changed(made["data"][2], **change)
    with pytest.raises(DataError, match=message):
        studentdata.load(written(tmp_path, made))


def test_files_that_are_none_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"no\.mat is missing"):
        studentdata.load(str(tmp_path / "no.mat"))
    (tmp_path / "text.mat").write_text("no matrix")
    with pytest.raises(DataError, match=r"no whole \.mat file[\s\S]*-v7"):
        studentdata.load(str(tmp_path / "text.mat"))
    with pytest.raises(DeclarationError, match=r"which file\?[\s\S]*studentdata:FILE"):
        load_flight("studentdata")
    made = content()
    with pytest.raises(DataError, match=r"'vicon' does not fit 'time'"):
        studentdata.load(written(tmp_path, {k: made[k] for k in ("data", "vicon")}))
    with pytest.raises(DataError, match=r"'vicon' does not fit 'time'"):
        studentdata.load(written(tmp_path, {**made, "time": made["time"][3:]}))
    with pytest.raises(DataError, match=r"'data' holds no packets"):
        studentdata.load(written(tmp_path, {**made, "data": np.zeros(3)}))
    with pytest.raises(UnknownNameError, match=r"auto, raw, rectified"):
        studentdata.load(written(tmp_path, made), settings={"images": "bent"})
    with pytest.raises(UnknownNameError, match=r"most_tags"):
        studentdata.load(written(tmp_path, made), settings={"image": "raw"})
    with pytest.raises(DataError, match=r"more tags than there is room for"):
        studentdata.load(written(tmp_path, made), settings={"most_tags": "2"})


# parameters.txt


def test_the_parameters_of_the_course_are_read(tmp_path):
    ids = np.arange(108).reshape(9, 12).T
    file = tmp_path / "parameters.txt"
    file.write_text(TEXT.format(ids=";\n ".join(", ".join(map(str, row)) for row in ids)))
    found = parse_parameters(file)
    assert found.notes == ()
    np.testing.assert_array_equal(found.camera.K, COURSE_CAMERA.K)
    assert found.camera.distortion == COURSE_CAMERA.distortion
    np.testing.assert_allclose(found.mount.rotation, COURSE_MOUNT.rotation, atol=1e-15)
    np.testing.assert_array_equal(found.mount.origin, COURSE_MOUNT.origin)
    np.testing.assert_array_equal(found.tag_map.ids, course_map().ids)
    np.testing.assert_allclose(found.tag_map.corners, course_map().corners, atol=1e-15)
    made = content()
    flight = load_flight(f"studentdata:{written(tmp_path, made)}:{file}")
    assert flight.info["camera"].distortion == COURSE_CAMERA.distortion


def test_other_parameters_are_taken_and_missing_ones_are_said(tmp_path):
    file = tmp_path / "p.txt"
    file.write_text(
        "Camera: [400 0 320; 0 410 240; 0 0 1]\n\nYaw: -0.5\n\nTags of 0.2 m, 0.1 m apart\n[0 1; 2 3]\n"
    )
    found = parse_parameters(file)
    assert found.camera.K[1, 1] == 410.0
    np.testing.assert_allclose(found.tag_map.corners[1, 3], [0.0, 0.3, 0.0])
    assert [n.split("no ")[1].split(";")[0] for n in found.notes] == ["distortion", "XYZ"]
    file.write_text("[1 2; 3]")
    with pytest.raises(DataError, match=r"p\.txt, line 1: a matrix is malformed"):
        parse_parameters(file)
    file.write_text("K = [0 0 320; 0 410 240; 0 0 1]")
    with pytest.raises(DataError, match=r"the camera is malformed"):
        parse_parameters(file)
    with pytest.raises(DataError, match=r"the parameters cannot be read"):
        parse_parameters(tmp_path / "none.txt")


# What the course asks for


def test_estimate_pose_is_exact_without_noise():
    made = simulated_content(2, duration=1.0, pixel_noise=0.0)
    for k, packet in enumerate(made["data"][::5]):
        position, angles = estimate_pose(packet)
        np.testing.assert_allclose(position[:, 0], made["vicon"][:3, 5 * k], atol=1e-6)
        np.testing.assert_allclose(angles[:, 0], made["vicon"][3:6, 5 * k], atol=1e-6)
    with pytest.raises(DataError, match=r"no tag of the map is seen"):
        estimate_pose({"id": []})


def test_estimate_pose_is_unbiased_with_noise():
    """One place, 400 draws of 0.5 px: the mean error is within four of its deviations."""
    made = simulated_content(3, duration=0.02, pixel_noise=0.0)
    packet, truth = made["data"][0], made["vicon"][:6, 0]
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(400):
        quads = {n: packet[n] + 0.5 * rng.normal(size=packet[n].shape) for n in ("p1", "p2", "p3", "p4")}
        errors.append(np.concatenate(estimate_pose({**packet, **quads}))[:, 0] - truth)
    E = np.array(errors)
    assert (np.abs(E.mean(axis=0)) < 4.0 * E.std(axis=0) / 20.0).all()


def test_estimate_covariances_is_that_of_the_residuals(tmp_path):
    made = content(duration=2.0)
    R = estimate_covariances(written(tmp_path, made))
    r = np.array(
        [np.concatenate(estimate_pose(p))[:, 0] - made["vicon"][:6, k] for k, p in enumerate(made["data"])]
    )
    np.testing.assert_allclose(R, r.T @ r / (len(r) - 1), rtol=1e-3, atol=1e-9)
    apart = written(tmp_path, {**made, "time": made["time"] + 100.0})
    with pytest.raises(DataError, match=r"no sample of truth lies within the span of the imu"):
        estimate_covariances(apart)


# The other families, in small files


def small_umd(folder: Path, **more: Any) -> str:
    corners = np.array([[10.0, 20.0], [30.0, 20.0], [30.0, 5.0], [10.0, 5.0]])
    cells = array_of([np.r_[k, corners.ravel()][None] for k in range(3)])  # type: ignore[list-item]
    imu = np.zeros((5, 11))
    imu[:, 4] = 9.81
    imu[:, 10] = 100.0 + np.array([0.0, 0.01, 0.02, 0.015, 0.03])
    stamps = 100.0 + np.array([0.005, 0.02, 0.03])
    savemat(folder / "DataNew.mat", {"DetAll": cells, "TLeftImgs": stamps, "IMU": imu, **more})
    calibration = {
        "K": np.array([[364.0, 0, 289], [0, 364, 290], [0, 0, 1]]),
        "qIMUToC": np.array([1.0, 0, 0, 0]),
        "TIMUToC": np.zeros(3),
        "TagSize": 0.193,
    }
    savemat(folder / "CalibParams.mat", calibration)
    return str(folder / "DataNew.mat")


def test_the_bad_row_of_an_imu_is_shown(tmp_path):
    flight = load_flight("umd:" + small_umd(tmp_path))
    assert len(flight.streams["imu"]) == 4
    assert flight.notes[0] == "skipped: DataNew.mat: IMU, row 4 is -5.000 ms after the one before: left out"
    assert flight.notes[1].startswith("assumed: imu: noise of the unit of such recordings: gyro.noise=0.02,")
    assert flight.streams["tags"].seen.sum() == 3
    assert flight.streams["imu"].specific_force[0].tolist() == [9.81, 0.0, 0.0]
    shifted = umd.load(str(tmp_path / "DataNew.mat"), settings={"imu.time_offset": "0.005"})
    assert shifted.streams["imu"].time[0] - flight.streams["imu"].time[0] == 5_000_000


def test_a_malformed_recording_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"DetAll, cell 2: an image is malformed"):
        umd.load(small_umd(tmp_path, DetAll=array_of([np.zeros((1, 9)), np.zeros((1, 7)), np.zeros((1, 9))])))  # type: ignore[list-item]
    with pytest.raises(DataError, match=r"images and stamps differ in number"):
        umd.load(small_umd(tmp_path, TLeftImgs=np.zeros(2)))
    with pytest.raises(DataError, match=r"IMU, row 2"):
        umd.load(small_umd(tmp_path, IMU=np.vstack([np.zeros(11), np.full(11, np.nan)])))


def small_rob6213(folder: Path, lines: int = 60) -> str:
    t = np.arange(40) * 0.02 + 0.01
    x = np.stack([np.sin(t), np.cos(t), 1.0 + t], axis=1)
    zeros = np.zeros((40, 3))
    savemat(
        folder / "proj2_dataset7.mat",
        {"time": t, "position": x, "angle": zeros, "linearVel": zeros, "angVel": zeros},
    )
    s = np.arange(lines) * 0.015
    table = np.concatenate(
        [s[:, None], np.stack([np.sin(s), np.cos(s), 1.0 + s], axis=1), np.zeros((lines, 9))], axis=1
    )
    text = "t,x,y,z,roll,pitch,yaw,vx,vy,vz,wx,wy,wz\n" + "\n".join(
        ",".join(map(repr, r.tolist())) for r in table
    )
    (folder / "vicon_dataset7.csv").write_text(text + "\n")
    return str(folder / "proj2_dataset7.mat")


def test_an_imu_is_derived_and_said_to_be(tmp_path):
    flight = load_flight("rob6213:" + small_rob6213(tmp_path), settings={"frame": "raw", "delay": "0.05"})
    assert set(flight.streams) == {"pose", "motion", "imu"}
    assert "info: imu: derived from the motion capture, not recorded" in flight.notes
    middle = slice(20, 60)
    t = flight.streams["imu"].time[middle] * 1e-9
    force = flight.streams["imu"].specific_force[middle]
    np.testing.assert_allclose(force[:, 2], 9.81, atol=0.1)
    np.testing.assert_allclose(force[:, 0], -np.sin(t), atol=0.1)
    assert flight.streams["motion"].time[0] == 10_000_000 - 50_000_000
    (tmp_path / "vicon_dataset7.csv").unlink()
    alone = rob6213.load(str(tmp_path / "proj2_dataset7.mat"))
    assert alone.truth is None
    assert "imu" not in alone.streams
    assert any("no motion capture" in n for n in alone.notes)


def broken_rob6213(folder: Path, rows: range, columns: slice, word: str = "NaN") -> str:
    """The small flight with cells of some rows of its motion capture replaced by a word."""
    file = small_rob6213(folder)
    csv = folder / "vicon_dataset7.csv"
    lines = [line.split(",") for line in csv.read_text().splitlines()]
    for k in rows:
        lines[1 + k][columns] = [word] * len(lines[1 + k][columns])
    csv.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return file


@pytest.mark.parametrize(("rows", "columns", "word"), [
    (range(20, 22), slice(1, 4), "NaN"),
    (range(20, 21), slice(1, 13), ""),
    (range(30, 33), slice(6, 7), "inf"),
])  # fmt: skip
def test_rows_of_the_motion_capture_that_are_not_finite_are_masked(tmp_path, rows, columns, word):
    given = {"frame": "raw", "delay": "0.05"}
    flight = load_flight("rob6213:" + broken_rob6213(tmp_path, rows, columns, word), settings=given)
    assert flight.truth is not None
    assert np.isnan(flight.truth["position"]).all(axis=1).nonzero()[0].tolist() == list(rows)
    assert f"skipped: truth: {len(rows)} of 60 rows hold NaN, masked" in flight.notes
    whole = load_flight("rob6213:" + small_rob6213(tmp_path), settings=given)
    np.testing.assert_array_equal(flight.streams["imu"].time, whole.streams["imu"].time)
    np.testing.assert_allclose(
        flight.streams["imu"]["specific_force"][10:75],
        whole.streams["imu"]["specific_force"][10:75],
        atol=0.4,
    )


def test_where_the_motion_capture_is_blind_no_imu_is_derived(tmp_path):
    given = {"frame": "raw", "delay": "0.05"}
    flight = load_flight("rob6213:" + broken_rob6213(tmp_path, range(20, 40), slice(1, 13)), settings=given)
    t = flight.streams["imu"].seconds
    steps = np.diff(t)
    assert steps.max() == pytest.approx(
        21 * 0.015 + 0.11, abs=0.02
    )  # from a row to a row, half a window more
    assert t[int(steps.argmax())] == pytest.approx(19 * 0.015 - 0.055, abs=0.011)


def test_poses_and_velocities_that_are_not_finite_are_absent(tmp_path):
    file = small_rob6213(tmp_path)
    t = np.arange(40) * 0.02 + 0.01
    x = np.stack([np.sin(t), np.cos(t), 1.0 + t], axis=1)
    velocity = np.zeros((40, 3))
    x[[3, 4], 1], velocity[7], t[39] = np.nan, np.inf, np.nan
    content = {"time": t, "position": x, "angle": np.zeros((40, 3)), "linearVel": velocity}
    savemat(tmp_path / "proj2_dataset7.mat", {**content, "angVel": np.zeros((40, 3))})
    flight = load_flight("rob6213:" + file, settings={"frame": "raw", "delay": "0"})
    assert [len(flight.streams[name]) for name in ("pose", "motion")] == [37, 38]
    for said in ("pose: 2 of 39 rows", "motion: 1 of 39 rows", "1 of 40 stamps are not finite"):
        assert any(n.startswith("skipped: ") and said in n for n in flight.notes)


def test_a_motion_capture_of_few_finite_rows_is_refused(tmp_path):
    with pytest.raises(
        DataError, match=r"no motion capture of the family[\s\S]*too few rows that are finite"
    ):
        rob6213.load(broken_rob6213(tmp_path, range(45), slice(2, 3)))


def test_a_malformed_motion_capture_is_refused(tmp_path):
    file = small_rob6213(tmp_path)
    csv = tmp_path / "vicon_dataset7.csv"
    csv.write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"no motion capture of the family[\s\S]*another heading"):
        rob6213.load(file)
    with pytest.raises(DataError, match=r"the motion capture is missing"):
        rob6213.load(f"{file}:{tmp_path / 'none.csv'}")
    with pytest.raises(UnknownNameError, match=r"raw, registered"):
        rob6213.load(file, settings={"frame": "bent"})
    small_rob6213(tmp_path)
    with pytest.raises(DeclarationError, match=r"setting 'delay' is not usable"):
        rob6213.load(file, settings={"delay": "soon"})


def test_a_simulated_flight_without_packets_is_refused():
    with pytest.raises(DeclarationError, match=r"this flight has no packet"):
        course.load(settings={"duration": "0"})


@pytest.mark.skipif(not (DATA / "nyu_rob6213").is_dir(), reason="no nyu_rob6213 under $FLOWGRAPH_DATA")
@pytest.mark.parametrize(("number", "most"), [(1, 0.055), (4, 0.095)])
def test_the_velocity_model_fits_the_recorded_velocity_at_the_delay_that_is_found(number, most):
    flight = load_flight(f"rob6213:{DATA / 'nyu_rob6213' / f'proj2_dataset{number}.mat'}")
    (note,) = [n for n in flight.notes if n.startswith("assumed: motion:")]
    assert 0.05 < flight.info["delay"] < 0.08
    assert float(note.split("then ")[1].split(" ")[0]) <= most
