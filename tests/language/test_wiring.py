"""Wiring blocks: when they fire, which clocks their outputs have, and types across wires."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    ClockError,
    DeclarationError,
    Scalar,
    Signal,
    Stream,
    TypeMismatchError,
    aperiodic,
    apply,
    block,
    every,
    graph,
    latest,
    periodic,
    real,
    simulate,
    when,
)
from flowgraph.language.block import Block
from tests.support import all_engines, pairs, scalars


class Metres(Signal):
    value: Array = real(2, unit="m", frame="world")


class Feet(Signal):
    value: Array = real(2, unit="ft", frame="world")


class InBody(Signal):
    value: Array = real(2, unit="m", frame="body")


@block
def add(a, b):
    return a + b


@block
def maybe(x, z: Scalar | None):
    return x if z is None else x + 100.0 * z


@block
def corrected(x: Scalar, z: Scalar | None) -> tuple[Scalar, Scalar | None]:
    return (x, None) if z is None else (x + z, z - x)


def clock_at(built, path: str) -> str:
    return str(next(n for _, n in built.calls if n.path == path).outputs[-1].clock)


def test_two_streams_of_one_clock_fire_together():
    @graph
    def g(x: Stream[Scalar]):
        return add(x.map(lambda v: v), x)

    assert pairs(all_engines(g.build(), {"x": scalars([0, 1])}).output) == [(0, 2.0), (1, 4.0)]


def test_clocks_that_are_not_provably_equal_are_refused():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return add(x, y)

    with pytest.raises(ClockError, match="x and y are not provably present together") as error:
        g.build(x=periodic("5ms", phase=0), y=periodic("5ms", phase=0))
    assert error.value.got == "x and y"
    for word in ("latest(y, init=...)", "zip", "match"):
        assert word in str(error.value.fix)


def test_equal_clocks_written_differently_fire_together():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        held = latest(x, init=0.0)
        return add(held.at(x | y), held.at((y | x) | (x & y)))

    result = all_engines(g.build(), {"x": scalars([0, 20]), "y": scalars([10])})
    assert pairs(result.output) == [(0, 2.0), (10, 2.0), (20, 4.0)]


def test_at_restricts_and_must_lie_within_the_inputs():
    @graph
    def g(x: Stream[Scalar]):
        return Block(lambda v: v, name="copy")(x, at=every(2, x))

    @graph
    def h(x: Stream[Scalar], y: Stream[Scalar]):
        return add(x, latest(y, init=0.0), at=y)

    assert pairs(all_engines(g.build(), {"x": scalars(range(4))}).output) == [(0, 1.0), (2, 3.0)]
    with pytest.raises(ClockError, match="add: input 'a' can be absent when the block fires") as error:
        h.build()
    assert "latest(x, init=...)" in str(error.value.fix)


def test_held_inputs_alone_need_a_clock():
    @graph
    def g(x: Stream[Scalar]):
        return add(latest(x, init=0.0), latest(x, init=1.0))

    with pytest.raises(ClockError, match="add: nothing fires this block: all its inputs are held") as error:
        g.build()
    assert "at=" in str(error.value.fix)


def test_held_values_fire_nothing():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return add(x, latest(y, init=0.0))

    result = all_engines(g.build(), {"x": scalars([0, 30]), "y": scalars([10, 20])})
    assert pairs(result.output) == [(0, 1.0), (30, 4.0)]


def test_an_option_within_the_main_clock_passes():
    @graph
    def g(x: Stream[Scalar]):
        return maybe(x, every(2, x))

    assert [v for _, v in pairs(all_engines(g.build(), {"x": scalars(range(3))}).output)] == [
        101.0,
        2.0,
        303.0,
    ]


def test_an_option_outside_the_main_clock_is_refused():
    @graph
    def g(x: Stream[Scalar], z: Stream[Scalar]):
        return maybe(x, z)

    with pytest.raises(
        ClockError, match="maybe: optional input 'z' can come when the block does not fire"
    ) as e:
        g.build()
    assert "at=x | z" in str(e.value.fix)


def test_an_option_left_out_is_absent():
    @graph
    def g(x: Stream[Scalar]):
        return maybe(x)

    assert pairs(all_engines(g.build(), {"x": scalars([0])}).output) == [(0, 1.0)]


def test_an_option_given_a_held_value_is_always_there():
    @graph
    def g(x: Stream[Scalar]):
        return maybe(x, latest(x, init=0.0))

    assert pairs(all_engines(g.build(), {"x": scalars([0])}).output) == [(0, 101.0)]


def test_an_optional_output_has_the_clock_of_its_cause():
    @graph
    def g(x: Stream[Scalar], z: Stream[Scalar]):
        held = latest(x, init=0.0)
        best, innovation = corrected(held.at(x | z), z)
        return {"best": best, "innovation": innovation}

    built = g.build()
    assert clock_at(built, "corrected") == "z"
    result = all_engines(built, {"x": scalars([0, 10, 20]), "z": scalars([10, 15])})
    assert result.best.time.tolist() == [0, 10, 15, 20]
    assert pairs(result.innovation) == [(10, -1.0), (15, 0.0)]


def test_an_output_with_a_condition_has_a_clock_of_its_own():
    @block
    def positive(x):
        return when(x > 0.0, 10.0 * x)

    @graph
    def g(x: Stream[Scalar]):
        y = positive(x)
        return {"y": y, "sum": add(y, y.map(lambda v: v)), "held": latest(y, init=-1.0).at(x)}

    built = g.build()
    assert clock_at(built, "positive") == "positive"
    result = all_engines(built, {"x": scalars(range(4), [1, -1, -2, 2])})
    assert pairs(result.y) == [(0, 10.0), (3, 20.0)]
    assert pairs(result["sum"]) == [(0, 20.0), (3, 40.0)]
    assert [v for _, v in pairs(result.held)] == [10.0, 10.0, 10.0, 20.0]


def test_two_conditions_are_not_provably_together():
    @graph
    def g(x: Stream[Scalar]):
        return add(x.filter(lambda v: v > 0.0), x.filter(lambda v: v > 0.0))

    with pytest.raises(ClockError, match="filter and filter_2 are not provably present together"):
        g.build()


def test_a_block_that_fires_at_a_condition_comes_after_what_decides_it():
    """Regression: only data made an order, so a clock could be read before it was known."""

    @graph
    def g(x: Stream[Scalar]):
        held = latest(init=0.0, name="held")
        memory = x.delay(0.0, name="memory")
        y = add(x, held)
        held.feed(memory.at(every(2, x), name="sampled"))
        return y

    result = all_engines(g.build(), {"x": scalars(range(5))})
    assert [v for _, v in pairs(result.output)] == [1.0, 2.0, 5.0, 6.0, 9.0]


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (Feet, ["the signal type", "Metres", "Feet"]),
        (InBody, ["the signal type", "InBody"]),
        (real(2, unit="ft"), ["the unit", "ft -> m"]),
        (real(2, unit="m", frame="body"), ["the frame", "body -> world"]),
        (real(3, unit="m"), ["the shape"]),
    ],
)
def test_wires_check_type_unit_frame_and_shape(other, words):
    @block
    def read_signal(x: Metres) -> Metres:
        return x

    plain = real(2, unit="m", frame="world")

    @block
    def read_leaf(x: plain):  # type: ignore[valid-type]
        return x

    reader = read_signal if isinstance(other, type) else read_leaf

    @graph
    def g(x: Stream[other]):  # type: ignore[valid-type]
        return reader(x)

    with pytest.raises(TypeMismatchError) as error:
        g.build()
    assert "of x does not fit" in str(error.value)
    assert f"{reader.name}.x" in str(error.value)
    for word in words:
        assert word in str(error.value)


def test_a_result_that_breaks_its_annotation_is_refused():
    @block
    def wrong(x) -> Metres:
        return x

    @graph
    def g(x: Stream[Scalar]):
        return wrong(x)

    with pytest.raises(TypeMismatchError, match="wrong's result") as error:
        g.build()
    assert "annotation" in str(error.value.fix)


def test_units_pass_through_unchanged_values_only():
    metres = real(2, unit="m", frame="world")

    @graph
    def g(x: Stream[metres]):  # type: ignore[valid-type]
        return {"same": x.map(lambda v: v), "changed": x.map(lambda v: 2.0 * v)}

    built = g.build()
    assert [built.port(c.wire).type for c in built.collected] == [metres, real(2)]


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (lambda *xs: xs[0], "cannot be a port or a setting"),
        (lambda **k: 0.0, "cannot be a port or a setting"),
    ],
)
def test_variable_parameters_are_refused(step, words):
    @graph
    def g(x: Stream[Scalar]):
        return Block(step, name="odd")(x)

    with pytest.raises(DeclarationError, match=words):
        g.build()


def test_a_step_that_returns_another_number_of_outputs():
    @block
    def two(x) -> tuple[Scalar, Scalar]:
        return x  # type: ignore[return-value]

    @graph
    def g(x: Stream[Scalar]):
        return two(x)

    with pytest.raises(DeclarationError, match="another number of outputs") as error:
        g.build()
    assert "2 outputs" in str(error.value.expected)


def test_a_state_must_be_returned_and_keep_its_type():
    @block
    def forgets(state, x):
        return x

    @block
    def grows(state, x, *, xp):
        return xp.stack([x, x]), x

    for made in (forgets, grows):
        made.init(lambda x: 0.0)

    def build(made: Any) -> None:
        @graph
        def g(x: Stream[Scalar]):
            return made(x)

        g.build()

    with pytest.raises(DeclarationError, match=r"must return \(state, outputs\)"):
        build(forgets)
    with pytest.raises(TypeMismatchError, match="the state returned by grows"):
        build(grows)


def test_outputs_whose_type_depends_on_an_option_are_refused():
    @block
    def changing(x, z: Scalar | None, *, xp):
        return x if z is None else xp.stack([x, z])

    @graph
    def g(x: Stream[Scalar]):
        return changing(x, every(2, x))

    with pytest.raises(TypeMismatchError, match="changes its type with the presence of an option"):
        g.build()


def test_symbolic_sizes_are_unified_across_ports():
    @block
    def dot(a: real("N"), b: real("N")):  # type: ignore[valid-type]
        return a @ b

    def built(n: int, m: int):
        @graph
        def g(x: Stream[real(n)], y: Stream[real(m)]):  # type: ignore[valid-type]
            return dot(x, latest(y, init=np.zeros(m)))

        return g.build()

    result = simulate(built(2, 2), {"x": ([0], np.ones((1, 2))), "y": ([0], np.full((1, 2), 3.0))})
    assert result.output.value[0] == 6.0
    with pytest.raises(TypeMismatchError, match=r"dot\.b.*bound so far: \{'N': 2\}|bound so far"):
        built(2, 3)


def test_apply_names_and_types_its_result():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return apply(lambda a, b: a - b, x, latest(y, init=0.0), name="difference")

    built = g.build(x=aperiodic(), y=aperiodic(max_rate=10))
    assert [n.path for _, n in built.calls] == ["difference"]
    assert pairs(simulate(built, {"x": scalars([0]), "y": scalars([0], [4.0])}).output) == [(0, -3.0)]
