"""What a step reads from around it is frozen when it is wired: every engine has the values of that moment."""

from __future__ import annotations

import functools
import itertools
import random
import sys
import threading
import time
from collections import OrderedDict
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    Array,
    DeclarationError,
    Scalar,
    Signal,
    Stream,
    apply,
    block,
    graph,
    real,
    simulate,
)
from flowgraph.language.recording import remembering
from tests.support import all_engines, scalars

STEPS = {
    "a number": ("G{i} = {c}", "a.map(lambda v: v * G{i})", "G{i} = 77.0"),
    "an array": ("G{i} = np.array([{c}])", "a.map(lambda v: v * G{i}[0])", "G{i}[0] = 77.0"),
    "a view": ("B{i} = np.zeros(2) + {c}; G{i} = B{i}[1:]", "a.map(lambda v: v * G{i}[0])", "B{i}[:] = 77.0"),
    "a list": ("G{i} = [{c}]", "a.map(lambda v: v * G{i}[0])", "G{i}[0] = 77.0"),
    "arrays in lists": ("G{i} = [np.array([{c}])]", "a.map(lambda v: v * G{i}[0][0])", "G{i}[0][0] = 77.0"),
    "dicts in dicts": (
        "G{i} = {{'a': {{'b': {c}}}}}",
        "a.map(lambda v: v * G{i}['a']['b'])",
        "G{i}['a']['b'] = 77.0",
    ),
    "a function's global": (
        "F{i} = {c}\ndef f{i}(v): return v * F{i}",
        "a.map(f{i})",
        "F{i} = 77.0",
    ),
    "a called function's global": (
        "F{i} = {c}\ndef f{i}(v): return v * F{i}\ndef g{i}(v): return f{i}(v)",
        "a.map(lambda v: g{i}(v))",
        "F{i} = 77.0",
    ),
    "a function": ("def f{i}(v): return v * {c}", "a.map(lambda v: f{i}(v))", "f{i} = abs"),
    "another module's global": (
        "other.m{i} = {c}",
        "a.map(lambda v: v * other.m{i})",
        "other.m{i} = 77.0",
    ),
    "an attribute of a class": (
        "class C{i}: k = {c}",
        "a.map(lambda v: v * C{i}.k)",
        "C{i}.k = 77.0",
    ),
    "an attribute of an instance": (
        "class C{i}: pass\no{i} = C{i}(); o{i}.k = [{c}]",
        "a.map(lambda v: v * o{i}.k[0])",
        "o{i}.k[0] = 77.0",
    ),
    "a method's global": (
        "F{i} = {c}\nclass C{i}:\n    def at(self, v): return v * F{i}\no{i} = C{i}()",
        "a.map(lambda v: o{i}.at(v))",
        "F{i} = 77.0",
    ),
    "a bound method": (
        "class C{i}:\n    def at(self, v): return v * self.k\no{i} = C{i}(); o{i}.k = {c}",
        "a.map(o{i}.at)",
        "o{i}.k = 77.0",
    ),
    "an object that is called": (
        "class C{i}:\n    k = {c}\n    def __call__(self, v): return v * self.k\no{i} = C{i}()",
        "a.map(o{i})",
        "C{i}.k = 77.0",
    ),
    "a partial": (
        "P{i} = functools.partial(lambda v, *, k: v * k[0], k=[{c}])",
        "a.map(P{i})",
        "P{i}.keywords['k'][0] = 77.0",
    ),
    "a default": ("D{i} = [{c}]", "a.map(lambda v, d=D{i}: v * d[0])", "D{i}[0] = 77.0"),
    "a keyword's default": ("D{i} = {{0: {c}}}", "a.map(lambda v, *, d=D{i}: v * d[0])", "D{i}[0] = 77.0"),
    "a setting": ("D{i} = np.array([{c}])", "apply(times, a, k=D{i})", "D{i}[:] = 77.0"),
    "a dataclass in a setting": (
        "D{i} = Weights([{c}])",
        "apply(lambda v, *, w: v * w.k[0], a, w=D{i})",
        "D{i}.k[0] = 77.0",
    ),
    "an operand": ("D{i} = np.array({c})", "a * D{i}", "D{i}[...] = 77.0"),
    "a fold": ("D{i} = [{c}]", "scan(a, lambda s, v: 0.0 * s + v * D{i}[0], init=0.0)", "D{i}[0] = 77.0"),
}

HEAD = """
import functools
from dataclasses import dataclass
import numpy as np
from flowgraph import Scalar, Stream, apply, graph, scan
import other
@dataclass
class Weights:
    k: list
def times(v, *, k): return v * k[0]
"""

_numbers = itertools.count()


def program(chosen: list[tuple[str, float]], loops: int, early: bool) -> ModuleType:
    """A module with a graph of these steps; what they read is changed by `change()`, or at once."""
    made = ModuleType(f"program_{next(_numbers)}")
    other = ModuleType("other")
    sys.modules |= {"other": other, made.__name__: made}
    parts = [[text.format(i=i, c=c) for text in STEPS[kind]] for i, (kind, c) in enumerate(chosen)]
    changes = [change for _, _, change in parts]
    names = sorted({c.split(" =")[0] for c in changes if c.split(" =")[0].isidentifier()})
    lines = [HEAD, *(before for before, _, _ in parts)]
    lines += ["def change():", f"    global {', '.join(names)}" if names else "    pass"]
    lines += [f"    {change}" for change in changes]
    lines += ["@graph", "def g(a: Stream[Scalar]):", "    out = {}"]
    lines += [f"    out['o{i}'] = {step}" for i, (_, step, _) in enumerate(parts)]
    lines += [f"    for k in range({loops}):", "        out[f'loop{k}'] = a.map(lambda v: v * (k + 1))"]
    lines += ["    change()" if early else "    pass", "    return out"]
    exec(compile("\n".join(lines), made.__name__, "exec"), made.__dict__)
    return made


def outputs(built: Any, engine: str) -> dict[str, list[float]]:
    inputs = {"a": scalars([0, 1])}
    return {k: v.value.tolist() for k, v in simulate(built, inputs, engine=engine).series.items()}


@settings(max_examples=15, deadline=None)
@given(
    chosen=st.lists(
        st.tuples(st.sampled_from(sorted(STEPS)), st.sampled_from([2.0, -3.0, 0.5])), min_size=1, max_size=8
    ),
    loops=st.integers(0, 3),
    early=st.booleans(),
)
def test_whatever_a_step_reads_is_as_it_was_when_it_was_wired(chosen, loops, early):
    """Changed after it is wired, or after the graph is built: the engines have the first values."""
    made = program(chosen, loops, early)
    built = made.g.build()
    if not early:
        made.change()
    wanted = {f"o{i}": [c, 2 * c] for i, (_, c) in enumerate(chosen)}
    wanted |= {f"loop{k}": [k + 1.0, 2 * (k + 1.0)] for k in range(loops)}
    for engine in ("python", "reference", "c"):
        assert outputs(built, engine) == wanted, engine


@pytest.mark.parametrize("kind", sorted(STEPS))
def test_each_kind_of_thing_is_frozen(kind):
    made = program([(kind, 2.0)], 0, False)
    built = made.g.build()
    made.change()
    assert outputs(built, "python") == outputs(built, "reference") == {"o0": [2.0, 4.0]}


def test_steps_that_are_remembered_are_told_apart_by_what_they_read():
    memory: Any = OrderedDict()
    made = program([("a number", 2.0), ("a default", 3.0)], 2, False)
    with remembering(memory):
        first, again = made.g.build(), made.g.build()
        made.change()
        changed = made.g.build()
    for engine in ("python", "reference"):
        assert outputs(first, engine) == outputs(again, engine)
        assert outputs(first, engine)["o0"] == [2.0, 4.0]
        assert outputs(changed, engine)["o0"] == [77.0, 154.0]
        assert outputs(changed, engine)["loop1"] == [2.0, 4.0]


def test_a_step_keeps_its_code():
    """A debugger finds the lines of the user's in a frozen step as in the step itself."""
    gain = [2.0]

    def step(v):
        return v * gain[0]

    @graph
    def g(a: Stream[Scalar]):
        return a.map(step)

    (_, call), *_ = g.build().calls
    assert call.block.step is not step
    assert call.block.step.__code__ == step.__code__
    assert call.block.step.__code__.co_filename == __file__


def test_host_blocks_keep_their_closures():
    seen: list[float] = []

    @graph
    def g(a: Stream[Scalar]):
        return a.tap(seen.append)

    outputs(g.build(), "python")
    assert seen == [1.0, 2.0]


def test_a_step_that_only_python_runs_keeps_its_closure():
    gain = [2.0]

    @block
    def rectified(v: Scalar) -> Scalar:
        return v * gain[0] if v > 0.0 else -v

    @graph
    def g(a: Stream[Scalar]):
        return rectified(a)

    built = g.build()
    gain[0] = 3.0
    assert outputs(built, "python") == {"output": [3.0, 6.0]}


# -- defaults ----------------------------------------------------------------------------------------------


def test_a_positional_parameter_with_a_default_is_a_setting_where_nothing_is_wired_to_it():
    def scaled(v, k=2.0):
        return v * k

    @graph
    def g(a: Stream[Scalar]):
        return {
            "default": a.map(scaled),
            "given": apply(scaled, a, k=3.0),
            "wired": apply(scaled, a, a),
            "named": apply(scaled, a, k=a),
        }

    result = all_engines(g.build(), {"a": scalars([0, 1])})
    assert {k: v.value.tolist() for k, v in result.series.items()} == {
        "default": [2.0, 4.0],
        "given": [3.0, 6.0],
        "wired": [1.0, 4.0],
        "named": [1.0, 4.0],
    }


def test_a_default_before_a_port_is_refused_with_what_to_do():
    @graph
    def g(a: Stream[Scalar]):
        return apply(lambda v, k=2.0, w=None: v * k + w, a, w=a)

    with pytest.raises(DeclarationError, match="'k', which has a default, stands") as error:
        g.build()
    assert "*, k=..." in str(error.value.fix)


# -- steps that are not pure -------------------------------------------------------------------------------

COUNTS = [0]
LEVELS = np.zeros(2)
TOTAL = 0.0


class Counter:
    n = 0


def counted_in_a_list(v):
    COUNTS[0] += 1
    return v + COUNTS[0]


def counted_in_a_class(v):
    Counter.n += 1
    return v + Counter.n


def counted_in_a_global(v):
    global TOTAL
    TOTAL = TOTAL + 1.0
    return v + TOTAL


def collected(v, seen=[]):  # noqa: B006 (a default that is written to is the point)
    seen.append(1.0)
    return v + len(seen)


def written_array(v):
    LEVELS[0] += 1.0
    return v + LEVELS[0]


def written_default(v, *, acc=np.zeros(1)):  # noqa: B008
    acc += 1.0
    return v + acc[0]


def counter():
    n = 0

    def step(v):
        nonlocal n
        n += 1
        return v + n

    return step


def on(step: Any) -> Any:
    @graph
    def g(a: Stream[Scalar]):
        return a.map(step)

    return g


@pytest.mark.parametrize(
    ("step", "below", "what"),
    [
        (counted_in_a_list, 1, "COUNTS"),
        (counted_in_a_class, 1, "Counter"),
        (counted_in_a_global, 2, "globals of counted_in_a_global"),
        (collected, 1, "seen"),
        (written_array, 1, "an array"),
        (written_default, 1, "an array"),
        (counter(), 2, "n"),
    ],
)
def test_a_step_that_writes_what_outlives_it_is_refused_by_its_line(step, below, what):
    with pytest.raises(DeclarationError, match="the step writes what outlives it") as error:
        on(step).build()
    assert error.value.line == f"{__name__}:{step.__code__.co_firstlineno + below}"
    assert what in str(error.value.got)
    assert "@NAME.init" in str(error.value.fix)
    assert COUNTS == [0]
    assert LEVELS.tolist() == [0.0, 0.0]


NUMBERS = np.random.default_rng(0)
ITEMS = (float(i) for i in range(100))


@pytest.mark.parametrize(
    "step",
    [
        lambda v: v + time.perf_counter(),
        lambda v: v + random.random(),
        lambda v: v + np.random.normal(),
        lambda v: v + NUMBERS.normal(),
        lambda v: v + next(ITEMS),
    ],
    ids=["a clock", "random", "numpy.random", "a generator of numbers", "an iterator"],
)
def test_a_step_that_is_another_each_time_is_refused_by_its_line(step):
    with pytest.raises(DeclarationError, match="the step is another each time it is run") as error:
        on(step).build()
    assert error.value.line == f"{__name__}:{step.__code__.co_firstlineno}"
    assert "draw" in str(error.value.fix)


LOCK = threading.Lock()
FILE = sys.stdout


def locked(v):
    with LOCK:
        return 2.0 * v


def filed(v):
    return v + len(FILE.name)


def locked_inside(v, *, tools=(1, threading.Event())):  # noqa: B008
    return v * tools[0]


@pytest.mark.parametrize(("step", "name"), [(locked, "LOCK"), (filed, "FILE"), (locked_inside, "tools")])
def test_what_cannot_be_copied_is_refused_by_name(step, name):
    with pytest.raises(DeclarationError, match=rf"'{name}.*', which the step reads, can neither") as error:
        on(step).build()
    assert error.value.line == f"{__name__}:{step.__code__.co_firstlineno}"


# -- steps that are wrong ----------------------------------------------------------------------------------


class Motion(Signal):
    speed: Array = real(3)


def unpacked(s):
    x, y = s.speed
    return x + y


@functools.lru_cache
def two() -> float:
    return 2.0


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (lambda s: s.spede, ["spede", "the step is wrong"]),
        (lambda s: s.speed @ np.eye(2), ["matmul", "(3,)"]),
        (lambda s: s.speed[3], ["index 3"]),
        (lambda s: s.replace(spede=s.speed).speed, ["spede"]),
        (lambda s: s.speed * missing, ["missing"]),  # type: ignore[name-defined]  # noqa: F821
        (lambda s, *, xp: xp.sinn(s.speed), ["xp.sinn"]),
        (unpacked, ["too many values to unpack"]),
        (lambda s: two(s), ["two"]),
    ],
)
def test_a_step_that_is_wrong_is_refused_when_wired(step, words):
    """Also where its output is annotated, so that it could be left to Python: it would fail there too."""

    @graph
    def g(a: Stream[Motion]):
        return a.map(step, out=real(3))

    with pytest.raises(Exception, match="at the ports|shapes that fit|operations|abs, acos|types") as error:
        g.build()
    text = str(error.value)
    assert f"{__name__}:{step.__code__.co_firstlineno + (step is unpacked)}" in text
    for word in words:
        assert word in text
