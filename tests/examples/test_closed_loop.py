"""The quadrotor that is flown on its filter's own estimate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.examples.test_examples import run
from tests.support import same

ENGINES = ("reference", "xla", "c")


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    return run("closed_loop")


@pytest.mark.slow
def test_it_comes_to_its_corners_and_less_well_the_later_its_poses_are(example) -> None:
    runs = {name: example["flown"](engine="c", **kind) for name, kind in example["KINDS"].items()}
    truth, own, late, later = (float(r["away"].value[-1]) for r in runs.values())
    assert truth < own < late < later, "the estimate is worse than the truth, and an old one worse still"
    assert own < 0.1
    assert later > 4.0 * own
    wrong = [float(r["score"]["position_rmse_m"][0]) for r in runs.values()]
    assert wrong[1] == pytest.approx(wrong[0], rel=0.2), "steering by the estimate does not make it worse"
    assert wrong[3] > 10.0 * wrong[1]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_every_engine_flies_the_same_flight(example, engine: str) -> None:
    short = {"seconds": 1.2, "latency": 3, "seed": 5}
    want = example["flown"](engine="python", **short)
    same(want, example["flown"](engine=engine, **short), exact=engine == "reference")
    assert np.ptp(want["motion"]["position"], axis=0).max() > 0.03


@pytest.mark.slow
def test_it_draws_a_picture(example, tmp_path) -> None:
    kinds = {
        name: example["flown"](engine="c", seconds=2.5, **kind) for name, kind in example["KINDS"].items()
    }
    example["draw"](kinds, tmp_path / "loop.png")
    assert (tmp_path / "loop.png").stat().st_size > 10_000
