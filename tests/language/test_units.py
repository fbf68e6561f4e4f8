"""Units inside a step: where they are known they travel, and a contradiction is refused by its line."""

from __future__ import annotations

from typing import Any

import pytest

from flowgraph import Array, Signal, Stream, TypeMismatchError, apply, block, graph, real
from flowgraph.recorder.units import parsed, spelled, written


class Motion(Signal):
    position: Array = real(3, unit="m")
    velocity: Array = real(3, unit="m/s")
    acceleration: Array = real(3, unit="m/s^2")
    rate: Array = real(3, unit="rad/s")
    heading: Array = real(unit="rad")
    anything: Array = real(3)


class Place(Signal):
    place: Array = real(3, unit="m")


class Plain(Signal):
    p: Array = real(3, unit="m")
    v: Array = real(3, unit="m/s")


def build(step: Any, out: Any = None) -> Any:
    @graph
    def g(s: Stream[Motion]):
        return s.map(step, out=out)

    return g.build()


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (lambda s: Place(place=s.velocity), ["'place'", "expected: m", "m/s"]),
        (lambda s: s.position + s.velocity, ["add", "m and m/s"]),
        (lambda s, *, dt: s.position + s.acceleration * dt, ["m and m/s"]),
        (lambda s, *, dt: Place(place=s.acceleration * dt), ["'place'", "m/s"]),
        (lambda s, *, xp: Place(place=xp.sqrt(s.velocity**2)), ["'place'", "m/s"]),
        (lambda s, *, xp: xp.where(s.heading > 0.0, s.position, s.velocity), ["where", "m and m/s"]),
        (lambda s: s.position > s.velocity, ["greater", "m and m/s"]),
        (lambda s, *, xp: xp.maximum(s.position, s.velocity), ["maximum"]),
        (lambda s: s.position[0] - s.heading, ["subtract", "m and 1"]),
        (lambda s, *, xp: s.position - xp.linalg.cross(s.rate, s.velocity), ["m and m/s^2"]),
        (lambda s, *, xp: xp.linalg.solve(s.rate[:, None] * s.velocity, s.position) + s.velocity, ["s^2"]),
    ],
)
def test_a_contradiction_of_units_is_refused_by_its_line(step, words):
    with pytest.raises(TypeMismatchError) as error:
        build(step)
    assert error.value.line == f"{__name__}:{step.__code__.co_firstlineno}"
    for word in words:
        assert word in str(error.value)


def test_a_result_is_held_against_the_unit_that_is_declared():
    @block
    def moved(s: Motion) -> Place:
        return Place(s.velocity - s.velocity)

    @graph
    def g(s: Stream[Motion]):
        return moved(s)

    with pytest.raises(TypeMismatchError, match="the unit of 'place'"):
        g.build()
    with pytest.raises(TypeMismatchError, match="the unit of 'value'"):
        build(lambda s: -s.velocity, out=real(3, unit="m"))


def test_a_sum_of_streams_of_two_units_is_refused():
    @graph
    def g(s: Stream[Motion]):
        return s.map(lambda v: v.position) + s.map(lambda v: v.velocity)

    with pytest.raises(TypeMismatchError, match="add of different units") as error:
        g.build()
    assert error.value.line == f"{__name__}:{g.function.__code__.co_firstlineno + 2}"


@pytest.mark.parametrize(
    "step",
    [
        lambda s, *, dt: Place(place=s.position + s.velocity * dt + 0.5 * s.acceleration * dt**2),
        lambda s: Place(place=2.0 * s.velocity),  # a constant may convert
        lambda s: Place(place=s.anything + s.position),
        lambda s: s.position + 1.0,
        lambda s, *, xp: s.acceleration + xp.linalg.cross(s.rate, s.velocity),
        lambda s, *, xp: xp.concat([s.position, s.velocity]),
        lambda s, *, xp: Place(place=xp.sqrt(s.position * s.position)),
        lambda s, *, xp: xp.sin(s.heading) + 1.0,
    ],
)
def test_what_agrees_or_is_not_known_is_let_through(step):
    build(step)


def test_a_known_unit_goes_on_with_the_stream():
    @graph
    def g(s: Stream[Plain]):
        gap = apply(lambda v, *, dt: v.p / dt, s)
        return {"speed": gap, "way": apply(lambda v: v.p - v.p, s), "unknown": s.map(lambda v: 2.0 * v.p)}

    built = g.build()
    found = {c.name: built.port(c.wire).type.unit for c in built.collected}  # type: ignore[union-attr]
    assert found == {"speed": "m/s", "way": "m", "unknown": None}


@pytest.mark.parametrize(
    ("text", "canonical"),
    [
        ("m/s^2", "m/s^2"),
        ("m s^-2", "m/s^2"),
        ("kg*m^2/s^2", "kg*m^2/s^2"),
        ("J", "kg*m^2/s^2"),
        ("rad/s", "1/s"),
        ("m^0.5", "m^1/2"),
        ("1", "1"),
        ("deg", "deg"),
    ],
)
def test_units_are_read_and_written(text, canonical):
    unit = parsed(text)
    assert unit is not None
    assert written(unit) == canonical


@pytest.mark.parametrize("text", [None, "", "m/s/sqrt(Hz)", "!", "m//"])
def test_what_is_not_understood_is_not_known(text):
    assert parsed(text) is None


def test_a_unit_is_spelled_as_those_it_comes_from_are():
    speed = parsed("m/s")
    assert speed is not None
    assert spelled(speed, ["m s^-1", "m"]) == "m s^-1"
    assert spelled(speed, ["m", "s"]) == "m/s"
    assert spelled(speed, ["m", "rad/s"]) is None
    assert spelled(speed, ["mile s^-2"]) is None
    assert spelled(frozenset(), ["m"]) is None
