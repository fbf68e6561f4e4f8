"""Joins in which it counts when values came: pairs of what is new, times between values, silence, labels."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    Array,
    DeclarationError,
    FifoOverflowError,
    Scalar,
    Signal,
    Stream,
    TypeMismatchError,
    absent_for,
    aperiodic,
    graph,
    label_data,
    periodic,
    real,
    resample_at,
    simulate,
    zip_last,
)
from flowgraph.blocks.signals import Pose
from tests.support import MS, all_engines, both_quick, scalars


class Turn(Signal):
    q: Array = real(4)


def events(*pairs):
    return scalars(np.array([t for t, _ in pairs]) * MS, [v for _, v in pairs])


@graph
def joined(a: Stream[Scalar], b: Stream[Scalar]):
    return {
        "pair": zip_last(a, b, name="pair"),
        "line": resample_at(a, b, name="line"),
        "held": resample_at(a, b, how="hold", name="held"),
        "gone": absent_for(a, "3ms", at=b, name="gone"),
        "label": label_data(a, lambda t, *, xp: xp.astype(t, xp.float64) * 1e-6, name="label"),
    }


A = events((1, 10), (3, 30), (4, 40), (11, 50), (12, 0))
B = events((0, 1), (2, 2), (4, 3), (8, 4), (11, 5))


def test_all_engines_pair_and_interpolate_alike():
    found = all_engines(joined.build(), {"a": A, "b": B})
    assert (found["pair"].time // MS).tolist() == [1, 3, 4, 11]
    assert found["pair"]["1"].tolist() == [1, 2, 3, 5]  # 4, at 8 ms, is passed over for 5
    assert (found["line"].time // MS).tolist() == [3, 4, 11, 12]
    assert (found["line"]["0"] // MS).tolist() == [2, 4, 8, 11]
    np.testing.assert_allclose(found["line"]["1"], [20, 40, 40 + 10 * 4 / 7, 50], rtol=1e-15)
    assert found["held"]["1"].tolist() == [10, 40, 40, 50]
    assert found["gone"].value.tolist() == [False, False, False, True, False]
    assert found["label"]["1"].tolist() == [1, 3, 4, 11, 12]
    assert dict(found.stats) == {"line.expired": 1, "held.expired": 1}


@graph
def lined(a: Stream[Scalar], b: Stream[Scalar]):
    return resample_at(a, b, name="line")


def asked(found):
    return [(t // MS, u // MS, v) for t, u, v in zip(found.time, found["0"], found["1"], strict=True)]


@pytest.mark.parametrize(
    ("a", "b", "wanted", "before"),
    [
        ([0, 10, 20], [5, 10, 15], [(10, 5), (15, 10), (20, 15)], 0),
        ([10, 20, 30], [5, 7, 12, 20], [(20, 12), (30, 20)], 2),
        ([0, 10, 40, 41, 50], [12, 14, 16], [(40, 12), (41, 14), (50, 16)], 0),
        ([0, 20], [0, 5, 10, 15, 20, 25, 30], [(0, 0), (20, 5), (25, 10), (30, 15)], 0),
        ([], [5, 15], [], 2),
        ([5, 6], [], [], 0),
    ],
)
def test_each_tick_gives_the_oldest_time_that_is_known(a, b, wanted, before):
    inputs = {"a": events(*((t, 3.0 * t) for t in a)), "b": events(*((t, 0) for t in b))}
    found = both_quick(lined.build(), inputs)
    assert asked(found.output) == [(t, u, pytest.approx(3.0 * u, rel=1e-15)) for t, u in wanted]
    assert found.stats == {"line.expired": before}


def test_a_slow_stream_at_a_fast_clock_goes_over_lost_values_in_all_engines():
    times = np.array([t for t in range(0, 1000, 100) if t not in (300, 400)])
    inputs = {"a": scalars(times * MS, times**2), "b": scalars(np.arange(0, 1000, 10) * MS)}
    found = all_engines(lined.build(a=aperiodic(), b=periodic("10ms")), inputs).output
    wanted = np.arange(0, 10 * len(found), 10)
    assert (found["0"] // MS).tolist() == wanted.tolist()
    np.testing.assert_allclose(found["1"], np.interp(wanted, times, times**2), rtol=1e-13)
    assert (found.time - found["0"]).max() == 290 * MS  # the first after 200, and all after it
    assert len(found) == 100 - 29


def test_a_fast_stream_goes_over_a_gap_and_catches_up():
    times = np.array([t for t in range(0, 1000, 10) if t not in (500, 510, 520)])
    inputs = {"a": scalars(times * MS, times), "b": scalars(np.arange(5, 1000, 20) * MS)}
    found = both_quick(lined.build(a=aperiodic(), b=periodic("20ms", phase="5ms")), inputs).output
    assert (found["0"] // MS).tolist() == list(range(5, 1000, 20))
    np.testing.assert_allclose(found["1"], np.arange(5.0, 1000, 20), rtol=1e-15)
    age = (found.time - found["0"]) // MS
    assert age[24:30].tolist() == [5, 25, 15, 5, 5, 5]


@pytest.mark.parametrize(
    ("a", "b", "size"),
    [
        (periodic("100ms"), periodic("10ms"), 40),
        (periodic("10ms"), periodic("20ms"), 8),
        (periodic("1s"), periodic("1ms"), 1024),
        (aperiodic(), periodic("10ms"), 64),
        (aperiodic(max_rate=5), aperiodic(max_rate=200), 160),
        (aperiodic(max_rate=50), periodic("10ms"), 64),
    ],
)
def test_the_usual_size_is_four_steps_of_the_stream(a, b, size):
    built = lined.build(a=a, b=b)
    step = b.period or 10 * MS
    just = {"a": scalars([0]), "b": scalars(np.arange(size + 1) * step)}
    assert simulate(built, just).output.time.tolist() == [0]
    with pytest.raises(FifoOverflowError, match=f"at most {size} waiting"):
        simulate(built, {**just, "b": scalars(np.arange(size + 2) * step)})


def test_the_usual_size_knows_of_every():
    @graph
    def thinned(a: Stream[Scalar], b: Stream[Scalar]):
        return resample_at(a.every(5), b)

    b = scalars(np.arange(202) * 10 * MS)
    with pytest.raises(FifoOverflowError, match="at most 200 waiting"):
        simulate(thinned.build(a=periodic("100ms"), b=periodic("10ms")), {"a": scalars([0]), "b": b})


def test_one_time_too_many_is_an_error_whose_mending_works():
    late = {"a": events((1, 1), (9, 2)), "b": events((2, 0), (5, 0), (7, 0))}

    def sized(size, full="error"):
        @graph
        def tight(a: Stream[Scalar], b: Stream[Scalar]):
            return resample_at(a, b, size=size, full=full, name="line")

        return tight.build()

    for engine in ("python", "reference", "c"):
        with pytest.raises(FifoOverflowError, match="too many times wait for a value") as refused:
            simulate(sized(2), late, engine=engine)
        assert refused.value.time == 7 * MS
        assert "raise size=" in str(refused.value)
    assert asked(simulate(sized(3), late).output) == [(9, 2, 1.125)]
    dropping = both_quick(sized(2, "drop_oldest"), late)
    assert asked(dropping.output) == [(9, 5, 1.5)]
    assert dropping.stats == {"line.expired": 1}


def test_attitudes_go_along_the_arc_and_the_rest_along_a_line():
    half = np.array([0.0, 0.4, 0.9]) / 2
    turns = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=-1)
    turns[1] *= -1  # the same attitude, by its other quaternion
    place = np.array([[0.0, 0, 0], [1, 2, 3], [2, 2, 2]])

    @graph
    def posed(pose: Stream[Pose], at: Stream[Scalar]):
        return resample_at(pose, at, how="slerp")

    inputs = {"pose": (np.array([0, 10, 20]) * MS, Pose(position=place, attitude=turns))}
    found = all_engines(posed.build(), {**inputs, "at": events((3, 0), (15, 0))}).output
    angle = 2 * np.arctan2(found["1.attitude"][:, 1], found["1.attitude"][:, 0])
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(wrapped, [0.12, 0.65], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found["1.attitude"], axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(found["1.position"], [[0.3, 0.6, 0.9], [1.5, 2, 2.5]], atol=1e-12)


def test_two_nearly_equal_attitudes_are_no_division_by_nothing():
    q = np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]])

    @graph
    def still(q: Stream[Turn], at: Stream[Scalar]):
        return resample_at(q.map(lambda v: v.q), at, how="slerp")

    found = simulate(still.build(), {"q": (np.array([0, 4]) * MS, Turn(q=q)), "at": events((1, 0))})
    assert found.output["1"].tolist() == [[1.0, 0, 0, 0]]


def test_silence_is_counted_from_the_first_tick_where_nothing_came():
    @graph
    def watched(a: Stream[Scalar], b: Stream[Scalar]):
        return absent_for(a, "3ms", at=b)

    found = simulate(watched.build(), {"a": events((30, 1)), "b": events((0, 1), (3, 1), (4, 1), (30, 1))})
    assert found.output.value.tolist() == [False, False, True, False]


@pytest.mark.parametrize(
    ("wire", "kind", "said"),
    [
        (lambda a, b: resample_at(a, b, how="cubic"), DeclarationError, "no way between two values"),
        (lambda a, b: resample_at(a, b, full="drop"), DeclarationError, "what a full queue can do"),
        (lambda a, b: resample_at(a, b, size=0), DeclarationError, "needs a whole number as 'size'"),
        (lambda a, b: resample_at(a, b, how="slerp"), TypeMismatchError, "nothing here turns"),
        (lambda a, b: resample_at(a > 1.0, b), TypeMismatchError, "real"),
        (lambda a, b: absent_for(a, "-1ms", at=b), DeclarationError, "span is not understood"),
        (lambda a, b: absent_for(a, -1, at=b), DeclarationError, "a silence has a length"),
        (lambda a, b: zip_last(a, None), DeclarationError, "stream"),  # type: ignore[arg-type]
    ],
)
def test_what_makes_no_sense_is_refused(wire, kind, said):
    @graph
    def wrong(a: Stream[Scalar], b: Stream[Scalar]):
        return wire(a, b)

    with pytest.raises(kind, match=said):
        wrong.build()
