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
    graph,
    label_data,
    real,
    resample_at,
    simulate,
    zip_last,
)
from flowgraph.blocks.signals import Pose
from tests.support import MS, all_engines, scalars


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


def test_two_times_between_two_values_are_an_error_that_names_the_second():
    late = {"a": events((1, 1), (9, 2)), "b": events((2, 0), (5, 0), (7, 0))}
    for engine in ("python", "reference", "c"):
        with pytest.raises(FifoOverflowError, match="two times were asked for between values") as refused:
            simulate(joined.build(), late, engine=engine)
        assert refused.value.time == 5 * MS


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
