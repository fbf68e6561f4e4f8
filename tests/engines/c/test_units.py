"""A large source in several files gives what it gives in one."""

from __future__ import annotations

import re

import numpy as np
import pytest

from flowgraph import Graph, Scalar, Series, Stream, graph, latest, lower, real, scan, simulate
from flowgraph.engines.c import generate
from flowgraph.engines.c import units as splitting
from flowgraph.engines.c.compile import CompileError, build
from flowgraph.engines.c.units import units


@graph
def three(a: Stream[real(3)], b: Stream[Scalar], c: Stream[Scalar]):  # type: ignore[valid-type]
    """Seven patterns, with a constant, a function of several elements and a register that all share."""
    turned = a.map(lambda x: np.array([[0.0, 1.0, 0.5], [1.0, 0.0, 0.25], [0.3, 0.2, 1.0]]) @ x)
    fold = scan(b, lambda y, x: 0.5 * y + x, init=1.0)
    return {"turned": turned, "fold": fold, "late": c + latest(b, init=2.0)}


def built() -> Graph:
    return three.build()


def events() -> dict[str, Series]:
    rng = np.random.default_rng(0)
    times = {name: np.flatnonzero(rng.random(60) < 0.6) for name in "abc"}
    return {n: Series(t, rng.normal(size=(len(t), 3) if n == "a" else len(t))) for n, t in times.items()}


@pytest.mark.parametrize("count", [2, 3, 4])
def test_patterns_in_several_files_are_those_of_one(count, tmp_path, monkeypatch):
    """Each reaction lies in one file, and the files together give the same to the bit."""
    whole = simulate(built(), events(), engine="c")
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path))
    monkeypatch.setattr(splitting, "LARGE", 1)
    monkeypatch.setattr(splitting, "MOST", count)
    made = generate(lower(built()))
    files = units(made)
    assert len(files) == count
    for key in made.patterns or ():
        owners = [n for n, text in files.items() if re.search(rf" fg_react_{key}\([^;{{]*\)\s*\{{", text)]
        assert len(owners) == 1, (key, owners)
    apart = simulate(built(), events(), engine="c")
    for name, series in whole.series.items():
        np.testing.assert_array_equal(apart[name].time, series.time)
        np.testing.assert_array_equal(apart[name]["value"], series["value"])


def test_a_small_source_stays_in_one_file():
    made = generate(lower(built()))
    assert units(made) == {f"{made.names.module}.c": made.source}


@pytest.mark.parametrize("bad", ["a.c", "b.c"])
def test_what_is_wrong_with_one_of_several_files_is_said(bad, tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path))
    files = {"a.c": "int f(void) { return 3; }\n", "b.c": "int g(void) { return 4; }\n"}
    assert build(files).is_file()
    with pytest.raises(CompileError, match="refuses the generated code") as error:
        build({**files, bad: "int h(void) { return nothing; }\n"})
    assert "nothing" in str(error.value)
