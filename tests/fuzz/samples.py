"""A small whole file of each kind that is read, and what reads it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from flowgraph import Pipeline, lower, simulate
from flowgraph.blocks.datasets.course import simulated_content
from flowgraph.blocks.datasets.parameters import parse_parameters
from flowgraph.blocks.vision import course_map
from flowgraph.blocks.vision.tags import TagMap
from flowgraph.data.registry import find_graph, load_flight
from flowgraph.engines.state import load_registers, load_state, save_state
from flowgraph.study.spec import Study
from flowgraph.study.store import RUNS, Store, pack_trajectory, read_table, read_trajectory
from tests.blocks.datasets import test_datasets, test_euroc, test_studentdata
from tests.blocks.datasets import test_navigation_files as files
from tests.blocks.datasets.bags import Pen


@dataclass(frozen=True)
class Sample:
    """A folder with files.

    Args:
        name: of the kind, and of the file in it that is damaged.
        folder: where it lies.
        file: the one that is damaged, in the folder.
        read: reads the folder's path; raises what it raises.
    """

    name: str
    folder: Path
    file: str
    read: Callable[[Path], Any]


def _flight(spec: str, **settings: str) -> Callable[[Path], Any]:
    """`spec` has {} for the folder."""
    return lambda folder: load_flight(spec.format(folder), settings=settings)


def _euroc(folder: Path) -> None:
    for name, text in (
        ("imu0/data.csv", test_euroc.IMU),
        ("imu0/sensor.yaml", test_euroc.SENSOR),
        ("leica0/data.csv", test_euroc.LEICA),
        ("vicon0/data.csv", test_euroc.VICON),
        ("vicon0/sensor.yaml", test_euroc.SENSOR),
        ("groundtruth.tum", test_euroc.TUM),
    ):
        (folder / "mav0" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "mav0" / name).write_text(text)


def _bag(path: Path, version: int) -> None:
    with Pen(path, version) as pen:
        for k in range(6):
            pen.imu("/imu", 10**18 + k * 10**7, [0.1, 0.2, 0.3], [0.0, 0.0, 9.81])
            pen.pose("/vicon", 10**18 + k * 10**7, [1.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0])


def made(folder: Path) -> list[Sample]:
    """The samples, written into a folder."""
    found: list[Sample] = []

    def add(name: str, make: Callable[[Path], Any], read: Callable[[Path], Any], *files: str) -> None:
        (folder / name).mkdir(parents=True)
        make(folder / name)
        found.extend(Sample(f"{name}/{file}", folder / name, file, read) for file in files)

    add("csv", test_datasets.table, _flight("csv:{}/log.csv", **test_datasets.MAP), "log.csv")
    add("tum", lambda f: (f / "a.tum").write_text(test_euroc.TUM), _flight("tum:{}/a.tum"), "a.tum")
    inside = ("imu0/data.csv", "imu0/sensor.yaml", "vicon0/data.csv", "vicon0/sensor.yaml", "groundtruth.tum")
    add("euroc", _euroc, _flight("euroc:{}"), *(f"mav0/{name}" for name in inside))
    add("broad", lambda f: test_datasets.trial(f / "t.mat"), _flight("broad:{}/t.mat"), "t.mat")
    add(
        "ese650",
        lambda f: [test_datasets.course(f, n, 1.5) for n in (1, 2)],
        _flight("ese650:{}:1"),
        "imuRaw1.mat",
        "viconRot2.mat",
    )
    add("umd", test_studentdata.small_umd, _flight("umd:{}/DataNew.mat"), "DataNew.mat", "CalibParams.mat")
    add(
        "rob6213",
        test_studentdata.small_rob6213,
        _flight("rob6213:{}/proj2_dataset7.mat"),
        "proj2_dataset7.mat",
        "vicon_dataset7.csv",
    )
    add(
        "studentdata",
        lambda f: test_studentdata.written(f, simulated_content(1, duration=0.1)),
        _flight("studentdata:{}/studentdata9.mat"),
        "studentdata9.mat",
    )
    text = test_studentdata.TEXT.format(ids="1, 2, 3; 4, 5, 6")
    add(
        "parameters",
        lambda f: (f / "parameters.txt").write_text(text),
        lambda f: parse_parameters(f / "parameters.txt"),
        "parameters.txt",
    )
    add("bag1", lambda f: _bag(f / "a.bag", 1), _flight("rosbag:{}/a.bag"), "a.bag")
    add("bag2", lambda f: _bag(f / "a", 2), _flight("rosbag:{}/a"), "a/a.db3", "a/metadata.yaml")
    add("ardupilot", lambda f: files.log(f / "a.bin", files.flown()), _flight("ardupilot:{}/a.bin"), "a.bin")
    add(
        "gins",
        lambda f: files.folder(f / "car"),
        _flight("gins:{}/car"),
        *(f"car/{name}" for name in ("ADIS16465.txt", "GNSS_RTK.txt", "truth.nav")),
    )
    add("navego", lambda f: savemat(f / "a.mat", files.structs()), _flight("navego:{}/a.mat"), "a.mat")
    add(
        "tags",
        lambda f: course_map().save(f / "tags.json"),
        lambda f: TagMap.load(f / "tags.json"),
        "tags.json",
    )
    _add_saved(add)
    return found


def _add_saved(add: Callable[..., None]) -> None:
    """What is written here and read again."""
    flight = load_flight("sim", settings={"duration": "0.2"})
    prepare = find_graph("ekf").prepare
    assert prepare is not None
    case = prepare(flight)
    result = simulate(case.graph, case.inputs)
    add(
        "state",
        lambda f: save_state(result.state, f / "state.npz"),
        lambda f: load_registers(case.graph, load_state(f / "state.npz")),
        "state.npz",
    )
    add("pipeline", lambda f: lower(case.graph).save(f), Pipeline.load, "pipeline.json")
    study = Study(graphs=["ekf"], data=["sim"], seeds=[0, 1], parameters={"duration": [0.2]})
    toml = 'graphs = ["ekf"]\ndata = ["sim"]\nseeds = 2\nkeep = true\n[parameters]\nduration = [0.2, 0.4]\n'
    toml += "position_noise = {logspace = [0.01, 0.1, 3]}\n"
    add("study", lambda f: (f / "s.toml").write_text(toml), lambda f: Study.load(f / "s.toml"), "s.toml")
    row = {"graph": "ekf", "data": "sim", "seed": 1, "error": None, "position_rmse_m": 0.1, "key": "ab" * 16}
    kept = pack_trajectory(result.series)

    def results(folder: Path) -> None:
        store = Store(folder)
        store.write_study(study.resolved())
        store.write_table([row, {**row, "seed": 0}])
        store.write([("ab" * 16, row, kept)])

    add("results", results, read_table, "results.parquet")
    add("resolved", results, lambda f: Study.load(f / "study.json"), "study.json")
    add("run", results, lambda f: _same(Store(f), row), RUNS)
    trajectory = f"trajectories/{'ab' * 16}.npz"
    add("trajectory", results, lambda f: read_trajectory(f / trajectory), trajectory)
    add("kept", results, lambda f: _whole(Store(f), kept), trajectory)


def _same(store: Store, row: dict[str, Any]) -> None:
    """A run that is read is the one that was kept, or is none."""
    found = store.read(["ab" * 16]).get("ab" * 16)
    assert found is None or json.dumps(found.row, sort_keys=True) == json.dumps(row, sort_keys=True)


def _whole(store: Store, content: bytes) -> None:
    """A trajectory that counts as kept is the one that was."""
    same = store.trajectory_file("ab" * 16).read_bytes() == content
    kept = store.read(["ab" * 16])["ab" * 16]
    assert store.has_trajectory(kept) == same


def is_flight(found: Any) -> bool:
    """Whether what a loader gives is sound: finite stamps that increase in each stream."""
    streams = getattr(found, "streams", {})
    return all(bool((np.diff(s.time) > 0).all()) for s in streams.values() if hasattr(s, "time"))
