"""The benchmark's structure, on tiny sizes: no times are tested.

Each bench compares the numbers of ours and the peer before it times anything, and fails where they differ.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from flowgraph import simulate
from tests.bench import toy
from tests.bench.__main__ import BENCHES, main

NEEDS = {"toy-python": ["reactivex"], "toy-xla": ["jax"], "eskf-engines": ["jax"]}


@pytest.mark.parametrize("name", BENCHES)
def test_each_bench_gives_rows_beside_a_peer(name, capsys):
    for module in NEEDS.get(name, []):
        pytest.importorskip(module)
    main(["--json", "--quick", "--only", name])
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows
    for row in rows:
        assert {"name", "ours", "peer", "unit", "against", "ratio", "bound", "met", "details"} == set(row)
        assert min(row["ours"], row["peer"], row["ratio"]) > 0.0
        assert (row["met"] is None) == (row["bound"] is None)


def test_the_table_says_what_is_missed(capsys):
    main(["--quick", "--only", "eskf-python"])
    out = capsys.readouterr().out
    assert "direct" in out
    assert "missed: ins_eskf, python" in out or "All bounds are met." in out


def test_the_import_bench_names_the_heaviest_modules(capsys):
    main(["--quick", "--json", "--only", "import"])
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    modules = row["details"]["heaviest_modules"]
    assert row["bound"] == "ours < 0.4 s"
    assert row["details"]["bare_process_s"] > 0.0
    assert any(m["module"].startswith("numpy") for m in modules)


def test_toy_peers_compute_what_numpy_says():
    """Sum of 2a + 1 and the last b + 0.5, the new one at ties."""
    inputs = toy.recording(23)
    a, b = inputs["a"]["value"], inputs["b"]["value"]
    wanted = 2.0 * a + 1.0 + (np.repeat(b, toy.EVERY)[:23] + 0.5)
    np.testing.assert_allclose(simulate(toy.build(), inputs)["sum"]["value"], wanted)
    pytest.importorskip("reactivex")
    np.testing.assert_allclose(toy.with_reactivex(toy.in_order(inputs)), wanted)
    pytest.importorskip("jax")
    np.testing.assert_allclose(toy.with_scan(23, inputs)(), wanted)
