"""What an error prints."""

from __future__ import annotations

from flowgraph.errors import FlowgraphError


def test_a_person_can_read_all_that_it_prints():
    """Of a list of thousands its start and its end; the attribute has it whole."""
    whole = ", ".join(map(str, range(10_000)))
    error = FlowgraphError("too many", path="here", expected="one", got=whole, fix="give one")
    assert error.got == whole
    words = str(error)
    assert len(words) < 2200
    assert "got:      0, 1, 2" in words
    assert "9998, 9999\n  fix:      give one" in words
    assert f"({len(whole) - 2000:,} characters)" in words


def test_what_fits_is_printed_whole():
    words = "x" * 2000
    assert f"got:      {words}" in str(FlowgraphError("wrong", got=words))
