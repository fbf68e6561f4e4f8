"""Paths of a study: relative to its file, absolute where they are kept."""

from __future__ import annotations

import json

import pytest

from flowgraph import DeclarationError
from flowgraph.study import Study
from flowgraph.study.places import absolute


@pytest.fixture
def folder(tmp_path):
    """A folder with some that could be recordings."""
    for name in ("MH_01", "deep/set", "a:b", "hover", "1"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("log.csv", "mocap.csv", "cal.mat"):
        (tmp_path / name).write_text("x")
    return tmp_path


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("euroc:MH_01", "euroc:{}/MH_01"),
        ("euroc:./deep/../MH_01", "euroc:{}/MH_01"),
        ("ese650:deep/set:1", "ese650:{}/deep/set:1"),
        ("euroc:a:b", "euroc:{}/a:b"),
        ("umd:log.csv:cal.mat", "umd:{}/log.csv:{}/cal.mat"),
        ("csv:log.csv+csv:mocap.csv", "csv:{}/log.csv+csv:{}/mocap.csv"),
        ("euroc:/MH_01", "euroc:/MH_01"),
        ("euroc:~/MH_01", "euroc:~/MH_01"),
        ("euroc:none", "euroc:none"),
        ("sim:hover", "sim:hover"),
        ("sim", "sim"),
        ("nothing:MH_01", "nothing:MH_01"),
    ],
)
def test_what_is_there_gets_its_absolute_path(folder, spec, expected):
    assert absolute(spec, folder) == expected.format(*[folder] * expected.count("{}"))


@pytest.mark.parametrize("ending", ["toml", "json"])
def test_paths_of_a_file_start_at_the_file(folder, monkeypatch, ending):
    file = folder / "deep" / f"study.{ending}"
    file.write_text(
        'graphs = ["ekf"]\ndata = ["euroc:../MH_01", "sim:hover"]\nout = "results"\n'
        if ending == "toml"
        else json.dumps({"graphs": ["ekf"], "data": ["euroc:../MH_01", "sim:hover"], "out": "results"})
    )
    monkeypatch.chdir(folder)
    study = Study.load("deep/" + file.name)
    assert study.data == (f"euroc:{folder}/MH_01", "sim:hover")
    assert study.out == f"{folder}/deep/results"
    assert study.resolved()["data"] == list(study.data)
    again = folder / "study.json"
    again.write_text(json.dumps(study.resolved()))
    assert Study.load(again) == study


def test_paths_of_a_program_start_where_it_runs(folder, monkeypatch):
    monkeypatch.chdir(folder / "deep")
    assert Study(graphs=["ekf"], data=["euroc:set"]).data == (f"euroc:{folder}/deep/set",)


@pytest.mark.parametrize("path", ["MH_01", "./MH_01", "deep/set"])
def test_a_path_from_where_the_command_runs_is_refused(folder, monkeypatch, path):
    (folder / "studies").mkdir()
    file = folder / "studies" / "study.toml"
    file.write_text(f'graphs = ["ekf"]\ndata = ["euroc:{path}"]\n')
    monkeypatch.chdir(folder)
    with pytest.raises(DeclarationError, match="relative to the study's file") as caught:
        Study.load(file)
    assert f"euroc:{folder}/" in str(caught.value)
