"""Random graphs: python, reference and the words of docs/semantics.md agree. See `tests.oracle`."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.oracle.check import fault
from tests.oracle.meaning import Meaning
from tests.oracle.specs import KINDS, drawn

FOUND = (59, 1271, 1190, 2042, 3382, 12349, 105200, 111128)
"""Seeds that once showed a fault: a batch of one, whose clock is its stream's, was taken for a cycle; streams
of one clock that has two names were not zipped; one where this reading of the document was wrong; and blocks
with optional inputs at a clock that never ticks, which were refused."""


@pytest.mark.parametrize("seed", range(50))
def test_a_random_graph_is_what_the_document_says(seed):
    assert fault(drawn(seed)) is None


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 1300, 50))
def test_more_of_them(first):
    assert {seed: wrong for seed in range(first, first + 50) if (wrong := fault(drawn(seed)))} == {}


@pytest.mark.parametrize("seed", FOUND)
def test_what_once_was_wrong_is_right(seed):
    assert fault(drawn(seed)) is None


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["c", "xla"])
def test_other_engines_agree(engine):
    assert [fault(drawn(seed), [engine]) for seed in range(3)] == [None] * 3


def test_all_operations_are_drawn_and_have_a_meaning():
    seen = {node["op"] for seed in range(200) for node in drawn(seed)["nodes"]}
    assert seen == set(KINDS)
    assert all(hasattr(Meaning, f"do_{name}") for name in KINDS)


def test_a_wrong_meaning_is_found(monkeypatch):
    """The comparison can fail: in times, in values, in counts and in what is full."""
    found = set()
    for name, wrong in (
        ("do_filter", lambda self, n, a: a[1:]),
        ("do_latest", lambda self, n, a, *at: [(t, 0.5) for s in at for t, _ in s]),
    ):
        with monkeypatch.context() as changed:
            changed.setattr(Meaning, name, wrong)
            if any(fault(drawn(seed)) for seed in range(40)):
                found.add(name)
    assert found == {"do_filter", "do_latest"}


def test_the_command_tells_how_many_and_which():
    ran = subprocess.run(
        [sys.executable, "-m", "tests.oracle", "--count", "2", "--seed", "3", "--json"],
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    report = json.loads(ran.stdout)
    assert (ran.returncode, report["count"], report["failed"], report["seeds"]) == (0, 2, 0, [])
    assert report["graphs_per_s"] > 0
