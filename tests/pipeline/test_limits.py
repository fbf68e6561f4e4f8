"""A block may say in which kinds of number it must not be computed: every way to run it then refuses."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    LoweringError,
    Pipeline,
    Scalar,
    Stream,
    UnknownNameError,
    block,
    graph,
    lower,
    simulate,
    simulate_many,
)
from flowgraph.language.block import Limit

TIMES = np.arange(3, dtype=np.int64) * 1_000_000
INPUTS: Any = {"a": (TIMES, np.arange(3.0))}


@block
def tiny(x: Scalar, *, step: float) -> Scalar:
    """A difference quotient, which a small step ruins."""
    return ((x + step) ** 2 - x**2) / step


@tiny.limited
def _(*, step: float) -> list[Limit]:
    if step >= 1e-3:
        return []
    return [Limit(("float32", "fixed"), "the step drowns", "step >= 1e-3", f"step={step}", "write step=0.1")]


@graph
def slope(a: Stream[Scalar], *, step: float = 0.1):
    return tiny(a, step=step, name="quotient")


REFUSED = (
    r"^quotient: the step drowns\n  expected: step >= 1e-3\n  got:      step=1e-06\n  fix: +write step=0.1$"
)


@pytest.mark.parametrize("dtype", ["float32", "fixed"])
def test_lowering_refuses_the_kind_of_number_with_the_reason(dtype):
    built = slope.build(step=1e-6)
    assert lower(built) is lower(built, dtype="float64")
    with pytest.raises(LoweringError, match=REFUSED):
        lower(built, dtype=dtype)
    assert lower(slope.build(), dtype=dtype).limits == ()


@pytest.mark.parametrize("engine", ["reference", "xla"])
def test_every_run_refuses_it_too(engine):
    if engine == "xla":
        pytest.importorskip("jax")
    built = slope.build(step=1e-6)
    for run in (simulate, partial(simulate_many, seeds=[1, 2])):
        with pytest.raises(LoweringError, match=REFUSED):
            run(built, INPUTS, engine=engine, dtype="float32")
    assert len(simulate(built, INPUTS, engine=engine).output) == 3
    assert len(simulate(slope.build(), INPUTS, engine=engine, dtype="float32").output) == 3


def test_a_pipeline_that_was_saved_still_refuses_it(tmp_path):
    lower(slope.build(step=1e-6)).save(tmp_path)
    found = Pipeline.load(tmp_path)
    assert found.limits == lower(slope.build(step=1e-6)).limits
    assert len(found.run(INPUTS).output) == 3
    with pytest.raises(LoweringError, match=REFUSED):
        found.run(INPUTS, dtype="float32")


def test_a_description_without_limits_is_read():
    data = lower(slope.build()).to_json()
    assert data.pop("limits") == []
    assert Pipeline.from_json(data).limits == ()


def test_another_kind_of_number_is_unknown():
    with pytest.raises(UnknownNameError, match="no dtype is called 'float16'"):
        lower(slope.build(), dtype="float16")


def test_the_command_lowers_for_a_kind_of_number(tmp_path):
    from typer.testing import CliRunner

    from flowgraph.cli import app

    arguments = ["lower", "ukf", "-o", str(tmp_path / "out"), "--set", "alpha=0.01", "--set", "duration=1"]
    refused = CliRunner().invoke(app, [*arguments, "--dtype", "float32"])
    assert refused.exit_code != 0
    assert "alpha >= 0.1 in float32 or fixed point" in refused.output
    assert not (tmp_path / "out").exists()
    assert CliRunner().invoke(app, arguments).exit_code == 0
