"""Declaring graphs: names and paths, settings, optional sources, and what a build refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    CycleError,
    DeclarationError,
    Flight,
    Run,
    Scalar,
    Signal,
    Stream,
    TypeMismatchError,
    UnknownNameError,
    block,
    collect,
    delay,
    every,
    graph,
    latest,
    lower,
    merge,
    periodic,
    real,
    simulate,
    simulate_many,
    sink,
)
from tests.support import pairs, scalars


class Cloud(Signal):
    points: Array = real("N", 3, unit="m")


@block
def add(a, b):
    return a + b


@block
def gain(x, *, k):
    return k * x


@block
def total(state, x):
    return state + x, state + x


@total.init
def _(x: Any) -> Any:
    return 0.0


def test_build_runs_the_function_and_freezes_it():
    @graph
    def g(x: Stream[Scalar]):
        """What it does."""
        return x.map(lambda v: 2.0 * v)

    built = g.build()
    assert (built.name, built.doc, list(built.sources)) == ("g", "What it does.", ["x"])
    assert [c.name for c in built.collected] == ["output"]
    with pytest.raises(AttributeError):
        built.name = "other"  # type: ignore[misc]


def test_outputs_as_dict_tuple_collect_and_none():
    @graph
    def g(x: Stream[Scalar]):
        collect(x, "seen")
        return {"double": x + x}

    @graph
    def h(x: Stream[Scalar]):
        return x, x + x

    @graph
    def nothing(x: Stream[Scalar]):
        sink(x, print)

    assert [c.name for c in g.build().collected] == ["seen", "double"]
    assert [c.name for c in h.build().collected] == ["output_1", "output_2"]
    assert nothing.build().collected == ()


def test_nested_graphs_keep_their_names_in_paths():
    @graph
    def inner(x: Stream[Scalar], *, k: float):
        memory = delay(0.0, name="memory")
        y = add(gain(x, k=k, name="scaled"), memory, name="sum")
        memory.feed(y)
        collect(y, "trace")
        return y

    @graph
    def outer(x: Stream[Scalar]):
        return add(inner(x, k=2.0, name="first"), inner(x, k=3.0, name="second"))

    built = outer.build()
    assert {"first/scaled", "first/sum", "second/sum", "add"} <= {n.path for _, n in built.calls}
    assert {"first/memory", "second/memory"} == {n.path for _, n in built.registers}
    assert built.scopes == ("first", "second")
    assert [c.name for c in built.collected] == ["first/trace", "second/trace", "output"]


def test_nesting_does_not_change_results():
    @graph
    def inner(x: Stream[Scalar]):
        slow = every(2, total(x))
        return add(x, latest(slow, init=0.0))

    @graph
    def middle(x: Stream[Scalar]):
        return inner(x)

    @graph
    def outer(x: Stream[Scalar]):
        return middle(x)

    data = {"x": scalars(range(7))}
    assert pairs(simulate(inner.build(), data).output) == pairs(simulate(outer.build(), data).output)


def test_calls_without_a_name_are_numbered():
    @graph
    def g(x: Stream[Scalar]):
        return gain(gain(x, k=1.0), k=2.0)

    assert [n.path for _, n in g.build().calls] == ["gain", "gain_2"]


def test_a_name_given_twice_is_refused():
    @graph
    def g(x: Stream[Scalar]):
        return gain(gain(x, k=1.0, name="same"), k=2.0, name="same")

    with pytest.raises(DeclarationError, match=r"same: the name 'same' is taken") as error:
        g.build()
    assert "name=" in str(error.value.fix)


def test_outputs_of_one_name_are_refused():
    @graph
    def g(x: Stream[Scalar]):
        collect(x, "output")
        return x

    with pytest.raises(DeclarationError, match=r"g: the name 'output' is taken"):
        g.build()


def test_settings_defaults_missing_and_unknown():
    @graph
    def g(x: Stream[Scalar], *, k: float, offset: float = 1.0):
        return gain(x, k=k).map(lambda v: v + offset)

    data = {"x": scalars([0])}
    assert pairs(simulate(g.build(k=2.0), data).output) == [(0, 3.0)]
    assert pairs(simulate(g.build(k=2.0, offset=5.0), data).output) == [(0, 7.0)]
    with pytest.raises(DeclarationError, match=r"g: setting 'k' is missing"):
        g.build()
    with pytest.raises(UnknownNameError, match="no source or setting is called 'ofset'") as error:
        g.build(k=1.0, ofset=2.0)
    assert "did you mean 'offset'" in str(error.value)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda f, x: f(x), DeclarationError, "g/inner: this graph is called wrongly: missing a required"),
        (lambda f, x: f(x, kk=1.0), UnknownNameError, "no source or setting is called 'kk'"),
        (lambda f, x: f(x, x, k=1.0), DeclarationError, "called wrongly: too many positional"),
        (lambda f, x: f(3.0, k=1.0), DeclarationError, "source 'x' needs a stream"),
        (lambda f, x: f(None, k=1.0), DeclarationError, "source 'x' needs a stream"),
    ],
)
def test_a_nested_graph_called_wrongly(call, error, words):
    @graph
    def inner(x: Stream[Scalar], *, k: float):
        return gain(x, k=k)

    @graph
    def g(x: Stream[Scalar]):
        return call(inner, x)

    with pytest.raises(error, match=words):
        g.build()


def test_an_optional_source_exists_only_if_it_is_named():
    @graph
    def g(x: Stream[Scalar], extra: Stream[Scalar] | None = None):
        return x if extra is None else merge(x, extra, tie="right")

    assert list(g.build().sources) == ["x"]
    assert list(g.build(extra=True).sources) == ["x", "extra"]
    assert list(g.build(extra=periodic("5ms")).sources) == ["x", "extra"]


def test_symbolic_sizes_are_given_to_build():
    @graph
    def g(cloud: Stream[Cloud]):
        return cloud.map(lambda c: c.points[0, :])

    with pytest.raises(DeclarationError, match=r"size 'N' is not bound") as error:
        g.build()
    assert "sizes={'N': ...}" in str(error.value.fix)
    built = g.build(sizes={"N": 4})
    assert built.sources["cloud"].type.fields[0][1] == real(4, 3, unit="m")  # type: ignore[union-attr]


def test_a_source_clock_that_is_no_clock():
    @graph
    def g(x: Stream[Scalar]):
        return x

    with pytest.raises(DeclarationError, match="the clock of source 'x' is not understood") as error:
        g.build(x="5ms")
    assert 'periodic("5ms")' in str(error.value)


def test_parameters_that_are_neither_source_nor_setting():
    @graph
    def g(x):
        return x

    with pytest.raises(DeclarationError, match="parameter 'x' is neither a stream nor a setting"):
        g.build()


def test_a_source_without_a_signal_type():
    @graph
    def g(x: Stream[Any]):
        return x

    with pytest.raises(DeclarationError, match="source 'x' has no signal type"):
        g.build()


def test_an_annotation_that_cannot_be_resolved():
    @graph
    def g(x: Stream[Missing]):  # type: ignore[name-defined]  # noqa: F821
        return x

    with pytest.raises(DeclarationError, match="an annotation cannot be resolved.*Missing"):
        g.build()


def test_unfed_delay_and_latest():
    @graph
    def g(x: Stream[Scalar]):
        return add(x, delay(0.0, name="belief"))

    @graph
    def h(x: Stream[Scalar]):
        return add(x, latest(init=0.0, name="held"))

    with pytest.raises(DeclarationError, match=r"belief: this delay is never fed") as error:
        g.build()
    assert ".feed(" in str(error.value.fix)
    with pytest.raises(DeclarationError, match=r"held: this latest is never fed"):
        h.build()


def test_a_register_fed_twice_names_both():
    @graph
    def g(x: Stream[Scalar]):
        memory = delay(0.0, name="memory")
        memory.feed(x)
        memory.feed(gain(x, k=2.0))
        return x

    with pytest.raises(DeclarationError, match=r"memory: this register is fed twice") as error:
        g.build()
    assert error.value.got == "x and gain"


def test_feeding_what_is_no_stream_and_what_does_not_fit():
    @graph
    def g(x: Stream[Scalar]):
        memory = delay(0.0)
        memory.feed(memory)  # type: ignore[arg-type]
        return x

    @graph
    def h(x: Stream[Scalar]):
        memory = delay(np.zeros(3), name="memory")
        memory.feed(x)
        return x

    with pytest.raises(DeclarationError, match="only a stream can be fed"):
        g.build()
    with pytest.raises(TypeMismatchError, match=r"memory: the shape of x does not fit memory"):
        h.build()


def test_an_unconnected_port_shows_the_signature():
    @graph
    def g(x: Stream[Scalar]):
        return add(x)

    with pytest.raises(DeclarationError, match=r"add: port 'b' is not connected") as error:
        g.build()
    assert error.value.expected == "add(a, b)"
    assert "b=stream" in str(error.value.fix)


def test_an_unused_source_is_refused():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return x

    with pytest.raises(DeclarationError, match=r"g.y: this source is connected to nothing"):
        g.build()


def test_a_source_used_only_as_a_clock_is_used():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return latest(x, init=0.0).at(y)

    assert pairs(simulate(g.build(), {"x": scalars([0, 10]), "y": scalars([5, 10])}).output) == [
        (5, 1.0),
        (10, 2.0),
    ]


def test_a_cycle_without_a_delay_prints_the_whole_chain():
    @graph
    def g(x: Stream[Scalar]):
        held = latest(init=0.0, name="held")
        y = add(x, held, name="sum")
        held.feed(gain(y, k=0.5, name="half"))
        return y

    with pytest.raises(CycleError, match="a cycle passes through no delay") as error:
        g.build()
    chain = str(error.value.got).split(" -> ")
    assert {"sum.b", "half.x", "held"} <= {*chain, "sum.b"}
    assert chain[0].split(".")[0] == chain[-1].split(".")[0]
    assert len(chain) == 4
    assert "delay(init)" in str(error.value.fix)


def test_a_cycle_through_a_clock_is_a_cycle():
    @graph
    def g(x: Stream[Scalar]):
        held = latest(init=0.0, name="held")
        y = add(x, held, name="sum")
        chosen = y.filter(lambda v: v > 0.0, name="chosen")
        held.feed(delay_of(x).at(chosen, name="sampled"))
        return y

    def delay_of(x):
        return x.delay(0.0, name="memory")

    with pytest.raises(CycleError) as error:
        g.build()
    for part in ("sum", "chosen", "sampled.at", "held"):
        assert part in str(error.value.got)


def test_a_cycle_with_a_delay_is_fine():
    @graph
    def g(x: Stream[Scalar]):
        memory = delay(0.0)
        y = add(x, memory)
        memory.feed(y)
        return y

    assert pairs(simulate(g.build(), {"x": scalars([0, 1, 2])}).output) == [(0, 1.0), (1, 3.0), (2, 6.0)]


def test_blocks_joins_and_graphs_outside_a_graph():
    @graph
    def g(x: Stream[Scalar]):
        return x

    for call in (lambda: add(1.0, 2.0), lambda: delay(0.0), lambda: g(1.0)):
        with pytest.raises(DeclarationError, match="can only be wired while a graph is declared"):
            call()
    assert add.step(1.0, 2.0) == 3.0


def test_after_a_failed_build_nothing_is_under_construction():
    @graph
    def g(x: Stream[Scalar]):
        return add(x)

    with pytest.raises(DeclarationError):
        g.build()
    with pytest.raises(DeclarationError, match="only be wired while"):
        add(1.0, 2.0)


def test_a_stream_of_another_graph_is_refused():
    kept: list[Any] = []

    @graph
    def one(x: Stream[Scalar]):
        kept.append(x)
        return x

    @graph
    def two(x: Stream[Scalar]):
        return add(x, kept[0])

    one.build()
    with pytest.raises(
        DeclarationError, match="add: port 'b' is wired to a stream of another graph"
    ) as error:
        two.build()
    assert error.value.got == "x of one"


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda x: bool(x), "a stream has no truth value"),
        (lambda x: [*x], "a stream cannot be unpacked"),
        (lambda x: collect(3.0, "y"), "only streams can be collected"),  # type: ignore[arg-type]
        (lambda x: gain(3.0, k=1.0), "gain: port 'x' needs a stream"),
        (lambda x: gain(x, x, k=1.0), "gain: too many streams"),
        (lambda x: add(x, x, a=x), "port 'a' is given twice"),
        (lambda x: gain(x), "gain: setting 'k' is missing"),
        (lambda x: gain(x, k=x), "setting 'k' cannot be a stream"),
        (lambda x: gain(x, k=1.0, q=2), "no setting is called 'q'"),
    ],
)
def test_misuse_of_a_stream(use, words):
    @graph
    def g(x: Stream[Scalar]):
        use(x)
        return x

    with pytest.raises((DeclarationError, UnknownNameError), match=words):
        g.build()


def test_a_graph_can_be_built_twice_with_other_settings():
    @graph
    def g(x: Stream[Scalar], *, k: float):
        return gain(x, k=k)

    one, two = g.build(k=1.0), g.build(k=10.0)
    data = {"x": scalars([0])}
    assert pairs(simulate(one, data).output) == [(0, 1.0)]
    assert pairs(simulate(two, data).output) == [(0, 10.0)]


def test_numbers_and_arrays_on_either_side_of_a_stream():
    @graph
    def g(x: Stream[Scalar]):
        return {"a": 2.0 * x + 1.0, "b": 1.0 - x / 2.0, "c": np.float64(6.0) / x, "d": -x}

    result = simulate(g.build(), {"x": scalars([0], [3.0])})
    assert [result[k].value[0] for k in "abcd"] == [7.0, -0.5, 2.0, -3.0]


def test_a_graph_without_a_flight_says_so():
    @graph
    def g(x: Stream[Scalar]):
        return x

    with pytest.raises(DeclarationError, match="g: this graph does not know how to start on a flight"):
        g.case(None)  # type: ignore[arg-type]


def test_a_case_is_of_a_flight_and_of_settings_that_there_are():
    @graph
    def g(x: Stream[Scalar]):
        return x

    g.on_flight(lambda flight, *, gain: flight)
    for none in (None, "sim"):
        with pytest.raises(DeclarationError, match="g: a case is of a flight") as error:
            g.case(none)  # type: ignore[arg-type]
        assert repr(none) in str(error.value)
    with pytest.raises(UnknownNameError, match="g: no setting is called 'gian'") as unknown:
        g.case(Flight("f", {}), gian=1.0)
    assert unknown.value.valid == ["gain"]


def line(graph_function: Any, below: int) -> str:
    """module:line of a line of a graph function, counted from its decorator."""
    return f"{__name__}:{graph_function.function.__code__.co_firstlineno + below}"


def test_what_is_seen_at_the_end_names_the_line_that_began_it():
    @graph
    def unfed(x: Stream[Scalar]):
        held = delay(0.0, name="belief")
        return add(x, held)

    @graph
    def circle(x: Stream[Scalar]):
        held = latest(init=0.0, name="held")
        total = add(x, held)
        held.feed(total)
        return total

    @graph
    def silent(x: Stream[Scalar]):
        gain(x, k=2.0)

    @graph
    def unread(x: Stream[Scalar], y: Stream[Scalar]):
        return x

    for wrong, error, below, words in (
        (unfed, DeclarationError, 2, "this delay is never fed"),
        (circle, CycleError, 2, "a cycle passes through no delay"),
        (silent, DeclarationError, 0, "this graph gives nothing"),
        (unread, DeclarationError, 0, "this source is connected to nothing"),
    ):
        with pytest.raises(error, match=words) as caught:
            wrong.build()
        assert caught.value.line == line(wrong, below), words
        assert caught.value.fix


def test_a_graph_of_sinks_gives_nothing_and_is_no_mistake():
    seen: list[float] = []

    @graph
    def g(x: Stream[Scalar]):
        sink(x, seen.append)

    simulate(g.build(), {"x": scalars([0, 1])})
    assert seen == [1.0, 2.0]


@pytest.mark.parametrize(
    "use",
    [
        lambda g: simulate(g, {"x": scalars([0])}),
        lambda g: Run(g),
        lambda g: lower(g),
        lambda g: simulate_many(g, {"x": scalars([0])}, range(2), engine="python"),
        lambda g: g.draw(),
    ],
    ids=["simulate", "Run", "lower", "simulate_many", "draw"],
)
def test_a_graph_that_was_not_built_says_how_to_build_it(use):
    @graph
    def g(x: Stream[Scalar]):
        return x

    with pytest.raises(DeclarationError, match="this graph is declared, but not built") as error:
        use(g)
    assert error.value.line == f"{__name__}:{use.__code__.co_firstlineno}"
    assert "g.build(...)" in str(error.value.fix)
    with pytest.raises(AttributeError, match="no attribute 'spelt_wrongly'"):
        _ = g.spelt_wrongly


@pytest.mark.parametrize("thing", [lambda x: x, 3, None, Scalar, "ins_eskf"])
def test_what_is_no_graph_is_refused_by_name(thing):
    with pytest.raises(DeclarationError, match="this is no graph") as error:
        simulate(thing, {"x": scalars([0])})
    assert type(thing).__name__ in str(error.value.got)
    assert "build it" in str(error.value.fix)
