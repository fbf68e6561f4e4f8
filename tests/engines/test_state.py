"""The state of a run: what is refused when it is loaded, what `init` may set, and that it is a copy."""

from __future__ import annotations

import copy
import os
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    DataError,
    DeclarationError,
    Run,
    Scalar,
    Stream,
    UnknownNameError,
    block,
    delay,
    every,
    graph,
    latest,
    load_state,
    lower,
    match,
    real,
    save_state,
    simulate,
    window,
)
from flowgraph import zip as zip_
from tests.support import ENGINES, flat_state, same_state, scalars


@block
def mean(state, x: Scalar):
    count, value = state[0] + 1, state[1] + (x - state[1]) / (state[0] + 1)
    return (count, value), value


@mean.init
def _(x):
    return (np.int32(0), 0.0)


@block
def leak(level: Scalar, x: Scalar, *, dt: float) -> Scalar:
    return level * (1.0 - dt) + x


@graph
def mixed(a: Stream[Scalar], b: Stream[real(2)]):  # type: ignore[valid-type]
    """A register of each kind."""
    level = delay(0.0, name="level")
    now = leak(level, a)
    level.feed(now)
    return {
        "now": now,
        "mean": mean(a),
        "held": latest(b, init=np.zeros(2), name="held").at(a),
        "slow": every(2, a),
        "zipped": zip_(every(2, a), every(2, a, phase=1), name="zipped"),
        "matched": match(a, b, tolerance=5, size=4, name="matched"),
        "seen": window(a, at=every(3, a), size=4, name="seen"),
    }


MIXED = mixed.build()
PIPELINE = lower(MIXED)
SETTABLE = ["held", "level", "mean.state"]


def inputs(n: int = 9) -> Any:
    return {"a": scalars(np.arange(n) * 10), "b": (np.arange(n) * 10 + 2, np.ones((n, 2)))}


def later(n: int = 3) -> Any:
    return {"a": scalars(np.arange(n) * 10 + 1000), "b": (np.arange(n) * 10 + 1002, np.ones((n, 2)))}


STATE = simulate(MIXED, inputs()).state


def go_on(how: str, state: Any) -> Any:
    return (
        PIPELINE.run(later(), state=state)
        if how == "pipeline"
        else simulate(MIXED, later(), state=state, engine=how)
    )


def put(*place: Any, to: Any) -> Callable[[Any], Any]:
    def edit(tree: Any) -> Any:
        part = tree
        for key in place[:-1]:
            part = part[key]
        if to is KeyError:
            del part[place[-1]]
        else:
            part[place[-1]] = to
        return tree

    return edit


MALFORMED = [
    (lambda _: 3, "this is no state"),
    (lambda _: [1, 2], "this is no state"),
    (lambda _: {}, "none called 'registers'"),
    (put("seed", to=KeyError), "none called 'seed'"),
    (put("extra", to=1), "'extra', which is not there"),
    (put("registers", to=None), "of another"),
    (put("registers", "level", to=KeyError), "none called 'level'"),
    (put("registers", "levels", to=0.0), "'levels', which is not there"),
    (put("sources", to=[0, 0]), "last times: this state is of another"),
    (put("sources", "a", to=KeyError), "none called 'a'"),
    (put("sources", "a", to=np.nan), "last time of a: a part of this state is malformed"),
    (put("sources", "a", to=1.5), "last time of a: a part of this state is malformed"),
    (put("sources", "a", to=2**63), "last time of a: a part of this state is malformed"),
    (put("seed", to=-1), "seed: a part of this state is malformed"),
    (put("seed", to="x"), "seed: a part of this state is malformed"),
    (put("registers", "held", to=np.zeros(3)), r"state of held: .*\n.*shape \(2,\)\n.*shape \(3,\)"),
    (put("registers", "held", to=[[0.0], [1.0, 2.0]]), "state of held: a part of this state is malformed"),
    (put("registers", "held", to=["a", "b"]), "state of held: a part of this state is malformed"),
    (put("registers", "held", to=None), "state of held: a part of this state is malformed"),
    (put("registers", "held", to={"x": 1.0}), "state of held: a part of this state is malformed"),
    (put("registers", "level", to=True), "state of level: a part of this state is malformed"),
    (put("registers", "mean.state", to=1.0), "state of mean.state: this state is of another"),
    (put("registers", "mean.state", "0", to=KeyError), "none called '0'"),
    (put("registers", "mean.state", "2", to=0.0), "'2', which is not there"),
    (put("registers", "mean.state", "0", to=np.nan), "mean.state, 0: a part of this state is malformed"),
    (put("registers", "mean.state", "0", to=2**40), "mean.state, 0: a part of this state is malformed"),
]


@pytest.mark.parametrize("how", ["python", "reference", "pipeline"])
@pytest.mark.parametrize(("edit", "words"), MALFORMED)
def test_a_malformed_state_is_refused_with_its_part(how, edit, words):
    tree = edit(copy.deepcopy(STATE))
    with pytest.raises(DataError, match=words) as error:
        go_on(how, tree)
    assert None not in (error.value.path, error.value.expected, error.value.got, error.value.fix)
    assert str(error.value.path).startswith("mixed")


@pytest.mark.parametrize("how", [*ENGINES, "pipeline"])
def test_a_nan_that_is_data_resumes(how):
    tree = put("registers", "held", to=np.array([np.nan, 1.0]))(copy.deepcopy(STATE))
    assert np.isfinite(go_on(how, tree)["now"]["value"]).all()


def test_a_state_of_lists_and_numbers_resumes_to_the_same_bits():
    def plain(part: Any) -> Any:
        return (
            {n: plain(p) for n, p in part.items()} if isinstance(part, Mapping) else np.asarray(part).tolist()
        )

    for how in ("python", "pipeline"):
        same_state(go_on(how, STATE).state, go_on(how, plain(STATE)).state)


def test_writing_into_a_state_never_changes_a_run():
    run, other = Run(MIXED, inputs()), Run(MIXED, inputs())
    while run.step():
        other.step()
        for array in flat_state(run.state).values():
            assert array.flags.writeable
            array[...] = 0
    same_state(run.state, other.state)
    same_state(run.result().state, STATE)


def test_a_run_keeps_no_part_of_the_state_that_it_was_given():
    mine = copy.deepcopy(STATE)
    run = Run(MIXED, later(), state=mine)
    for array in flat_state(mine).values():
        array[...] = 1
    same_state(run.to_end().state, go_on("python", STATE).state)
    same_state(STATE, simulate(MIXED, inputs()).state)


def start(how: str, init: Any) -> Any:
    return (
        PIPELINE.run(inputs(), init=init)
        if how == "pipeline"
        else simulate(MIXED, inputs(), init=init, engine=how)
    )


@pytest.mark.parametrize("how", ["python", "reference", "pipeline"])
@pytest.mark.parametrize("path", sorted(set(STATE["registers"]) - set(SETTABLE)))
def test_what_clocks_are_proven_from_cannot_be_set(how, path):
    with pytest.raises(DeclarationError, match="this register cannot be set") as error:
        start(how, {path: STATE["registers"][path]})
    assert error.value.expected == "one of held, level, mean.state"
    assert path in str(error.value.got)


def test_only_joins_and_clocks_are_kept_from_init():
    refused = set(STATE["registers"]) - set(SETTABLE)
    assert {"matched.state", "zipped.state", "seen.state"} < refused
    assert any("every" in path for path in refused)
    assert {r.path for r in PIPELINE.registers if r.role == "stamp"} < refused


@pytest.mark.parametrize("how", ["python", "reference", "pipeline"])
def test_an_unknown_register_lists_those_that_can_be_set(how):
    with pytest.raises(UnknownNameError, match="did you mean 'level'") as error:
        start(how, {"levle": 0.0})
    assert error.value.valid == SETTABLE


def test_registers_and_states_of_blocks_can_be_set():
    values: Any = {"level": 5.0, "held": np.ones(2), "mean.state": (np.int32(1), 7.0)}
    results = [start(how, values) for how in ("python", "reference", "pipeline")]
    for result in results:
        assert result["now"]["value"][0] == 6.0
        assert result["mean"]["value"][0] == 4.0
        same_state(result.state, results[0].state)


@pytest.mark.parametrize("how", ["Run", *ENGINES, "pipeline"])
def test_initial_values_and_a_state_exclude_each_other(how):
    options: Any = {"init": {"level": 0.0}, "state": STATE}
    calls: dict[str, Callable[[], Any]] = {
        "Run": lambda: Run(MIXED, later(), **options),
        "pipeline": lambda: PIPELINE.run(later(), **options),
    }
    with pytest.raises(DeclarationError, match="from initial values or from a state"):
        calls.get(how, lambda: simulate(MIXED, later(), engine=how, **options))()


def test_a_checkpoint_outlives_what_is_killed_while_it_is_written_over(tmp_path):
    file = tmp_path / "state.npz"
    save_state(STATE, file)
    whole = file.read_bytes()
    code = (
        "import os, sys\nimport numpy as np\nfrom flowgraph import load_state, save_state\n"
        "state = load_state(sys.argv[1])\n"
        "np.savez = lambda out, **_: (out.write(b'half'), out.flush(), os.kill(os.getpid(), 9))\n"
        "save_state(state, sys.argv[1])"
    )
    assert subprocess.run([sys.executable, "-c", code, str(file)], check=False).returncode == -signal.SIGKILL
    assert file.read_bytes() == whole
    same_state(load_state(file), STATE)
    save_state(STATE, file)
    assert os.listdir(tmp_path) == ["state.npz"]


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        (5, "this is no state"),
        ({}, "this is no state"),
        ({**STATE, "more": 1}, "this is no state"),
        ({**STATE, "registers": {"x": object()}}, "a part of this state is malformed"),
        ({**STATE, "registers": {"x": "text"}}, "a part of this state is malformed"),
        ({**STATE, "registers": {"x": [[1.0], [1.0, 2.0]]}}, "a part of this state is malformed"),
    ],
)
def test_what_could_not_be_read_again_does_not_take_the_place_of_a_state(tmp_path, tree, said):
    file = tmp_path / "state.npz"
    save_state(STATE, file)
    with pytest.raises(DataError, match=said):
        save_state(tree, file)
    same_state(load_state(file), STATE)


def test_a_pipe_or_a_folder_is_no_state(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", tmp_path, tmp_path / "none"):
        with pytest.raises(DataError, match="this is no saved state"):
            load_state(file)


@pytest.mark.parametrize("damage", ["password", "method", "deflate", "shape", "name", "twice"])
def test_a_state_that_is_damaged_is_our_error(tmp_path, damage):
    file = tmp_path / "state.npz"
    save_state(STATE, file)
    content = bytearray(file.read_bytes())
    first = content.index(b"PK\x01\x02")
    if damage == "password":
        content[6] |= 1
        content[first + 8] |= 1
    elif damage in ("method", "deflate"):
        content[8:10] = content[first + 10 : first + 12] = b"\x63\x00" if damage == "method" else b"\x08\x00"
    elif damage == "shape":
        content = content.replace(b"(", b"9", 1)
    file.write_bytes(content)
    if damage in ("name", "twice"):
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr("seed.npy" if damage == "twice" else "a\nb\nc\nd.npy", b"")
    with pytest.raises(DataError, match="this is no saved state") as error:
        load_state(file)
    assert str(file) in str(error.value)
