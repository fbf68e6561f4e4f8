"""The bench of growth: a run a process, exponents of what is known, and its picture."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.graphs.benches import growth as module
from flowgraph.graphs.benches.endurance import memory
from flowgraph.graphs.benches.growth import exponent, growth


def test_exponents_are_those_of_what_grew(monkeypatch, tmp_path):
    """Times that are quadratic beside what each run costs, memory that is linear; nothing is run."""

    def apart(of, mode, engine, number, duration):
        found = {
            "seconds": 0.5 + 1e-6 * number**2,
            "memory_bytes": 0 if mode == "streamed" else 10_000 * number,
        }
        return {"engine": engine, "of": of, "mode": mode, "number": number, **found}

    monkeypatch.setattr(module, "_apart", apart)
    report = growth(engines="c", least=1000, most=1_000_000, most_particles=10_000)
    fits = {(r["of"], r["mode"]): r for r in report.rows if r["number"] is None}
    assert set(fits) == {("ticks", "whole"), ("ticks", "streamed"), ("particles", "whole")}
    assert all(fit["time_exponent"] == pytest.approx(2.0, abs=0.006) for fit in fits.values())
    assert fits["ticks", "whole"]["memory_exponent"] == pytest.approx(1.0)
    assert fits["ticks", "streamed"]["memory_exponent"] is None
    assert [r["number"] for r in report.rows if r["of"] == "particles" and r["number"]] == [
        10, 100, 1000, 10_000
    ]  # fmt: skip
    assert report.notes[0].startswith("info: 11 processes took ")
    parted = growth(engines="c", parts="particles", most_particles=1000)
    assert {row["of"] for row in parted.rows} == {"particles"}
    for name in ("growth.svg", "growth.md"):
        report.figures[name](tmp_path / name)
    assert (tmp_path / "growth.svg").stat().st_size > 5000
    table = (tmp_path / "growth.md").read_text().splitlines()
    assert table[2].startswith("| `c` | ticks | whole | 1,000 | 1,000,000 | 1.5 to 1000000 s | 2.00 ± 0.00 |")
    assert len(table) == 5


def test_a_constant_is_no_growth():
    number = np.array([10.0, 100.0, 1000.0, 10_000.0])
    assert exponent(number, 3.0 + 0.01 * number)[0] == pytest.approx(1.0, abs=0.006)
    assert exponent(number, 2e-6 * number**1.2)[0] == pytest.approx(1.2, abs=0.006)
    assert exponent(number[:3], number[:3])[1] is None


@pytest.mark.parametrize(("constant", "each", "first"), [(0.5, 0.02, 1), (3e-4, 8e-9, 3)])
def test_the_error_of_an_exponent_is_how_far_it_scatters(constant, each, first):
    """Over 200 series with errors of 3 %, the mean of the errors told is the scatter within a third."""
    rng = np.random.default_rng(7)
    number = 10.0 ** np.arange(first, first + 6)
    errors_of = lambda: 1 + 0.03 * rng.normal(size=6)
    found = [exponent(number, (constant + each * number**1.1) * errors_of()) for _ in range(200)]
    powers, errors = np.array(found, float).T
    assert powers.mean() == pytest.approx(1.1, abs=0.01)
    assert 0.66 < errors.mean() / powers.std() < 1.5


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell the peak")
def test_copying_stands_beside_particles():
    row = module._apart("particles", "whole", "python", 1000, 0.05)
    assert 0 < row["copy_s"] < row["seconds"]
    fit = module._fit([{**row, "number": n, "copy_s": 1e-3 * n} for n in (10, 100, 1000)])
    assert fit["copy_exponent"] == pytest.approx(1.0, abs=0.006)
    assert fit["time_error"] is None


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell the peak")
def test_a_run_in_a_process_of_its_own_is_timed_and_weighed():
    """A recording of 300,000 ticks and its results take 4.8 MB and more; the run is not free."""
    row = module._apart("ticks", "whole", "python", 300_000, 0.0)
    assert row["memory_bytes"] > 4_800_000
    assert 0.001 < row["seconds"] < 60.0


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell the peak")
def test_no_engine_grows_faster_than_its_recording():
    """The bench in short: time and memory are linear or better, and streamed memory stays small."""
    report = growth(least=1000, most=1_000_000, least_particles=100, most_particles=10_000)
    for fit in (r for r in report.rows if r["number"] is None):
        assert fit["time_exponent"] < 1.5, fit  # on machines that do other work as well; a square is 2
        assert fit["memory_exponent"] is None or fit["memory_exponent"] < 1.15, fit
    streamed = [r for r in report.rows if r["mode"] == "streamed" and r["number"] == 1_000_000]
    assert len(streamed) == 4
    assert all(r["memory_bytes"] < 100e6 for r in streamed)


def test_numbers_that_leave_nothing_are_refused():
    with pytest.raises(DeclarationError, match="no number between"):
        growth(least=100, most=10)


def test_an_engine_without_ranges_is_refused():
    with pytest.raises(UnknownNameError, match="fortran"):
        growth(engines="c,fortran")
    with pytest.raises(UnknownNameError, match="slice"):
        growth(parts="whole,slice")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other allocators have no such function")
def test_what_an_earlier_run_took_is_given_back():
    """Or the allocator would hand the next run what it has, which would seem to take nothing."""
    before = memory()
    some = [np.ones(12_500) for _ in range(600)]  # too small to be mapped by themselves
    taken = memory() - before
    kept = some[::100]  # what lies below the last of these is not given back unasked
    del some
    module.give_back()
    assert memory() - before < 0.2 * taken
    assert len(kept) == 6
