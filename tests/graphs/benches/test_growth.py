"""The bench of growth: a run a process, exponents of what is known, and its picture."""

from __future__ import annotations

import pytest

from flowgraph import DeclarationError
from flowgraph.graphs.benches import growth as module
from flowgraph.graphs.benches.growth import growth


def test_exponents_are_those_of_what_grew(monkeypatch, tmp_path):
    """Times that are quadratic, memory that is linear; nothing is run."""

    def apart(of, mode, engine, number, duration):
        found = {"seconds": 1e-6 * number**2, "memory_bytes": 0 if mode == "streamed" else 10_000 * number}
        return {"engine": engine, "of": of, "mode": mode, "number": number, **found}

    monkeypatch.setattr(module, "_apart", apart)
    report = growth(engines="c", least=1000, most=100_000, most_particles=1000)
    fits = {(r["of"], r["mode"]): r for r in report.rows if r["number"] is None}
    assert set(fits) == {("ticks", "whole"), ("ticks", "streamed"), ("particles", "whole")}
    assert all(fit["time_exponent"] == pytest.approx(2.0) for fit in fits.values())
    assert fits["ticks", "whole"]["memory_exponent"] == pytest.approx(1.0)
    assert fits["ticks", "streamed"]["memory_exponent"] is None
    assert [r["number"] for r in report.rows if r["of"] == "particles" and r["number"]] == [10, 100, 1000]
    report.figures["growth.svg"](tmp_path / "growth.svg")
    assert (tmp_path / "growth.svg").stat().st_size > 5000


def test_a_run_in_a_process_of_its_own_is_timed_and_weighed():
    """A recording of 300,000 ticks and its results take 4.8 MB and more; the run is not free."""
    row = module._apart("ticks", "whole", "python", 300_000, 0.0)
    assert row["memory_bytes"] > 4_800_000
    assert 0.001 < row["seconds"] < 60.0


def test_numbers_that_leave_nothing_are_refused():
    with pytest.raises(DeclarationError, match="no number between"):
        growth(least=100, most=10)
