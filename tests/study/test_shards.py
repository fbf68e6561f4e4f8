"""A study whose runs are shared out among devices, and how that is asked for in a command."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from flowgraph import DeclarationError
from flowgraph.cli.options import shared
from flowgraph.study import Study, plan, read_table, run_study

pytest.importorskip("pyarrow")
pytest.importorskip("jax")

COMMAND = [sys.executable, "-c", "from flowgraph.cli import main; main()"]
TOML = """graphs = ["particle"]
data = ["sim:plane"]
seeds = 3
engine = "xla"
chunk = 2
shard = {runs = 2, particles = 2}
[parameters]
duration = 2
particles = 40
"""


def asked(tmp_path: Path, *words: object, devices: int = 1) -> subprocess.CompletedProcess[str]:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    here = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    return subprocess.run(
        [*COMMAND, *map(str, words)], capture_output=True, text=True, check=False, env=here, cwd=tmp_path
    )


def test_a_study_on_four_devices_has_the_figures_of_one(tmp_path):
    """With four devices its rows are those of one device, and too few are refused before anything is run."""
    (tmp_path / "s.toml").write_text(TOML)
    few = asked(tmp_path, "batch", "s.toml", "--out", "few")
    assert few.returncode == 2
    assert "there are not so many devices" in few.stderr
    assert not (tmp_path / "few" / "results.parquet").exists()
    for out, more, devices in (("four", (), 4), ("one", ("--shard", "runs=1"), 1)):
        done = asked(tmp_path, "batch", "s.toml", "--out", out, "--quiet", *more, devices=devices)
        assert done.returncode == 0, done.stderr
    four, one = (read_table(tmp_path / out) for out in ("four", "one"))
    assert len(four) == len(one) == 3
    for a, b in zip(four, one, strict=True):
        assert a["position_rmse_m"] == pytest.approx(b["position_rmse_m"], rel=1e-9)
        assert a["key"] != b["key"]  # equal to rounding only


def test_a_share_is_part_of_what_a_study_says_and_of_its_keys(tmp_path):
    (tmp_path / "s.toml").write_text(TOML)
    study = Study.load(tmp_path / "s.toml")
    assert study.resolved()["shard"] == {"runs": 2, "particles": 2}
    plain = replace(study, shard=None)
    assert "shard" not in plain.resolved()
    assert replace(study, shard={}).shard is None
    keys = [[run.key for run in plan(s).runs] for s in (study, plain)]
    assert not set(keys[0]) & set(keys[1])
    with pytest.raises(DeclarationError, match="not so many devices"):
        run_study(replace(study, shard={"runs": 1000}), tmp_path / "out")
    with pytest.raises(DeclarationError, match="shares nothing out"):
        replace(study, engine="c")


def test_a_run_has_particles_to_share(tmp_path):
    data = ["--data", "sim:plane", "--set", "duration=2", "--set", "particles=40", "--engine", "xla"]
    done = asked(tmp_path, "run", "particle", *data, "--shard", "particles=2", "--json", devices=2)
    assert done.returncode == 0, done.stderr
    for words, why in (
        (["--shard", "particles=2"], "not so many devices"),
        (["--shard", "runs=1"], "a run by itself is no runs"),
        (["--shard", "particles=1", "--stream", "out"], "goes on one device"),
    ):
        done = asked(tmp_path, "run", "particle", *data, *words)
        assert done.returncode == 2
        assert why in done.stderr


def test_a_share_is_spelled_axis_by_axis():
    assert shared(None) is None
    assert shared("runs=2, particles=4") == {"runs": 2, "particles": 4}
    for wrong in ("", "runs", "runs=0", "runs=two", "=2", "runs=1,runs=2", "runs=-1", "runs=1,"):
        with pytest.raises(DeclarationError, match="a number of devices for each axis"):
            shared(wrong)
