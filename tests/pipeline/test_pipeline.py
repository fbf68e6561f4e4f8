"""The pipeline description: its JSON form, what is refused when it is read, and that it runs on its own."""

from __future__ import annotations

import contextlib
import copy
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    Array,
    ClockError,
    DataError,
    DeclarationError,
    Flight,
    FlowgraphError,
    OutputError,
    Pipeline,
    PipelineError,
    Scalar,
    Series,
    Signal,
    Stream,
    TypeMismatchError,
    UnknownNameError,
    aperiodic,
    block,
    delay,
    every,
    graph,
    latest,
    lower,
    match,
    periodic,
    real,
    simulate,
)
from flowgraph.pipeline.pipeline import FORMAT, VERSION, schema
from flowgraph.recorder.ops import OPS, Spec
from tests.support import flat_state, isolated, pairs, same, scalars


class Fix(Signal):
    place: Array = real(2, unit="m", frame="world")
    weight: Array = real()


@block
def fuse(belief, fix, *, dt, xp):
    gain = xp.asarray([[0.5, 0.0], [0.25, 0.5]]) @ fix.place
    return xp.where(xp.isfinite(belief), belief + gain * fix.weight + dt, 0.0)


@graph
def tracker(fix: Stream[Fix], beat: Stream[Scalar]):
    """Some of everything."""
    belief = delay(np.array([np.inf, 1.0]), name="belief")
    now = fuse(belief, fix)
    belief.feed(now)
    return {
        "belief": now,
        "slow": every(2, now),
        "pairs": match(fix, beat, tolerance=4, size=3, name="match"),
        "held": latest(now, init=np.zeros(2)).at(beat),
    }


def flight(n: int = 9) -> dict[str, Series]:
    random = np.random.default_rng(3)
    return {
        "fix": Series(np.arange(n) * 10, Fix(random.normal(size=(n, 2)), random.normal(size=n)), name="fix"),
        "beat": scalars(np.arange(n // 2) * 20 + 3, random.normal(size=n // 2)),
    }


PIPELINE = lower(tracker.build())
TEXT = json.dumps(PIPELINE.to_json())


def fresh() -> Any:
    return json.loads(TEXT)


def test_json_round_trip_is_the_identity():
    assert json.dumps(Pipeline.from_json(fresh()).to_json()) == TEXT


def test_json_keeps_to_its_schema_and_the_schema_to_its_own():
    jsonschema.Draft202012Validator.check_schema(schema())
    jsonschema.validate(fresh(), schema())
    assert (fresh()["format"], fresh()["version"]) == (FORMAT, VERSION)


def test_json_holds_no_numbers_that_json_lacks():
    json.dumps(PIPELINE.to_json(), allow_nan=False)
    assert "inf" in str(fresh()["registers"][0]["cells"][0]["reset"])


def test_a_pipeline_that_was_read_plays_to_the_same_bits():
    again = Pipeline.from_json(fresh())
    for data in (flight(), flight(0), flight(1)):
        a, b, c = PIPELINE.run(data), again.run(data), simulate(tracker.build(), data, engine="reference")
        for other in (b, c):
            left, right = flat_state(a.state), flat_state(other.state)
            assert list(left) == list(right)
            for name, array in left.items():
                np.testing.assert_array_equal(array, right[name], err_msg=name)
            assert dict(a.stats) == dict(other.stats)
            for name, series in a.series.items():
                np.testing.assert_array_equal(series.time, other[name].time)
                for x, y in zip(series.leaves.values(), other[name].leaves.values(), strict=True):
                    np.testing.assert_array_equal(x, y)


def change(*place: Any, to: Any) -> Callable[[Any], None]:
    def edit(data: Any) -> None:
        for key in place[:-1]:
            data = data[key]
        if to is KeyError:
            del data[place[-1]]
        else:
            data[place[-1]] = to

    return edit


def stage_with(data: Any, op: str) -> Any:
    return next(i for s in data["stages"] for i in s["instructions"] if i["op"] == op)


def instruction(op: str, /, **fields: Any) -> Callable[[Any], None]:
    return lambda data: stage_with(data, op).update(fields)


def timing(**parts: Any) -> Any:
    return {"period": None, "phase": None, "jitter": None, "max_rate": None, **parts}


def use(data: Any, op: str, dtype: str) -> None:
    """Give an instruction a first argument of another kind and the same shape, as one of its own values."""
    i = stage_with(data, op)
    shape = next(v["shape"] for v in values(data) if v["value"] == i["args"][0])
    size = int(np.prod(shape))
    number = [0.0] * size if dtype == "real" else [0] * size
    data["constants"].append({"value": 10**6, "shape": shape, "dtype": dtype, "data": number})
    i["args"][0] = 10**6


def values(data: Any) -> list[Any]:
    found = [*data["constants"], *(leaf for p in data["inputs"] for leaf in p["leaves"])]
    found += [{**c, "value": c["read"]} for r in data["registers"] for c in r["cells"]]
    found += [{"value": p["present"], "shape": []} for p in data["inputs"]]
    return found + [i for s in data["stages"] for i in s["instructions"]]


def swap_condition(data: Any) -> None:
    use(data, "where", "int32")


TAMPERED = [
    ("version", change("version", to=VERSION + 1), ["known version", f"version {VERSION}"]),
    ("format", change("format", to="other"), ["known version"]),
    ("missing part", change("stages", to=KeyError), ["schema", "stages"]),
    ("extra part", change("code", to="import os"), ["schema", "code"]),
    ("negative value", change("time", to=-1), ["schema", "at time"]),
    (
        "unknown dtype",
        change("inputs", 0, "leaves", 0, "dtype", to="float16"),
        ["schema", "inputs/0/leaves/0/dtype"],
    ),
    ("unknown role", change("registers", 0, "role", to="ram"), ["schema", "registers/0/role"]),
    ("unknown operation", instruction("matmul", op="system"), ["pipeline"]),
    ("value of the future", instruction("matmul", args=[10**6, 10**6]), ["malformed", "stage fuse"]),
    ("wrong shape", instruction("matmul", shape=[3]), ["does not have the shape it claims", "stage fuse"]),
    ("wrong dtype", instruction("matmul", dtype="int32"), ["does not have the shape it claims"]),
    ("too few arguments", instruction("matmul", args=[0]), ["stage fuse"]),
    ("unknown attribute", instruction("matmul", attrs={"axis": 1}), ["stage fuse"]),
    ("output of nowhere", change("outputs", 0, "leaves", 0, "value", to=10**6), ["never assigned"]),
    ("write of nowhere", change("registers", 0, "cells", 0, "write", to=10**6), ["never assigned"]),
    ("constant of another size", change("constants", 0, "shape", to=[77]), ["pipeline"]),
    ("no object at all", lambda data: data.clear(), ["known version"]),
    ("input without timing", change("inputs", 0, "timing", to=None), ["schema", "inputs/0/timing"]),
    (
        "output with timing",
        change("outputs", 0, "timing", to=timing(period=3, jitter=0)),
        ["outputs/0/timing"],
    ),
    ("period of nothing", change("inputs", 0, "timing", "period", to=0), ["inputs/0/timing/period"]),
    (
        "phase alone",
        change("inputs", 0, "timing", to=timing(phase=3)),
        ["input fix", "timing", "below the period"],
    ),
    ("late phase", change("inputs", 0, "timing", to=timing(period=3, phase=3, jitter=0)), ["input fix"]),
    ("periodic, no jitter", change("inputs", 0, "timing", to=timing(period=3)), ["input fix", "a jitter"]),
    ("tiny rate", change("inputs", 0, "timing", to=timing(max_rate=1e-320)), ["input fix", "finite rate"]),
    (
        "more arguments",
        lambda d: stage_with(d, "isfinite")["args"].append(0),
        ["too few or too many", "isfinite of 1"],
    ),
    ("fewer arguments", lambda d: stage_with(d, "add")["args"].pop(), ["too few or too many", "add of 2"]),
    (
        "nothing to stack",
        instruction("isfinite", op="concat", args=[], attrs={"axis": 0}),
        ["too few or too many", "concat of one or more"],
    ),
    ("attribute that only runs read", instruction("add", attrs={"axis": 9}), ["cannot be run", "stage"]),
    ("condition that is none", swap_condition, ["arguments are of another kind", "where of a bool"]),
    (
        "real as truth",
        lambda d: use(d, "logical_and", "real"),
        ["arguments are of another kind", "kind: bool"],
    ),
    ("mixed numbers", lambda d: use(d, "matmul", "int32"), ["arguments are of another kind", "kind: same"]),
    ("read of nowhere", change("stages", 0, "reads", to=["memory"]), ["names a register", "belief"]),
    (
        "write to nowhere",
        change("stages", 0, "writes", to=["memory"]),
        ["names a register", "memory"],
    ),
    ("inputs of one name", change("inputs", 1, "name", to="fix"), ["used twice", "inputs", "fix"]),
    ("outputs of one name", change("outputs", 1, "name", to="belief"), ["used twice", "outputs"]),
    ("registers of one name", change("registers", 1, "path", to="belief"), ["used twice", "registers"]),
    ("leaves of one name", change("inputs", 0, "leaves", 1, "name", to="place"), ["used twice", "input fix"]),
    ("leaf inside a leaf", change("inputs", 0, "leaves", 1, "name", to="place.x"), ["make no value"]),
    (
        "constants of one number",
        lambda d: d["constants"].append(d["constants"][0]),
        ["used twice", "constants"],
    ),
    (
        "number that is a text",
        change("registers", 0, "cells", 0, "reset", to=["x", 1.0]),
        ["cell value", "real of"],
    ),
    ("fault in a real", change("faults", 0, "cell", to="a.items.1.place"), ["kept nowhere", "one int64"]),
    ("totals", change("totals", "operations", to=1), ["the totals are not those", "at totals"]),
    ("latency", change("latency", "fix", to=10**6), ["the latency are not those", "at latency"]),
]


@pytest.mark.parametrize(("edit", "words"), [row[1:] for row in TAMPERED], ids=[row[0] for row in TAMPERED])
def test_tampered_descriptions_are_refused_with_their_place(edit, words):
    data = fresh()
    edit(data)
    with pytest.raises(PipelineError) as error:
        Pipeline.from_json(data)
    for word in (*words, "expected:", "fix:"):
        assert word in str(error.value)


def test_each_operation_takes_as_many_arguments_as_its_rule():
    counts = {name: op.count for name, op in OPS.items()}
    assert [n for n, k in counts.items() if k is None] == ["concat", "stack"]
    assert {n for n, k in counts.items() if k == 3} == {"where"}
    one, two = Spec((), "real"), Spec((), "real")
    for name in ("sqrt", "abs", "floor", "isnan", "reshape", "astype", "sum"):
        assert counts[name] == 1, name
    for name in ("add", "hypot", "matmul", "searchsorted", "take", "logical_or", "bitwise_left_shift"):
        assert counts[name] == 2, name
    assert OPS["add"].rule(one, two) == one


def test_the_timing_of_inputs_is_in_the_description():
    declared = periodic("10ms", phase="1ms", jitter="20us")
    data = lower(tracker.build(fix=declared, beat=aperiodic(max_rate=50.0))).to_json()
    assert [p["timing"] for p in data["inputs"]] == [
        timing(period=10_000_000, phase=1_000_000, jitter=20_000),
        timing(max_rate=50.0),
    ]
    assert all(p["timing"] is None for p in data["outputs"])
    again = Pipeline.from_json(json.loads(json.dumps(data)))
    assert again.inputs[0].timing == declared
    assert again.to_json() == data


def test_the_state_of_a_join_has_a_role_of_its_own():
    roles = {r.path: r.role for r in PIPELINE.registers}
    assert {p for p, role in roles.items() if role == "join"} == {"match.state", "every.state"}


def nodes(data: Any) -> list[tuple[Any, Any]]:
    keys = list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else []
    return [(data, k) for k in keys] + [n for k in keys for n in nodes(data[k])]


JUNK = st.sampled_from(
    [None, -1, 0, 1, 3, 10**9, 2**70, 1.5, "x", "nan", True, [], [1], [[0]], {}, {"axis": 9}]
)


@pytest.mark.slow
@settings(deadline=None, max_examples=300)
@given(st.data())
def test_any_change_of_a_description_is_refused_in_order_or_harmless(data):
    """No change of a file makes reading or playing it fail with anything but an error of this package."""
    description = fresh()
    places = nodes(description)
    holder, key = places[data.draw(st.integers(0, len(places) - 1))]
    holder[key] = data.draw(JUNK)
    with contextlib.suppress(FlowgraphError):
        changed = Pipeline.from_json(description)
        changed.run(flight())
        changed.listing()


@pytest.mark.parametrize("data", [None, [], 3, "text", {"format": FORMAT}])
def test_what_is_no_description_is_refused(data):
    with pytest.raises(PipelineError, match="not a pipeline of a known version"):
        Pipeline.from_json(data)


def test_save_and_load(tmp_path: Path):
    folder = PIPELINE.save(tmp_path / "made" / "here")
    assert json.dumps(Pipeline.load(folder).to_json()) == TEXT
    assert json.dumps(Pipeline.load(folder / "pipeline.json").to_json()) == TEXT
    PIPELINE.save(folder)  # the same again is fine


def test_save_does_not_replace_another_pipeline(tmp_path: Path):
    @graph
    def other(x: Stream[Scalar]):
        return x.map(lambda v: v)

    PIPELINE.save(tmp_path)
    with pytest.raises(PipelineError, match=r"pipeline\.json: another pipeline is already here"):
        lower(other.build()).save(tmp_path)
    assert Pipeline.load(tmp_path).name == "tracker"


@pytest.mark.parametrize("other", [b"my notes", b"\xff\xfe", b""])
def test_save_does_not_replace_another_listing_and_does_nothing_by_half(tmp_path: Path, other):
    (tmp_path / "pipeline.txt").write_bytes(other)
    with pytest.raises(OutputError, match=r"pipeline\.txt: another file is already here"):
        PIPELINE.save(tmp_path)
    assert [f.name for f in tmp_path.iterdir()] == ["pipeline.txt"]
    assert (tmp_path / "pipeline.txt").read_bytes() == other


def test_load_refuses_a_pipe_at_once(tmp_path: Path):
    os.mkfifo(tmp_path / "pipeline.json")
    with pytest.raises(PipelineError, match="no regular file"):
        Pipeline.load(tmp_path)


@pytest.mark.parametrize("shape", [[2**32], [2**16, 2**16], [10**30]])
def test_load_refuses_values_that_no_memory_holds(tmp_path: Path, shape):
    found = json.loads(TEXT)
    found["inputs"][0]["leaves"][0]["shape"] = shape
    (tmp_path / "pipeline.json").write_text(json.dumps(found))
    with pytest.raises(PipelineError, match=r"a value is too large|these fields make no value|axes"):
        Pipeline.load(tmp_path)


@pytest.mark.parametrize("content", [None, "", "{", "[]", '{"format": "flowgraph-pipeline", "version": 99}'])
def test_load_refuses_what_is_no_pipeline(tmp_path: Path, content):
    if content is not None:
        (tmp_path / "pipeline.json").write_text(content)
    with pytest.raises(PipelineError, match=r"pipeline|" + tmp_path.name):
        Pipeline.load(tmp_path)


def test_a_binary_file_is_no_pipeline(tmp_path: Path):
    (tmp_path / "pipeline.json").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(PipelineError, match="no pipeline can be read here"):
        Pipeline.load(tmp_path)


def test_the_listing_names_everything():
    text = PIPELINE.listing()
    for word in (
        "pipeline tracker",
        "input fix: Fix",
        "output held",
        "register belief (delay)",
        "stage fuse",
        "matmul(",
    ):
        assert word in text
    assert text.count(" = ") >= len(PIPELINE.instructions)
    assert f"{__name__}:" in text


def test_a_run_resumes_from_its_state():
    data = flight()
    head = PIPELINE.run({n: s[s.time < 45] for n, s in data.items()})
    tail = PIPELINE.run({n: s[s.time >= 45] for n, s in data.items()}, state=head.state)
    whole = flat_state(PIPELINE.run(data).state)
    for name, array in flat_state(tail.state).items():
        np.testing.assert_array_equal(array, whole[name])


@pytest.mark.parametrize(
    ("inputs", "options", "error", "words"),
    [
        ({}, {}, DataError, "input 'fix' has no data"),
        ({**flight(), "z": scalars([0])}, {}, UnknownNameError, "no input is called 'z'"),
        ({**flight(), "fix": scalars([0])}, {}, DataError, "input 'fix' has other fields"),
        (flight(), {"engine": "python"}, UnknownNameError, "no engine of a pipeline"),
        (flight(), {"dtype": "float16"}, UnknownNameError, "no dtype"),
        (flight(), {"init": {"belif": 0.0}}, UnknownNameError, "did you mean 'belief'"),
        ({**flight(), "beat": (np.array([0, 0]), np.zeros(2))}, {}, DataError, "two events at one time"),
        ({**flight(), "beat": (np.array([0]), np.array([np.nan]))}, {}, DataError, "beat, row 0.*not finite"),
        (flight(), {"state": {"registers": {}, "sources": {}, "seed": 0}}, DataError, "of another pipeline"),
        ({**flight(), "beat": (np.array([0.5]), np.zeros(1))}, {}, DataError, "integer nanoseconds"),
        ([flight()], {}, DataError, "these inputs have no names"),
        ({**flight(), "beat": 3}, {}, DataError, "holds no events"),
        ({**flight(), "beat": "text"}, {}, DataError, "an event is not a pair"),
        ({**flight(), "beat": [(0, {"x": 1.0})]}, {}, DataError, "input 'beat' has other fields"),
        ({**flight(), "beat": [(0, np.zeros(2))]}, {}, TypeMismatchError, "the shape"),
        ({**flight(), "beat": (np.array([0]), np.array([True]))}, {}, TypeMismatchError, "the dtype"),
        ({**flight(), "beat": (np.array([0]), np.zeros((1, 2)))}, {}, TypeMismatchError, "the shape"),
        (flight(), {"state": {}}, DataError, "tracker: state: this is no state"),
        (flight(), {"state": None, "init": {"match.state": 0}}, DeclarationError, "cannot be set"),
        (flight(), {"init": {"belief": {"mean": 0.0}}}, DataError, "the value of 'belief' has other fields"),
        (flight(), {"init": {}, "state": {}}, DeclarationError, "from initial values or from a state"),
    ],
)
def test_runs_of_a_pipeline_refuse(inputs, options, error, words):
    with pytest.raises(error, match=words):
        PIPELINE.run(inputs, **options)


TIMED = tracker.build(fix=periodic(10, phase=0), beat=aperiodic(max_rate=1e8))
TIMED_PIPELINE = Pipeline.from_json(json.loads(json.dumps(lower(TIMED).to_json())))


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ({"fix": [0, 10, 21]}, "declared period"),
        ({"fix": [3, 13]}, "declared phase"),
        ({"beat": [0, 5]}, "highest rate"),
        ({"fix": [10, 10]}, "two events at one time"),
        ({"fix": [10, 0]}, "time goes backwards"),
    ],
)
def test_stamps_are_checked_as_in_simulate(times, words):
    data = flight()
    for name, stamps in times.items():
        data[name] = Series(stamps, data[name][: len(stamps)].values, name=name)
    errors = []
    for run in (TIMED_PIPELINE.run, lambda inputs: simulate(TIMED, inputs)):
        with pytest.raises((ClockError, DataError), match=words) as error:
            run(data)
        errors.append(str(error.value))
    assert errors[0] == errors[1]


def test_stamps_after_a_state_are_checked_from_its_last_times():
    data = flight()
    state = TIMED_PIPELINE.run({n: s[s.time < 45] for n, s in data.items()}).state
    late = {n: s[s.time >= 45] for n, s in data.items()}
    assert TIMED_PIPELINE.run(late, state=state).ticks > 0
    for wrong, words in ((late["fix"][1:], "declared period"), (data["fix"], "after 43 ns|after 40 ns")):
        with pytest.raises((ClockError, DataError), match=words):
            TIMED_PIPELINE.run({**late, "fix": wrong}, state=state)


def test_inputs_come_in_all_the_forms_that_simulate_takes():
    data = flight()
    fix, beat = data["fix"], data["beat"]
    expected = PIPELINE.run(data)
    events = list(zip(fix.time.tolist(), fix, strict=True))
    for inputs in (
        Flight("one", {**data, "gps": beat}),
        {"fix": iter(events), "beat": iter(pairs(beat))},
        {"fix": [(t, {"weight": v.weight, "place": v.place}) for t, v in events], "beat": pairs(beat)},
        {"fix": (fix.time, fix.values), "beat": (beat.time, beat.values)},
        {"fix": (fix.time, {"weight": fix.weight, "place": fix.place}), "beat": beat},
    ):
        same(expected, PIPELINE.run(inputs))


RUNNER = """
import sys
import numpy as np
from flowgraph import Pipeline, Series
from flowgraph.engines.state import save_state
with np.load(sys.argv[2]) as found:
    data = {k: found[k] for k in found.files}
inputs = {
    "fix": (data["fix_time"], {"place": data["place"], "weight": data["weight"]}),
    "beat": (data["beat_time"], data["beat"]),
}
result = Pipeline.load(sys.argv[1]).run(inputs)
save_state(result.state, sys.argv[3])
np.savez(sys.argv[4], **{f"{n}.{k}": a for n, s in result.series.items() for k, a in s.leaves.items()})
for name in ("flowgraph.blocks", "flowgraph.graphs", "jax"):
    assert name not in sys.modules, name
    try:
        __import__(name)
    except ImportError:
        continue
    raise AssertionError(f"{name} can be imported: this test tests nothing")
"""


def test_a_saved_pipeline_runs_where_blocks_graphs_and_jax_cannot_be_imported(tmp_path: Path):
    data = flight()
    PIPELINE.save(tmp_path / "pipeline")
    fix = data["fix"]
    np.savez(
        tmp_path / "data.npz",
        fix_time=fix.time,
        place=fix.place,
        weight=fix.weight,
        beat_time=data["beat"].time,
        beat=data["beat"].value,
    )
    files = [tmp_path / n for n in ("pipeline", "data.npz", "state.npz", "out.npz")]
    done = isolated(RUNNER, *map(str, files), blocked=("flowgraph.blocks", "flowgraph.graphs", "jax"))
    assert done.returncode == 0, done.stderr
    from flowgraph import load_state

    expected = PIPELINE.run(data)
    found = flat_state(load_state(tmp_path / "state.npz"))
    for name, array in flat_state(expected.state).items():
        np.testing.assert_array_equal(array, found[name], err_msg=name)
    with np.load(tmp_path / "out.npz") as out:
        assert len(out.files) == sum(len(s.leaves) for s in expected.series.values())
        for name, series in expected.series.items():
            for leaf, array in series.leaves.items():
                np.testing.assert_array_equal(array, out[f"{name}.{leaf}"])


def test_the_description_needs_no_copy_to_stay_as_it_is():
    before = copy.deepcopy(fresh())
    Pipeline.from_json(before).run(flight())
    assert json.dumps(before) == TEXT
