"""Signal types: what fits where, what a value is made of, and the messages for what does not fit."""

from __future__ import annotations

import copy
import pickle
from typing import Annotated, Any

import numpy as np
import pytest

from flowgraph import Array, DeclarationError, Signal, TypeMismatchError, boolean, integer, real
from flowgraph.types import (
    ArrayType,
    StructType,
    annotation_type,
    as_value,
    bind,
    check_fits,
    dtype_name,
    flatten,
    leaves_of,
    struct_type,
    tuple_type,
    type_of,
    unflatten,
    without_none,
    zeros,
)


class Rate(Signal):
    rate: Array = real(3, unit="rad/s", frame="body")


class Reading(Signal):
    turn: Rate
    valid: Array = boolean()
    count: Array = integer(2, dtype="int64")


class Longer(Rate):
    extra: Array = real(unit="s")


class Awkward(Signal):
    """Field names that a careless generated constructor would trip over."""

    d: Array = real()
    self: Array = real()
    fields: Array = real()


def a_reading() -> Reading:
    return Reading(turn=Rate(rate=np.arange(3.0)), valid=np.True_, count=np.array([4, 5]))


def fits(given: Any, wanted: Any, sizes: dict[str, int] | None = None) -> dict[str, int]:
    bound = {} if sizes is None else sizes
    check_fits(given, wanted, given_at="left", wanted_at="right", sizes=bound)
    return bound


def test_struct_type_lists_fields_in_declaration_order():
    assert [n for n, _ in struct_type(Reading).fields] == ["turn", "valid", "count"]
    assert [n for n, _ in leaves_of(struct_type(Reading))] == ["turn.rate", "valid", "count"]
    assert [n for n, _ in struct_type(Longer).fields] == ["rate", "extra"]


def test_leaf_keeps_shape_kind_unit_and_frame():
    leaf = dict(leaves_of(struct_type(Reading)))["turn.rate"]
    assert leaf == ArrayType((3,), "real", "rad/s", "body")
    assert str(leaf) == "real[3], rad/s, body"


def test_any_field_name_can_be_stored():
    value = Awkward(1.0, 2.0, 3.0)
    assert (value.__dict__["d"], value.__dict__["self"], value.__dict__["fields"]) == (1.0, 2.0, 3.0)
    assert Awkward(d=1.0, fields=3.0, self=2.0).d == 1.0


def test_signal_is_immutable_and_replace_makes_a_copy():
    value = Rate(rate=np.zeros(3))
    with pytest.raises(AttributeError, match=r"Rate is immutable: use .replace\(rate=...\)"):
        value.rate = np.ones(3)  # type: ignore[misc]
    changed = value.replace(rate=np.ones(3))
    assert value.rate.sum() == 0.0
    assert changed.rate.sum() == 3.0


def test_signal_can_be_copied_and_pickled_by_its_user():
    for other in (copy.deepcopy(a_reading()), pickle.loads(pickle.dumps(a_reading()))):
        np.testing.assert_array_equal(other.turn.rate, [0.0, 1.0, 2.0])


def test_a_field_that_is_no_leaf_is_refused():
    with pytest.raises(DeclarationError, match=r"Bad: field 'x' is not declared as a leaf") as error:

        class Bad(Signal):
            x: Array = 3.0  # type: ignore[assignment]

    assert error.value.got == "3.0"
    assert "x: Array = real(3" in str(error.value.fix)


def test_a_field_without_a_type_is_refused():
    class Untyped(Signal):
        x: Array

    with pytest.raises(DeclarationError, match=r"Untyped: field 'x' has no type"):
        struct_type(Untyped)


def test_flatten_and_unflatten_are_inverse():
    kind = struct_type(Reading)
    leaves = flatten(a_reading(), kind)
    back = unflatten(kind, iter(leaves))
    assert isinstance(back, Reading)
    assert isinstance(back.turn, Rate)
    assert all(a is b for a, b in zip(flatten(back, kind), leaves, strict=True))


def test_flatten_and_unflatten_of_tuples_and_dicts():
    value = ({"b": np.float64(1.0), "a": np.arange(2)}, np.True_)
    kind = type_of(value)
    assert isinstance(kind, StructType)
    back = unflatten(kind, iter(flatten(value, kind)))
    assert list(back[0]) == ["b", "a"]
    assert back[1]
    assert [n for n, _ in leaves_of(kind)] == ["0.b", "0.a", "1"]


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (1.5, ArrayType()),
        (True, ArrayType((), "bool")),
        (3, ArrayType((), "int64")),
        (np.float32(1), ArrayType()),
        (np.zeros((2, 3)), ArrayType((2, 3))),
        (np.zeros(2, np.int32), ArrayType((2,), "int32")),
        (np.zeros(2, np.uint32), ArrayType((2,), "uint32")),
        ((1.0, True), tuple_type([ArrayType(), ArrayType((), "bool")])),
    ],
)
def test_type_of_values(value, kind):
    assert type_of(value) == kind


def test_numbers_that_no_signal_carries_are_refused():
    with pytest.raises(DeclarationError, match="a signal cannot carry this kind of number") as error:
        dtype_name(np.zeros(2, np.complex128))
    assert error.value.got == "complex128"


@pytest.mark.parametrize(
    ("annotation", "kind"),
    [
        (float, ArrayType()),
        (int, ArrayType((), "int64")),
        (bool, ArrayType((), "bool")),
        (Rate, struct_type(Rate)),
        (Annotated[Any, real(3)], ArrayType((3,))),
        (tuple[float, Rate], tuple_type([ArrayType(), struct_type(Rate)])),
        (Any, None),
        (str, None),
        (tuple[float, Any], None),
    ],
)
def test_annotation_type(annotation, kind):
    assert annotation_type(annotation) == kind


def test_without_none_splits_an_optional():
    assert without_none(Rate | None) == (Rate, True)
    assert without_none(Rate) == (Rate, False)
    assert without_none(None) == (None, False)


@pytest.mark.parametrize(
    ("given", "wanted", "words"),
    [
        (real(3), real(4), ["the shape of left does not fit right", "real[3]", "real[4]", "sizes agree"]),
        (real(3), real(3, 1), ["the shape", "reshape"]),
        (real(unit="deg"), real(unit="rad"), ["the unit of left", "deg -> rad"]),
        (real(frame="body"), real(frame="world"), ["the frame of left", "rotate it", "body -> world"]),
        (integer(), real(), ["the dtype of left", "int32", "real"]),
        (struct_type(Rate), struct_type(Longer), ["the signal type", "different quantities"]),
        (struct_type(Rate), real(3), ["the signal type", "take the field out"]),
        (real(3), struct_type(Rate), ["the signal type", "pack the array"]),
    ],
)
def test_what_does_not_fit_names_both_ends_and_the_fix(given, wanted, words):
    with pytest.raises(TypeMismatchError) as error:
        fits(given, wanted)
    text = str(error.value)
    assert text.startswith("right: ")
    assert "expected:" in text
    assert "got:" in text
    assert "fix:" in text
    for word in words:
        assert word in text


def test_the_leaf_that_differs_is_named():
    other = tuple_type([ArrayType((3,)), ArrayType((), "bool")])
    with pytest.raises(TypeMismatchError, match=r"right\.1: the dtype of left\.1 does not fit right\.1"):
        fits(tuple_type([ArrayType((3,)), ArrayType()]), other)


def test_unit_and_frame_that_are_not_stated_fit_any():
    fits(real(), real(unit="m", frame="world"))
    fits(real(unit="m", frame="world"), real())


def test_symbolic_sizes_are_bound_once_and_hold():
    sizes = fits(real(5, 3), real("N", 3))
    assert sizes == {"N": 5}
    fits(real(5), real("N"), sizes)
    with pytest.raises(TypeMismatchError, match=r"bound so far: \{'N': 5\}"):
        fits(real(4), real("N"), sizes)


def test_one_symbolic_size_twice_in_a_shape_must_agree():
    fits(real(4, 4), real("N", "N"))
    with pytest.raises(TypeMismatchError, match="the shape"):
        fits(real(4, 5), real("N", "N"))


def test_bind_replaces_known_sizes():
    assert bind(real("N", 3), {"N": 7}) == real(7, 3)
    assert bind(real("N", 3), {}) == real("N", 3)


def test_as_value_copies_and_is_read_only():
    source = np.zeros(3)
    made = as_value(source, real(3), path="x")
    source[0] = 1.0
    assert made[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        made[0] = 2.0


def test_as_value_takes_an_integer_for_a_real_but_not_the_reverse():
    assert as_value(3, real(), path="x").dtype == np.float64
    with pytest.raises(TypeMismatchError, match="the dtype of the value for x"):
        as_value(1.5, integer(), path="x")


def test_as_value_scalars_are_numpy_scalars():
    assert isinstance(as_value(1.0, real(), path="x"), np.float64)
    assert isinstance(as_value(True, boolean(), path="x"), np.bool_)


def test_as_value_refuses_a_wrong_shape_with_its_path():
    with pytest.raises(TypeMismatchError, match=r"^belief: the shape"):
        as_value(np.zeros(2), real(3), path="belief")


def test_zeros_have_the_type_they_are_asked_for():
    blank = zeros(struct_type(Reading))
    assert type_of(blank) == struct_type(Reading)
    assert not blank.valid
