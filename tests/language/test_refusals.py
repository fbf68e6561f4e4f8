"""Bad input, a row each: what is done, the error, and the words its message must hold.

Every message has the same parts: where, what is wrong, what was expected, what came, and the fix.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import (
    Array,
    ClockError,
    CycleError,
    DataError,
    DeclarationError,
    FifoOverflowError,
    FlowgraphError,
    LoweringError,
    Scalar,
    Series,
    Signal,
    Stream,
    TypeMismatchError,
    UnknownNameError,
    block,
    delay,
    every,
    find_graph,
    graph,
    latest,
    load_flight,
    lower,
    match,
    merge,
    periodic,
    real,
    simulate,
    zip,
)
from flowgraph.blocks.datasets import euroc
from flowgraph.blocks.signals import CoordinateAcceleration, SpecificForce
from flowgraph.cli import app
from tests.support import isolated, scalars

IMU = "#timestamp [ns],w,w,w,a,a,a\n1000,0,0,0,0,0,9.81\n6000,0,0,0,0,0,9.81\n"
SENSOR = """rate_hz: 200
gyroscope_noise_density: 1.7e-04
gyroscope_random_walk: 1.9e-05
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
"""


class Metres(Signal):
    x: Array = real(3, unit="m", frame="world")


@block
def add(a, b):
    return a + b


@block
def read_metres(m: real(3, unit="m", frame="world")):  # type: ignore[valid-type]
    return m


@block
def tilt(force: SpecificForce) -> Scalar:
    return force.force[0]


@block
def option(x: Scalar, z: Scalar | None) -> Scalar:
    return x if z is None else x + z


def build(body: Callable[..., Any], kind: Any = Scalar, **clocks: Any) -> Any:
    """A graph of two sources; the body may use either."""

    @graph
    def g(x: Stream[kind], y: Stream[kind]):  # type: ignore[valid-type]
        merge(x, y, tie="left")
        return body(x, y)

    return g.build(**clocks)


def unfed(x, y):
    return add(x, delay(0.0, name="belief"))


def cyclic(x, y):
    held = latest(init=0.0, name="held")
    y = add(x, held, name="sum")
    held.feed(y)
    return y


def twice(x, y):
    return add(add(x, x, name="same"), x, name="same")


def overflow() -> None:
    built = build(lambda x, y: match(x, y, tolerance=1, size=1, name="pairs"))
    simulate(built, {"x": scalars([0, 10, 20]), "y": scalars([])})


def folder(tmp: Path, imu: str | None = IMU) -> Path:
    (tmp / "seq" / "mav0" / "imu0").mkdir(parents=True)
    (tmp / "seq" / "mav0" / "imu0" / "sensor.yaml").write_text(SENSOR)
    if imu is not None:
        (tmp / "seq" / "mav0" / "imu0" / "data.csv").write_text(imu)
    return tmp / "seq"


ROWS: list[tuple[str, Callable[[Path], Any], type[FlowgraphError], list[str]]] = [
    (
        "NaN sample",
        lambda _: simulate(
            build(lambda x, y: add(x, x)), {"x": scalars([0, 5], [1, np.nan]), "y": scalars([])}
        ),
        DataError,
        ["x, row 1", "not finite", "finite numbers", "t = 5 ns", 'not_finite="absent"'],
    ),
    (
        "infinite sample in a file",
        lambda tmp: euroc.load(str(folder(tmp, IMU.replace("9.81\n6000", "inf\n6000")))),
        DataError,
        ["data.csv", "2"],
    ),
    (
        "missing file",
        lambda tmp: euroc.load(str(folder(tmp, None))),
        DataError,
        ["data.csv"],
    ),
    ("missing folder", lambda tmp: load_flight(f"euroc:{tmp / 'nowhere'}"), DataError, ["nowhere"]),
    (
        "wrong column count",
        lambda tmp: euroc.load(str(folder(tmp, IMU + "11000,0,0,0\n"))),
        DataError,
        ["data.csv", "4", "7"],
    ),
    (
        "unequal-rate zip",
        lambda _: build(lambda x, y: zip(x, every(5, x))),
        ClockError,
        [
            "zip(x, every)",
            f"at:       {__name__}:",
            "unequal",
            "equal rates",
            "every(5, x)",
            "latest(slow, init=...)",
        ],
    ),
    (
        "two devices of nominally equal rate",
        lambda _: build(lambda x, y: zip(x, y), x=periodic("5ms"), y=periodic("5ms")),
        ClockError,
        [
            "zip(x, y)",
            f"at:       {__name__}:",
            "only nominally equal",
            "one source",
            "x and y",
            "match(a, b, tolerance=..., size=...)",
        ],
    ),
    (
        "unbounded zip",
        lambda _: build(lambda x, y: zip(x, x.filter(lambda v: v > 0.0))),
        ClockError,
        [
            "zip(x, filter)",
            f"at:       {__name__}:",
            "cannot be proven equal",
            "x and filter",
            "match(",
            "latest(",
        ],
    ),
    (
        "cycle without delay",
        lambda _: build(cyclic),
        CycleError,
        ["sum", "passes through no delay", "held -> sum.b", "delay(init)"],
    ),
    ("unfed delay", lambda _: build(unfed), DeclarationError, ["belief", "never fed", "none", ".feed("]),
    (
        "unconnected port",
        lambda _: build(lambda x, y: add(x)),
        DeclarationError,
        ["add", "'b' is not connected", "add(a, b)", "b=stream"],
    ),
    (
        "duplicate name",
        lambda _: build(twice),
        DeclarationError,
        ["same", "is taken", "a second one", "another name="],
    ),
    (
        "unit mismatch",
        lambda _: build(lambda x, y: read_metres(x), real(3, unit="ft", frame="world")),
        TypeMismatchError,
        ["read_metres.m", "the unit of x", "real[3], m, world", "real[3], ft, world", "ft -> m"],
    ),
    (
        "frame mismatch",
        lambda _: build(lambda x, y: read_metres(x), real(3, unit="m", frame="body")),
        TypeMismatchError,
        ["read_metres.m", "the frame of x", "real[3], m, world", "real[3], m, body", "body -> world"],
    ),
    (
        "shape mismatch",
        lambda _: build(lambda x, y: read_metres(x), real(4, unit="m", frame="world")),
        TypeMismatchError,
        ["read_metres.m", "the shape of x", "real[3]", "real[4]", "sizes agree"],
    ),
    (
        "dtype mismatch",
        lambda _: build(lambda x, y: read_metres(x.map(lambda v: v > 0.0)), real(3)),
        TypeMismatchError,
        ["read_metres.m", "the dtype of map", "real[3]", "bool[3]", "convert"],
    ),
    (
        "specific force wired to coordinate acceleration",
        lambda _: build(lambda x, y: tilt(x), CoordinateAcceleration),
        TypeMismatchError,
        [
            "tilt.force",
            "the signal type of x",
            "SpecificForce",
            "CoordinateAcceleration",
            "different quantities",
        ],
    ),
    (
        "Python branch on a traced value",
        lambda _: build(lambda x, y: x.map(lambda v: v if v > 0.0 else -v)),
        LoweringError,
        [f"map ({__name__}:", "Python branch on a traced value", "xp.where(condition, a, b)"],
    ),
    (
        "unknown graph",
        lambda _: find_graph("ins_eksf"),
        UnknownNameError,
        ["no graph is called 'ins_eksf'", "ins_eskf", "did you mean 'ins_eskf'"],
    ),
    (
        "unknown setting",
        lambda _: find_graph("ins_eskf").build(nosie=1.0, start=None, noise=None, position_noise=1.0),
        UnknownNameError,
        ["ins_eskf", "no source or setting is called 'nosie'", "did you mean 'noise'"],
    ),
    (
        "unknown setting of a flight",
        lambda _: load_flight("sim", settings={"imu.rat": "3"}),
        UnknownNameError,
        ["imu.rat", "did you mean 'imu.rate'"],
    ),
    (
        "unknown kind of flight",
        lambda _: load_flight("eurok:x"),
        UnknownNameError,
        ["no kind of flight is called 'eurok'", "euroc", "did you mean 'euroc'"],
    ),
    (
        "latest without init",
        lambda _: build(lambda x, y: latest(x).at(y)),
        ClockError,
        ["x", "no initial value", "init=...", "latest without init", "latest(stream, init=...)"],
    ),
    (
        "merge without tie",
        lambda _: build(lambda x, y: merge(x, y)),
        ClockError,
        ["merge", "x and y can be present together", "no tie", 'tie="left"'],
    ),
    (
        "option outside main clock",
        lambda _: build(lambda x, y: option(x, y)),
        ClockError,
        ["option", "'z' can come when the block does not fire", "within x", "y at y", "at=x | y"],
    ),
    (
        "all inputs held",
        lambda _: build(lambda x, y: add(latest(x, init=0.0), latest(y, init=0.0))),
        ClockError,
        ["add", "all its inputs are held", "only held values", "at="],
    ),
    (
        "overflow",
        lambda _: overflow(),
        FifoOverflowError,
        ["pairs", "the queue is full", "at most 1", "t = 10 ns", "size="],
    ),
    (
        "data of another type",
        lambda _: simulate(build(lambda x, y: x, Metres), {"x": scalars([0]), "y": scalars([0])}),
        TypeMismatchError,
        ["x", "another type", "Metres", "Series(time, Metres(...))"],
    ),
    (
        "float times",
        lambda _: Series([0.5], np.zeros(1), name="imu"),
        DataError,
        ["imu", "integer nanoseconds", "float64", "from_seconds"],
    ),
    (
        "match without size",
        lambda _: build(lambda x, y: match(x, y, tolerance="1ms")),
        DeclarationError,
        ["match(x, y)", f"at:       {__name__}:", "needs the size", "None", "size=8"],
    ),
    (
        "host block between lowered blocks",
        lambda _: lower(build(lambda x, y: add(block(host=True)(camera)(first := add(x, x)), first))),
        LoweringError,
        ["camera", "accelerated blocks on both sides", "before it", f"{__name__}:", 'engine="python"'],
    ),
]


def camera(x: Scalar) -> Scalar:
    return x


@pytest.mark.parametrize(("do", "error", "words"), [row[1:] for row in ROWS], ids=[row[0] for row in ROWS])
def test_bad_input_is_refused_in_words(do, error, words, tmp_path):
    with pytest.raises(FlowgraphError) as caught:
        do(tmp_path)
    assert type(caught.value) is error
    text = str(caught.value)
    for word in (*words, "  expected: ", "  got:      ", "  fix:      "):
        assert word in text, text
    assert caught.value.path or isinstance(caught.value, UnknownNameError), "the message does not say where"


def test_a_declaration_that_is_refused_names_its_own_line():
    """Also inside a nested graph, where it is the inner line; a step that cannot be traced names its own."""

    @graph
    def inner(x: Stream[Scalar]):
        return zip(x, x.filter(lambda v: v > 0.0))

    @graph
    def outer(x: Stream[Scalar]):
        return inner(x, name="nested")

    with pytest.raises(ClockError) as caught:
        outer.build()
    code = inner.function.__code__
    assert caught.value.line == f"{__name__}:{code.co_firstlineno + 2}"
    assert f"\n  at:       {caught.value.line}\n" in str(caught.value)
    with pytest.raises(LoweringError) as traced:
        build(lambda x, y: x.map(lambda v: v if v > 0.0 else -v))
    assert traced.value.line is None
    assert f"{__name__}:" in str(traced.value.path)
    with pytest.raises(ClockError) as alone:
        simulate(build(lambda x, y: x, x=periodic(5)), {"x": scalars([0, 6]), "y": scalars([])})
    assert alone.value.line is None  # what is wrong with data is not wrong with a line


# -- the command line --------------------------------------------------------------------------------------


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `flowgraph` in a process of its own."""
    program = "import sys; from flowgraph.cli import main; sys.argv[0] = 'flowgraph'; main()"
    environment = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "MPLBACKEND": "Agg"}
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        capture_output=True,
        text=True,
        timeout=600,
        env=environment,
    )


def with_leica(tmp: Path, imu: str | None) -> str:
    made = folder(tmp, imu)
    (made / "mav0" / "leica0").mkdir()
    (made / "mav0" / "leica0" / "data.csv").write_text("#t,p,p,p\n1000,0,0,0\n6000,0,0,0\n")
    return f"euroc:{made}"


RUN = ("run", "ins_eskf", "--data")
COMMANDS: list[tuple[str, Callable[[Path], tuple[str, ...]], int, list[str]]] = [
    (
        "unknown graph",
        lambda _: ("run", "ins_eksf", "--data", "sim"),
        2,
        ["'ins_eksf'", "did you mean 'ins_eskf'"],
    ),
    ("unknown graph to show", lambda _: ("show", "nothing"), 2, ["'nothing'", "ins_eskf"]),
    ("unknown setting", lambda _: (*RUN, "sim", "--set", "gat=3"), 2, ["'gat'", "did you mean 'gate'"]),
    ("setting without value", lambda _: (*RUN, "sim", "--set", "gate"), 2, ["KEY=VALUE", "'gate'"]),
    (
        "setting that is no number",
        lambda _: (*RUN, "sim", "--set", "gate=wide"),
        2,
        ["gate", "'wide'", "float"],
    ),
    ("unknown engine", lambda _: (*RUN, "sim", "--engine", "pyton"), 2, ["'pyton'", "python"]),
    ("unknown kind of data", lambda _: (*RUN, "eurok:x"), 2, ["'eurok'", "euroc"]),
    ("unknown option", lambda _: (*RUN, "sim", "--fast"), 2, ["--fast"]),
    ("missing argument", lambda _: ("run",), 2, ["GRAPH"]),
    ("missing file", lambda tmp: (*RUN, with_leica(tmp, None)), 1, ["data.csv"]),
    ("missing folder", lambda tmp: (*RUN, f"euroc:{tmp / 'nowhere'}"), 1, ["nowhere"]),
    (
        "wrong column count",
        lambda tmp: (*RUN, with_leica(tmp, IMU + "11000,1,2\n")),
        1,
        ["data.csv", "3", "7"],
    ),
    (
        "infinite sample",
        lambda tmp: (*RUN, with_leica(tmp, IMU.replace("9.81\n6000", "inf\n6000"))),
        1,
        ["data.csv", "2"],
    ),
]


@pytest.mark.parametrize(
    ("arguments", "status", "words"), [c[1:] for c in COMMANDS], ids=[c[0] for c in COMMANDS]
)
def test_the_command_fails_with_a_message(arguments, status, words, tmp_path):
    done = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, arguments(tmp_path))
    assert done.exit_code == status, done.stderr
    assert isinstance(done.exception, SystemExit)
    assert done.stdout == ""
    for word in words:
        assert word in done.stderr


def test_the_status_is_that_of_the_process(tmp_path):
    for arguments, status, word in (
        (("run", "ins_eksf", "--data", "sim"), 2, "did you mean 'ins_eskf'"),
        ((*RUN, with_leica(tmp_path, IMU.replace("9.81\n6000", "inf\n6000"))), 1, "data.csv"),
    ):
        done = command(*arguments)
        assert done.returncode == status, done.stderr
        assert done.stdout == ""
        assert "Traceback" not in done.stderr
        assert word in done.stderr


def test_the_command_succeeds_and_prints_one_object():
    done = CliRunner().invoke(app, (*RUN, "sim", "--set", "duration=2", "--json"))
    assert done.exit_code == 0, done.stderr
    report = json.loads(done.stdout)
    keys = ["graph", "engine", "ticks", "wall_s", "position_rmse_m", "attitude_rmse_deg", "tilt_rmse_deg"]
    assert set(keys) <= set(report)
    assert (report["graph"], report["engine"], report["ticks"]) == ("ins_eskf", "python", 401)


NO_JAX = "import sys; from flowgraph.cli import main; sys.argv = ['flowgraph', *sys.argv[1:]]; main()"


def test_the_command_without_jax():
    done = isolated(NO_JAX, *RUN, "sim", "--engine", "xla", "--set", "duration=1", blocked=("jax", "jaxlib"))
    assert done.returncode == 1
    assert "the XLA engine needs JAX" in done.stderr
    assert "flowgraph-filters[xla]" in done.stderr
    assert "Traceback" not in done.stderr
