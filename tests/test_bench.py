"""The benchmark's structure, on tiny sizes: no times are tested.

Each bench compares the numbers of ours and the peer before it times anything, and fails where they differ.
"""

from __future__ import annotations

import json
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from flowgraph import simulate
from tests.bench import bootstrap, gpu, imports, particles, toy
from tests.bench.__main__ import BENCHES, main, show

NEEDS = {
    "toy-python": ["reactivex"],
    **{name: ["jax"] for name in ("toy-xla", "eskf-engines", "rbpf-engines", "normals-xla", "many-runs")},
    "study-seeds": ["filterpy", "pyarrow"],
    "study-memory": ["pyarrow"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHES)
def test_each_bench_gives_rows_beside_a_peer(name, capsys):
    for module in NEEDS.get(name, []):
        pytest.importorskip(module)
    main(["--json", "--quick", "--only", name])
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert rows
    for row in rows:
        assert {"name", "ours", "peer", "unit", "against", "ratio", "bound", "met", "details"} == set(row)
        assert row["ours"] > 0.0
        if row["peer"] is None:
            assert row["ratio"] is None
            assert row["against"].startswith("none: ")
        else:
            assert min(row["peer"], row["ratio"]) > 0.0
        assert (row["met"] is None) == (row["bound"] is None)


def test_the_table_says_what_is_missed(capsys):
    main(["--quick", "--only", "eskf-python"])
    out = capsys.readouterr().out
    assert "direct" in out
    assert "missed: ins_eskf, python" in out or "All bounds are met." in out


def test_a_missing_library_gives_a_row_without_a_peer(monkeypatch):
    """The other libraries' rows stay, and the table can be shown."""
    absent = "a_library_that_is_not_there"
    make = particles.LIBRARIES["Stone Soup"][1]
    monkeypatch.setattr(particles, "LIBRARIES", {"Stone Soup": (absent, make)})
    (row,) = particles.libraries(sizes=(20,), steps=3, repeats=1)
    assert row.ours > 0.0
    assert (row.peer, row.ratio, row.met) == (None, None, None)
    assert row.against == f"none: Stone Soup is not to be had (No module named {absent!r})"
    show([row])


def test_an_interpreter_without_particles_gives_a_row_that_says_so(monkeypatch, tmp_path):
    for python, why in ((sys.executable, "has no particles that works"), (tmp_path / "none", "pip install")):
        if python == sys.executable and find_spec("particles"):
            continue
        monkeypatch.setenv("FLOWGRAPH_PARTICLES", str(python))
        (row,) = bootstrap.rows(sizes=(50,), steps=3, repeats=1)
        assert (row.peer, row.met) == (None, None)
        assert why in row.against


def test_the_plain_model_of_the_libraries_moves_as_its_states_say():
    """Each state is F times the last and a jerk's noise, of the size that Q says; positions are seen."""
    F, Q, H, states, seen = bootstrap.plain_model(2000)
    errors = states[1:] - states[:-1] @ F.T
    whitened = np.linalg.solve(np.linalg.cholesky(Q), errors.T)
    assert abs(whitened.var() - 1.0) < 0.05
    assert abs((seen - states @ H.T).std() - bootstrap.SEEN) < 0.05 * bootstrap.SEEN


def test_the_import_bench_names_the_heaviest_modules(capsys):
    main(["--quick", "--json", "--only", "import"])
    row, declared, first = json.loads(capsys.readouterr().out)["rows"]
    modules = row["details"]["heaviest_modules"]
    assert (row["bound"], first["bound"]) == ("ours < 0.06 s", "ours <= 0.5 s")
    assert 0.0 < row["ours"] < declared["ours"] < first["ours"]  # each does what the one before did, and more
    assert row["details"]["bare_process_s"] > 0.0
    assert len(modules) == 15
    times = [m["own_ms"] for m in modules]
    assert times == sorted(times, reverse=True)


def test_every_module_that_an_import_brings_is_weighed():
    names = {m["module"] for m in imports.heaviest("flowgraph.language.graph", 10_000)}
    assert {"flowgraph", "flowgraph.language.graph", "numpy"} <= names


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


@pytest.mark.slow
def test_devices_are_compared_by_their_answers_too(capsys):
    pytest.importorskip("jax")
    rows = gpu.main(["--particles", "50", "--seconds", "0.3", "--repeats", "1", "--json"])
    assert json.loads(capsys.readouterr().out)["rows"] == rows
    assert rows[0]["device"] == "cpu"
    for row in rows:
        assert row["us_per_tick"] > 0.0
        assert row["position_difference_rms_m"] < 1e-4
        assert row["decisions"] > 0
