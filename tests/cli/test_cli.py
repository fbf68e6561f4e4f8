"""The command: what it refuses and with which status, and that nothing it prints is other than promised."""

from __future__ import annotations

import importlib
import io
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import flowgraph
from flowgraph import (
    DataError,
    DeclarationError,
    OutputError,
    ProgressBar,
    Report,
    Run,
    Scalar,
    Series,
    Stream,
    find_graph,
    graph,
    load_flight,
    lower,
    save_state,
    simulate,
    simulate_many,
)
from flowgraph.cli import app
from flowgraph.cli.terminal import PlainConsole, table
from flowgraph.data.progress import tick_count
from flowgraph.drawing.plot import plot_result
from flowgraph.errors import writes
from tests.support import scalars

RUN = ("run", "ins_eskf", "--data", "sim", "--set", "duration=2")


def invoke(*arguments: str):
    done = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, arguments)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done


@pytest.fixture
def taken(tmp_path: Path) -> Path:
    """A file, which can be no folder."""
    file = tmp_path / "taken"
    file.write_text("mine")
    return file


@graph
def echo(x: Stream[Scalar]):
    return x


# -- files that cannot be written ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("lower", "ins_eskf", "-o", "{}"),
        ("lower", "ins_eskf", "-o", "{}/below"),
        ("show", "ins_eskf", "-o", "{}/x.svg"),
        ("show", "ins_eskf", "-o", "{}/x.dot"),
        (*RUN, "--out", "{}"),
        (*RUN, "--out", "{}/below"),
        ("demo", "--out", "{}"),
    ],
)
def test_what_cannot_be_written_is_a_message(arguments, taken):
    done = invoke(*(a.format(taken) for a in arguments))
    assert done.exit_code == 1
    assert done.stdout == ""
    for part in ("cannot be written", str(taken), "expected:", "got:", "fix:"):
        assert part in done.stderr
    assert taken.read_text() == "mine"


def test_the_folder_is_tried_before_the_run(taken, monkeypatch):
    monkeypatch.setattr("flowgraph.cli.filters.simulate", lambda *_, **__: pytest.fail("it ran"))
    assert invoke(*RUN, "--out", str(taken)).exit_code == 1


def test_the_library_says_what_cannot_be_written(taken):
    built = echo.build()
    result = simulate(built, {"x": scalars([0, 5])})
    for write in (
        lambda: built.draw(taken / "x.dot"),
        lambda: plot_result(result, taken / "x.png"),
        lambda: save_state(result.state, taken / "x.npz"),
        lambda: save_state(result.state, taken.parent / "nowhere" / "x.npz"),
        lambda: lower(built).save(taken),
    ):
        with pytest.raises(OutputError, match="cannot be written") as caught:
            write()
        assert caught.value.path
        assert caught.value.fix


def test_other_errors_pass_where_files_are_written():
    with pytest.raises(ZeroDivisionError), writes("x"):
        _ = 1 / 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
@pytest.mark.parametrize(
    "arguments", [("list",), ("list", "--json"), ("show", "ins_eskf"), ("--help",), ("--version",)]
)
def test_a_full_standard_output_is_a_message(arguments):
    program = "import sys; from flowgraph.cli import main; sys.argv[0] = 'flowgraph'; main()"
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", program, *arguments],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=600,
            check=False,
        )
    assert done.returncode == 1, done.stderr
    assert "error: OSError" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_the_version_is_that_of_the_distribution():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    done = invoke("--version")
    assert (done.exit_code, done.stdout) == (0, f"flowgraph {project['version']}\n")


# -- wrong use -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", ["-1", str(2**64), "x"])
@pytest.mark.parametrize("arguments", [RUN, ("show", "ins_eskf"), ("demo",)])
def test_a_seed_out_of_range_is_wrong_use(arguments, seed):
    done = invoke(*arguments, "--seed", seed)
    assert done.exit_code == 2
    assert "seed" in done.stderr
    assert "called" not in done.stderr


BAD = [
    ("ins_eskf", "sim", "position_noise=inf"),
    ("ins_eskf", "sim", "position_noise=nan"),
    ("ins_eskf", "sim", "position_noise=0"),
    ("ins_eskf", "sim", "position_noise=1e200"),
    ("ins_eskf", "sim", "attitude_noise=-1"),
    ("ins_eskf", "sim", "gyro_factor=0"),
    ("ins_eskf", "sim", "accelerometer_factor=-2"),
    ("ins_eskf", "sim", "gate=0"),
    ("ins_eskf", "sim", "gate=1_0"),
    ("ins_eskf", "sim", "settle=-1"),
    ("ins_eskf", "sim", "duration=0"),
    ("ins_eskf", "sim", "duration=abc"),
    ("ins_eskf", "sim", "duration=1e13"),
    ("ins_eskf", "sim", "duration=1e300"),
    ("ins_eskf", "sim", "imu.rate=1e12"),
    ("ins_eskf", "sim:hover", "duration=1e13"),
    ("ins_eskf", "sim:thesis", "duration=1e3"),
    ("ins_eskf", "sim:hover", "sensors="),
    ("ins_eskf", "sim:hover", "gps.rate=1"),
    ("ins_eskf", "euroc:nowhere", "leica.time_offset=abc"),
    ("ins_eskf", "euroc:nowhere", "leica.time_offset=1e30"),
    ("rbpf_indoor", "sim", "particles=0"),
    ("rbpf_indoor", "sim", "particles=-3"),
    ("rbpf_indoor", "sim", "particles=100000000000"),
    ("rbpf_indoor", "sim", "particles=1.5"),
    ("rbpf_indoor", "sim", "still=-1"),
    ("rbpf_indoor", "sim", "resample_below=nan"),
    ("rbpf_indoor", "sim", "seed=-1"),
    ("rbpf_indoor", "sim", "scheme=x"),
    ("rbpf_indoor", "sim", "position_noise=0"),
]


@pytest.mark.parametrize(("name", "data", "setting"), BAD, ids=[" ".join(row) for row in BAD])
def test_a_setting_that_is_not_usable_is_wrong_use(name, data, setting):
    done = invoke("run", name, "--data", data, "--set", setting, "--json")
    assert done.exit_code == 2, done.stderr
    assert done.stdout == ""
    for part in (setting.partition("=")[0], "expected:", "got:", "fix:"):
        assert part in done.stderr


def test_files_that_are_missing_are_a_failure():
    assert invoke("run", "ins_eskf", "--data", "euroc:nowhere").exit_code == 1


def test_a_setting_given_twice_with_two_values_is_refused():
    done = invoke(*RUN, "--set", "gate=9", "--set", "gate=16")
    assert done.exit_code == 2
    assert "given twice" in done.stderr
    assert "9 and 16" in done.stderr
    assert invoke(*RUN, "--set", "gate=9", "--set", "gate=9", "--json").exit_code == 0


def test_the_factors_act_on_a_simulated_flight():
    flight = load_flight("sim", settings={"duration": "2"})
    prepare = find_graph("ins_eskf").prepare
    assert prepare is not None
    usual, same, other = (
        prepare(flight, **given) for given in ({}, {"gyro_factor": 1.0}, {"gyro_factor": 30.0})
    )
    errors = [case.score(simulate(case.graph, case.inputs)) for case in (usual, same, other)]
    assert errors[0] == errors[1]
    assert errors[0] != errors[2]


@pytest.mark.parametrize("value", [True, "1", float("nan"), float("inf"), -1.0])
def test_the_library_refuses_the_same_settings(value):
    flight = load_flight("sim", settings={"duration": "2"})
    for name in ("ins_eskf", "rbpf_indoor"):
        with pytest.raises(DeclarationError, match="setting 'settle' is out of range"):
            find_graph(name).case(flight, settle=value)


# -- what is printed -------------------------------------------------------------------------------------


def test_a_metric_that_is_no_number_is_a_failure(monkeypatch):
    module = importlib.import_module("flowgraph.graphs.ins_eskf")
    monkeypatch.setattr(module, "pose_errors", lambda *_, **__: {"position_rmse_m": np.nan})
    done = invoke(*RUN, "--json")
    assert done.exit_code == 1
    assert done.stdout == ""
    assert "position_rmse_m" in done.stderr


def test_memory_that_does_not_suffice_is_a_failure(monkeypatch):
    def greedy(*_: object, **__: object) -> None:
        raise MemoryError("14 PiB")

    monkeypatch.setattr("flowgraph.cli.options.load_flight", greedy)
    done = invoke(*RUN)
    assert done.exit_code == 1
    assert "not enough memory" in done.stderr


def test_json_is_all_there_is_on_standard_output(tmp_path):
    program = "import sys; from flowgraph.cli import main; sys.argv[0] = 'flowgraph'; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, *RUN, "--json", "--out", str(tmp_path / "new")],
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
        env={**os.environ, "MPLBACKEND": "Agg"},
    )
    assert json.loads(done.stdout)["graph"] == "ins_eskf"
    assert "Fontconfig" not in done.stderr
    written = {"diagram.svg", "estimate.tum", "metrics.json", "navigation.png", "trajectory.png"}
    assert {f.name for f in (tmp_path / "new").iterdir()} == written


def test_other_words_on_standard_error_pass():
    program = (
        "import os; from flowgraph.drawing.fonts import without_font_warnings as quiet\n"
        "with quiet(): os.write(2, b'Fontconfig warning: x\\nother\\n')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr == "other\n"


# -- progress --------------------------------------------------------------------------------------------


def on_a_terminal() -> tuple[Console, io.StringIO]:
    file = io.StringIO()
    return Console(file=file, force_terminal=True, width=100), file


@pytest.mark.parametrize("engine", ["python", "reference", "xla"])
@pytest.mark.parametrize("n", [1, 2048, 5000])
def test_the_bar_is_told_the_last_tick_in_each_engine(engine, n):
    if engine == "xla":
        pytest.importorskip("jax")
    inputs = {"x": scalars(range(n))}
    console, file = on_a_terminal()
    with ProgressBar("echo", total=inputs, console=console) as bar:
        simulate(echo.build(), inputs, engine=engine, progress=bar)
    assert bar.ticks == bar.total == n
    assert "echo" in file.getvalue()
    assert f"{n}/{n}" in file.getvalue()


def test_a_log_stays_clean():
    file = io.StringIO()
    with ProgressBar("echo", total=3, console=Console(file=file)) as bar:
        simulate(echo.build(), {"x": scalars(range(3))}, progress=bar)
    assert file.getvalue() == ""
    assert bar.ticks == 3


def test_a_bar_counts_runs():
    with ProgressBar(total=4) as bar:
        simulate_many(echo.build(), {"x": scalars([0, 1])}, range(4), engine="python", progress=bar)
    assert bar.ticks == 4


def test_a_bar_without_an_end_and_after_an_error():
    console, file = on_a_terminal()
    bar = ProgressBar("x", console=console)
    with pytest.raises(ZeroDivisionError), bar:
        _ = 1 / 0
    bar.update(1, 0)  # harmless after the end
    assert (bar.ticks, bar.total) == (1, None)
    assert "x" in file.getvalue()


@pytest.mark.parametrize("total", [-1, True, "many", 1.5])
def test_a_total_is_a_count(total):
    with pytest.raises(DeclarationError, match="no number of ticks"):
        ProgressBar(total=total)


def test_ticks_of_inputs_are_counted_once_a_time():
    assert tick_count({"x": scalars([0, 10, 20]), "y": scalars([10, 15])}) == 4
    assert tick_count({"x": (np.array([1, 2]), np.zeros(2)), "y": scalars([2, 3])}) == 3
    assert tick_count({"x": iter([])}) is None
    assert tick_count({}) == 0
    flight = load_flight("sim", settings={"duration": "2"})
    case = find_graph("ins_eskf").case(flight)
    assert tick_count(flight) == Run(case.graph, case.inputs).to_end().ticks


def test_flowgraph_does_not_import_rich():
    program = (
        "import sys, flowgraph; assert 'rich' not in sys.modules\n"
        "from flowgraph import ProgressBar; assert 'rich' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    assert flowgraph.ProgressBar is ProgressBar
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = flowgraph.nothing  # type: ignore[attr-defined]


# -- inputs and seeds --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"inputs": [1]}, "these are no inputs"),
        ({"inputs": None}, "these are no inputs"),
        ({"seed": -1}, "this is no seed"),
        ({"seed": "a"}, "this is no seed"),
        ({"seeds": []}, "need a seed each"),
        ({"seeds": 5}, "need a seed each"),
        ({"seeds": [1, -1]}, "this is no seed"),
    ],
)
def test_simulate_refuses_what_it_cannot_run(options, words):
    given = {"inputs": {"x": scalars([0])}, **options}
    for engine in ("python", "reference"):
        with pytest.raises(flowgraph.FlowgraphError, match=words) as caught:
            simulate(echo.build(), engine=engine, **given)
        assert "called" not in str(caught.value)
        assert caught.value.fix


@pytest.mark.parametrize(
    ("time", "values", "words"),
    [
        (np.array([1, 2**63], dtype=np.uint64), np.zeros(2), r"series, row 1: a time is beyond[\s\S]*2\^63"),
        ([1, 2], [[1.0, 2.0], [3.0]], "no array of numbers"),
        ([1, [2, 3]], [1.0, 2.0], "no array of numbers"),
        ([[1, 2]], [[1.0, 2.0]], "times must be one array"),
        (5, 1.0, "times must be one array"),
    ],
)
def test_a_series_refuses_what_is_no_array(time, values, words):
    with pytest.raises(flowgraph.DataError, match=words):
        Series(time, values)


# Experiments


def two_rows(*, flights: int = 2, data: str | None = None) -> Report:
    """Count flights."""
    rows = [{"flight": k, "error_m": 0.5 * k} for k in range(flights)]

    def written(path: Path) -> None:
        path.write_text(str(rows))

    return Report(rows, {"table.txt": written}, ("counted, not flown",))


@pytest.fixture
def counted(monkeypatch):
    for place in ("flowgraph.cli.bench.find_bench", "flowgraph.data.registry.find_bench"):
        monkeypatch.setattr(place, lambda name: two_rows)


def test_a_bench_prints_its_rows_and_writes_its_pictures(counted, tmp_path):
    done = invoke("bench", "two", "--flights", "3", "--json", "--out", str(tmp_path))
    assert done.exit_code == 0
    assert [row["error_m"] for row in json.loads(done.stdout)["rows"]] == [0.0, 0.5, 1.0]
    assert "counted, not flown" in done.stderr
    assert (tmp_path / "table.txt").exists()
    assert "error_m" in invoke("bench", "two").stdout


def test_a_bench_refuses_an_option_that_it_does_not_have(counted):
    done = invoke("bench", "two", "--seed", "3")
    assert done.exit_code == 2
    assert "--seed" in done.stderr
    assert "flights" in done.stderr
    assert invoke("bench", "two", "--set", "flights=many").exit_code == 2


def test_an_unknown_bench_is_refused_by_name():
    done = invoke("bench", "nothing")
    assert done.exit_code == 2
    assert "'nothing'" in done.stderr


# -- what a lowered graph costs ------------------------------------------------------------------------


def test_lower_writes_what_a_graph_costs(tmp_path):
    done = invoke("lower", "kalman", "--set", "duration=1", "--report", "--json", "-o", str(tmp_path))
    assert done.exit_code == 0, done.stderr
    cost = json.loads(done.stdout)["cost"]
    assert cost["Ticks"][-1]["operations"] == cost["Operations"][-1]["optimised"]
    assert "cost of kalman" in (tmp_path / "report.txt").read_text()
    assert (tmp_path / "report.html").read_text().startswith("<!doctype html>")


def test_lower_leaves_passes_out_by_name(tmp_path):
    command = ("lower", "kalman", "--set", "duration=1", "--report", "--json", "-o")
    full = json.loads(invoke(*command, str(tmp_path / "a")).stdout)["cost"]
    some = invoke(*command, str(tmp_path / "b"), "--without", "structure", "--without", "unroll")
    fewer = json.loads(some.stdout)["cost"]
    assert full["Ticks"][0]["operations"] < fewer["Ticks"][0]["operations"]
    done = invoke(*command, str(tmp_path / "c"), "--without", "everything")
    assert done.exit_code == 2
    assert "no pass is called 'everything'" in done.stderr
    assert not (tmp_path / "c").exists()


def test_lower_without_a_report_writes_none(tmp_path):
    assert invoke("lower", "kalman", "--set", "duration=1", "-o", str(tmp_path)).exit_code == 0
    assert not (tmp_path / "report.txt").exists()


@pytest.mark.parametrize(
    ("graph", "data", "picture"),
    [("particle", "sim:plane", "outputs.png"), ("roll_pitch", "sim:roundtrip", "orientation.png")],
)
def test_a_report_of_what_has_no_place_in_space(graph, data, picture, tmp_path):
    done = invoke("run", graph, "--data", data, "--set", "duration=2", "--out", str(tmp_path), "--json")
    assert done.exit_code == 0, done.stderr
    assert (tmp_path / picture).stat().st_size > 5_000


@pytest.mark.parametrize("graph", ["tag_pose", "particle", "ins_ukf_velocity", "orientation_complementary"])
def test_a_graph_is_shown_on_a_flight_that_fits(graph):
    done = invoke("show", graph)
    assert done.exit_code == 0
    assert done.stdout.startswith(graph)


@pytest.mark.parametrize("encoding", ["cp1252", "cp437", "ascii", "latin-1", "utf-8"])
def test_a_graph_is_shown_in_the_characters_that_a_terminal_has(encoding):
    done = subprocess.run(
        [sys.executable, "-c", "from flowgraph.cli import app; app()", "show", "ins_eskf"],
        env={**os.environ, "PYTHONIOENCODING": encoding}, capture_output=True, check=True,
    )  # fmt: skip
    shown = done.stdout.decode(encoding)
    assert "predict" in shown
    assert ("▷ imu" if encoding == "utf-8" else "> imu") in shown
    assert "?" not in shown


def test_fold_is_an_option_of_show():
    assert "folded" in invoke("show", "rbpf_outdoor", "--fold", "0").stdout


class _Breaks:
    def __init__(self, *_: object, **__: object) -> None:
        raise RuntimeError("no ink")


@pytest.mark.slow
def test_a_run_is_exported_beside_its_flight(tmp_path):
    reader = pytest.importorskip("mcap.reader", reason="needs the extra mcap")
    done = invoke(*RUN, "--out", str(tmp_path), "--export", "csv, mcap", "--json")
    assert done.exit_code == 0, done.stderr
    assert f"wrote {tmp_path / 'run.mcap'}" in done.stderr
    head = (tmp_path / "streams.csv").read_text().partition("\n")[0]
    assert "belief.position.x [m]" in head
    assert "flight.truth.attitude.w" in head
    with open(tmp_path / "run.mcap", "rb") as stream:
        channels = reader.make_reader(stream).get_summary().channels.values()
    assert {"/belief/pose", "/flight/truth/pose", "/flight/imu", "/tf"} <= {c.topic for c in channels}


@pytest.mark.parametrize(
    ("options", "words"),
    [(("--export", "mcap"), "--out DIR"), (("--out", "{}", "--export", "mcap,xls"), "'xls'")],
)
def test_what_cannot_be_exported_is_refused_before_the_run(options, words, tmp_path, monkeypatch):
    monkeypatch.setattr("flowgraph.cli.filters.simulate", None)
    done = invoke(*RUN, *(o.format(tmp_path / "new") for o in options))
    assert done.exit_code != 0
    assert words in done.stderr
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("what", ["Graph.draw", "drawing.canvas.new_figure", "drawing.trajectory.plot_space"])
def test_a_picture_that_fails_takes_no_results_with_it(what, tmp_path, monkeypatch):
    monkeypatch.setattr(f"flowgraph.{what}", _Breaks)
    out = tmp_path / "out"
    done = invoke("run", "ekf", "--data", "sim", "--set", "duration=1", "--out", str(out), "--json")
    assert done.exit_code == 0
    report = json.loads(done.stdout)
    said = [n for n in report["notes"] if n.startswith("skipped: the picture")]
    assert len(said) == 1 + (what == "drawing.canvas.new_figure")
    assert "RuntimeError: no ink" in said[0]
    assert json.loads((out / "metrics.json").read_text())["notes"] == report["notes"]
    assert {"estimate.tum", "metrics.json"} <= {f.name for f in out.iterdir()}
    assert "note: skipped: the picture" in done.stderr


def test_a_graph_that_no_example_fits_is_shown_as_it_stands():
    done = invoke("show", "imu_calibration")
    assert done.exit_code == 0, done.stderr
    assert "counts" in done.stdout
    done = invoke("show", "imu_calibration", "--set", "gated=no")
    assert done.exit_code == 1
    assert "lacks what imu_calibration needs" in done.stderr


@pytest.mark.parametrize("text", ["\x1b[31mred", "\x1b]0;title\x07", "a\rb\x08", "\x9b31m", "\u202eback"])
def test_what_a_file_says_does_not_steer_the_terminal(tmp_path, text):
    """Errors, tables and what is printed beside them: characters that would are spelled out."""
    steering = "\x1b\x07\x08\r\x9b\u202e"
    error = DataError("wrong", path=str(tmp_path / text), got=text)
    assert not set(str(error)) & set(steering)
    sink = io.StringIO()
    console = PlainConsole(file=sink, width=200, force_terminal=False)
    console.print(text, markup=False)
    console.print(table([{"graph": text, text: 1.0}]))
    assert not set(sink.getvalue()) & set(steering)
    (tmp_path / "s.toml").write_text(f'graphs = ["ekf"]\ndata = ["sim"]\n{json.dumps(text)} = 1\n')
    done = invoke("batch", str(tmp_path / "s.toml"), "--out", str(tmp_path / "out"))
    assert done.exit_code == 2
    assert not set(done.stderr) & set(steering)


def test_colours_of_our_own_pass():
    sink = io.StringIO()
    PlainConsole(file=sink, force_terminal=True, color_system="standard").print("[red]a[/red]")
    assert "\x1b[31ma" in sink.getvalue()
