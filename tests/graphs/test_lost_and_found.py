"""Filters that lose track: gates that shut, controls that do not come, and how they find back."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import Flight, Series, find_graph, load_flight, simulate

GATED = ("ins_eskf", "ekf", "ukf", "ins_ekf_pose", "ins_ukf_pose")
"""Filters of a pose that can refuse a measurement."""


@cache
def flight(duration: float = 6.0, seed: int = 1) -> Flight:
    return load_flight("sim", seed=seed, settings={"duration": str(duration)})


def with_stream(base: Flight, name: str, series: Series) -> Flight:
    return replace(base, streams={**base.streams, name: series})


def changed(series: Series, **fields: Any) -> Series:
    """The series with other values in some of its fields."""
    values = {n: np.array(getattr(series.values, n)) for n in series.values._fields} | fields
    return Series(series.time, type(series.values)(**values), name=series.name)


def outliers(base: Flight, rows: slice, by: float) -> Flight:
    """The flight with poses that are off by `by` metres in some rows."""
    position = np.array(base.streams["vicon"]["position"])
    position[rows] += by
    return with_stream(base, "vicon", changed(base.streams["vicon"], position=position))


def refused(score: dict[str, float]) -> float:
    return sum(value for key, value in score.items() if key.endswith("nis_rejected"))


@pytest.mark.parametrize("name", GATED)
@pytest.mark.parametrize("wrong", [1, 3])
def test_the_count_of_refusals_is_that_of_the_run(name, wrong):
    made = outliers(flight(), slice(-wrong, None), 30.0)
    case = find_graph(name).case(made, gate=0.9999999)
    assert refused(case.score(simulate(case.graph, case.inputs))) == wrong
    open_ = find_graph(name).case(made)
    assert refused(open_.score(simulate(open_.graph, open_.inputs))) == 0.0


def test_a_count_knows_of_positions_and_attitudes_apart():
    base = flight()
    q = np.array(base.streams["vicon"]["attitude"])
    q[-2:] = q[-2:][:, [1, 0, 3, 2]]  # half a turn
    made = with_stream(base, "vicon", changed(base.streams["vicon"], attitude=q))
    case = find_graph("ins_eskf").case(made, gate=0.9999999)
    score = case.score(simulate(case.graph, case.inputs))
    assert (score["position_nis_rejected"], score["attitude_nis_rejected"]) == (0.0, 2.0)
