"""Lists in the settings of a bench."""

from __future__ import annotations

import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.graphs.benches import lists
from flowgraph.graphs.benches.drives import drives
from flowgraph.graphs.benches.hardware import hardware


def test_numbers_are_sorted_and_each_once():
    assert lists.numbers("24, 16,24,", "hardware.space") == [16, 24]


@pytest.mark.parametrize("text", ["", "x", "0", "-3", "1.5", "10,x"])
def test_what_is_no_number_is_refused(text):
    with pytest.raises(DeclarationError, match=r"(?s)space: these are no whole numbers.*--set space="):
        lists.numbers(text, "hardware.space")


@pytest.mark.parametrize(
    ("text", "wanted"), [("", ["a", "b"]), ("all", ["a", "b"]), (" b ,", ["b"]), ("b,a", ["b", "a"])]
)
def test_names_keep_their_order_and_all_are_meant_where_none_is_said(text, wanted):
    assert lists.names(text, ["a", "b"], what="thing", path="here") == wanted


def test_a_name_that_is_not_there_is_refused_before_anything_runs():
    with pytest.raises(UnknownNameError, match=r"(?s)hardware.graphs: no graph is called 'kalmann'.*kalman"):
        hardware(graphs="kalmann")
    with pytest.raises(UnknownNameError, match=r"(?s)drives.units: .*tactical"):
        drives(units="tacticle")
