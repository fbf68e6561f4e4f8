"""The runner of field cases: what it reads of what a case printed, and what it makes of it."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from tests.case_expectations import EXPECTATIONS, figure, noted, refused
from tests.cases import Outcome, cases, figures, main, run_case, verdict

TABLE = """\
                      ins_eskf
                        python
ticks                      301
position RMSE [mm]       12.34
attitude [deg]           0.557
position in 3 sigma     51.0 %
position_nis_mean     1.67e+07
"""
ERROR = "error: flight.csv, line 2: no latitude\n  expected: rad\n  got:      47\n  fix:      unit=deg\n"


def outcome(stdout: str = "", stderr: str = "", status: int | None = 0, probed: str = "") -> Outcome:
    return Outcome(status, stdout, stderr, 0.1, list(figures(stdout)), probed)


def case(folder: Path, name: str, script: str, text: str) -> None:
    (folder / name).mkdir(parents=True)
    (folder / name / script).write_text(text)


def test_figures_are_read_from_tables_and_from_json():
    report = json.dumps(
        {"graph": "ekf", "position_rmse_m": 0.5, "notes": ["assumed: a heading of 0"]}, indent=1
    )
    first, second, third = figures(f"word\n{TABLE}{TABLE}{{no json\n{report}\nend")
    assert first == second
    assert first["graph"] == "ins_eskf"
    assert first["position_rmse_m"] == pytest.approx(0.01234)
    assert first["position_3sigma"] == pytest.approx(0.51)
    assert first["position_nis_mean"] == 1.67e7
    assert third["graph"] == "ekf"
    assert third["position_rmse_m"] == 0.5
    assert noted("assumed", "heading")(outcome(report))


def test_an_error_is_read_whole_and_a_crash_is_none_of_ours():
    ours = outcome(stderr=ERROR)
    assert refused("latitude", "unit=deg")(ours)
    assert not refused("latitude", "longitude")(ours)
    trace = "Traceback (most recent call last):\n  File x\n"
    raised = outcome(stderr=f"{trace}flowgraph.errors.DataError: flight.csv: no latitude\n  fix:      mend\n")
    assert refused("latitude", "mend")(raised)
    assert raised.crash is None
    assert outcome(stderr=f"{trace}ValueError: zip() argument 2 is shorter\n").crash == (
        "ValueError: zip() argument 2 is shorter"
    )


def test_a_figure_must_be_there_and_within_its_bounds():
    assert figure("position_rmse_m", 0.02)(outcome(TABLE))
    assert not figure("position_rmse_m", 0.01)(outcome(TABLE))
    assert not figure("heading_rmse_deg", 1.0)(outcome(TABLE))
    assert not figure("position_rmse_m", 0.02)(outcome(""))


def test_a_case_runs_in_a_copy_with_the_environment_named(tmp_path):
    case(
        tmp_path,
        "shell",
        "run.sh",
        'cd "$(dirname "$0")"; echo made > made; test -x "$FLOWGRAPH" && cat data; exit 3',
    )
    (tmp_path / "shell" / "data").write_text("what is in the file\n")
    came = run_case(tmp_path / "shell")
    assert (came.status, came.stdout) == (3, "what is in the file\n")
    assert sorted(f.name for f in (tmp_path / "shell").iterdir()) == ["data", "run.sh"]


def test_a_case_in_python_is_killed_with_what_it_started_after_the_limit(tmp_path):
    left = tmp_path / "left"
    case(
        tmp_path,
        "slow",
        "run.py",
        f"import subprocess, time\nsubprocess.Popen(['sh', '-c', 'sleep 3; touch {left}'])\ntime.sleep(60)",
    )
    came = run_case(tmp_path / "slow", limit=0.5)
    assert came.status is None
    assert came.seconds < 30
    assert verdict(came, None) == "LATE"

    time.sleep(3.0)
    assert not left.exists()


def test_the_command_prints_a_line_each_and_fails_when_one_is_wrong(tmp_path, capsys):
    case(tmp_path, "csv_units_row", "run.py", f"print({TABLE!r})")
    case(tmp_path, "of_nobody", "run.sh", "echo came")
    assert main([str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["right", "csv_units_row"]
    assert "position_rmse_m=0.01234" in lines[0]
    assert lines[1].split()[:2] == ["-", "of_nobody"]
    assert lines[1].endswith("came (no expectation known)")
    (tmp_path / "csv_units_row" / "run.py").write_text(f"import sys; sys.exit({ERROR!r})")
    assert main([str(tmp_path), "--json", "--only", "csv_units_row"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["counts"]["WRONG"] == 1
    assert report["rows"][0]["summary"] == "error: flight.csv, line 2: no latitude"


def test_a_folder_without_cases_and_a_name_that_is_not_there_are_refused(tmp_path):
    with pytest.raises(SystemExit, match="no folder in it has a run.sh or a run.py"):
        cases(tmp_path)
    case(tmp_path, "one", "run.sh", "true")
    with pytest.raises(SystemExit, match="no case is called two; there are one"):
        cases(tmp_path, ["two"])


GOOD = {  # what the right behaviour would print
    "c_fast_math": "-O2: beliefs with nan: 0 of 4001\n-O2 -ffast-math: beliefs with nan: 0 of 4001\n",
    "c_two_variants": "as archives: exit 1\n",
    "draw_broken_dot": "exit 0, printed 900 bytes, files: diagram.svg\nestimate.tum\nmetrics.json\n",
    "engine_casts": "x [1.0]\n"
    + "".join(f"{e} {{'a': [nan]}}\n" for e in ("python", "reference", "xla", "c")),
    "engine_step_writes": "".join(f"{g} {e} [1.0, 2.0]\n" for g in ("g1", "g2") for e in ("python", "c")),
    "kalman_R_as_vector": "[[0.1, 0.0], [0.0, 0.4]] [0.98 0.9] [0.1 0.6]\n[0.1, 0.4] [0.98 0.9] [0.1 0.6]\n",
    "live_full_match": "ticks accepted 200 refused for ever 0 count 200\n",
    "masked_array": "[1.0, 3.0, 4.0]\n[1.0, 3.0, 4.0]\n",
    "names_in_c": "graph loop: c equal | make: ok\n" * 20 + "output 'a': refused at build: a name\n" * 10,
    "replay_csv": "'0,a' -> rc 1 [] e.csv, line 1: no number\n" * 10,
    "ros_names_collide": "{'a': [1.0], 'b': [2.0]} {'a': '/a', 'b': '/b'}\n",
    "show_in_a_plain_terminal": "ascii: exit 0 3000 bytes; \n" * 3,
    "two_studies_one_folder": "6 runs rc 0\nerror: in use rc 1\n"
    "study.json says ['ekf'] | the table holds ['ekf'] | run files 6\n",
    "ukf_known_start": "".join(f"{e} [1.0e-1 0. 0.]\n" for e in ("python", "reference", "xla", "c")),
    "ukf_unknown_heading": "1.0 -> 0.99\n2.0 -> 2.0\n3.141592653589793 -> 3.1415926\n",
    "euler_at_the_pole": "zyx (0.7, 1.5, 0.2) off by 1e-9 degrees\n" * 4,
}
BAD = {  # and what a wrong one printed
    "c_fast_math": "-O2: beliefs with nan: 0 of 4001\n-O2 -ffast-math: beliefs with nan: 4000 of 4001\n",
    "c_two_variants": "as archives: exit 0\n",
    "draw_broken_dot": "exit 1, printed 0 bytes, files: \n",
    "engine_casts": "python {'a': [1]}\nreference {'a': [1]}\nxla {'a': [2]}\nc {'a': [1]}\n",
    "engine_step_writes": "g1 python [2.0, 3.0]\ng1 c [1.0, 1.0]\ng2 python [1.0]\n",
    "kalman_R_as_vector": "[[0.1, 0.0], [0.0, 0.4]] [0.98 0.9] [0.1 0.6]\n[0.1, 0.4] [0.91 0.7] [0.1 0.6]\n",
    "live_full_match": "ticks accepted 54 refused for ever 146 count 54\n",
    "masked_array": "[1.0, 999.0, 3.0, 4.0]\n[1.0, 3.0, 4.0]\n",
    "names_in_c": "graph loop: OSError undefined symbol: loop_react\n" + "source time: c equal\n" * 30,
    "replay_csv": "'0,a' -> rc 0 ['0,o,1'] \n" * 10,
    "ros_names_collide": "{'a': [1.0]} {'a': '/a'}\n",
    "show_in_a_plain_terminal": "ascii: exit 1 0 bytes; UnicodeEncodeError\n" * 3,
    "two_studies_one_folder": "6 runs rc 0\n" * 2
    + "study.json says ['ekf'] | the table holds ['ukf'] | run files 12\n",
    "ukf_known_start": "python LinAlgError not positive definite\n" + "xla [nan nan]\n" * 3,
    "ukf_unknown_heading": "1.0 -> 0.99\n2.0 -> 1.6\n3.141592653589793 -> 0.486\n",
    "euler_at_the_pole": "zyx (0.7, 1.5, 0.2) off by 6.5 degrees\n" * 4,
}


@pytest.mark.parametrize("name", sorted(GOOD))
def test_expectations_tell_right_from_wrong(name):
    assert verdict(outcome(GOOD[name]), EXPECTATIONS[name]) == "right"
    assert verdict(outcome(BAD[name]), EXPECTATIONS[name]) == "WRONG"


@pytest.mark.parametrize("name", sorted(EXPECTATIONS))
def test_nothing_printed_is_right_for_no_case(name):
    assert verdict(outcome(), EXPECTATIONS[name]) == "WRONG"
    crash = outcome(
        stderr="Traceback (most recent call last):\nModuleNotFoundError: No module named 'x'\n", status=1
    )
    assert verdict(crash, EXPECTATIONS[name]) == "WRONG"
