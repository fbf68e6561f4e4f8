"""A flight whose measurements come late: they are taken for fresh and it is said, or they are rewound."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from flowgraph import DeclarationError, LoweringError, Series, find_graph, load_flight, simulate
from flowgraph.blocks.scoring.late import late_streams, places

FLOWN = {"duration": "4", "imu.rate": "100", "vicon.rate": "10"}


def ran(graph: str, late: str | None = None, **settings: Any) -> tuple[dict[str, float], Any, Any]:
    given = {**FLOWN, **({"vicon.latency": late} if late else {})}
    case = find_graph(graph).case(load_flight("sim", seed=2, settings=given), **settings)
    result = simulate(case.graph, case.inputs)
    return case.score(result), case, result


def test_a_late_capture_is_taken_for_fresh_and_said():
    score, case, _ = ran("ins_eskf", "0.12")
    on_time, plain, _ = ran("ins_eskf")
    assert score["position_rmse_m"] > 5 * on_time["position_rmse_m"]
    (said,) = [n for n in case.notes if "late by" in n]
    assert said.startswith("warning: ")
    assert "rewind=0.12" in said
    assert not [n for n in plain.notes if "late" in n]


def test_the_rewind_that_the_note_names_is_long_enough():
    _, case, _ = ran("ins_eskf", "0.123456")
    (said,) = [n for n in case.notes if "late by" in n]
    assert "rewind=0.124" in said
    _, again, result = ran("ins_eskf", "0.123456", rewind=0.124)
    assert result.stats["rewind/late.late_refused"] == 0
    assert not any("older than the history" in n for n in again.remarks(result))


def test_what_is_older_than_the_history_is_a_note():
    _, case, result = ran("ins_eskf", "0.12", rewind=0.05)
    refused = result.stats["rewind/late.late_refused"]
    assert refused > 0
    assert any(n.startswith(f"refused: {refused} late values were older") for n in case.remarks(result))


def test_rewound_it_is_nearly_as_good_as_on_time():
    fresh, _, _ = ran("ins_eskf", "0.12")
    found, case, result = ran("ins_eskf", "0.12", rewind=0.2)
    on_time, _, _ = ran("ins_eskf")
    assert found["position_rmse_m"] < 2.0 * on_time["position_rmse_m"] < 0.5 * fresh["position_rmse_m"]
    assert 0.5 < found["position_nis_mean"] < 1.6
    assert (
        found["position_nis_count"] == result.stats["rewind/late.late_applied"] / 2
    )  # position and attitude
    assert any(n.startswith("info: position, attitude: late by up to 0.12 s") for n in case.notes)


def test_without_a_late_stream_the_setting_changes_nothing():
    asked, case, _ = ran("ins_eskf", rewind=0.2)
    plain, same, _ = ran("ins_eskf")
    assert asked == plain
    assert len(case.graph.nodes) == len(same.graph.nodes)


@pytest.mark.parametrize("graph", ["ekf", "ins_ekf_pose"])
def test_other_gaussian_filters_are_rewound_too(graph):
    fresh, _, _ = ran(graph, "0.12")
    found, _, result = ran(graph, "0.12", rewind=0.2)
    assert found["position_rmse_m"] < 0.5 * fresh["position_rmse_m"]
    assert result.stats["rewind/late.late_refused"] == 0


def test_particles_and_smoothers_say_that_they_cannot():
    with pytest.raises(LoweringError, match="draws random numbers"):
        ran("rbpf_indoor", "0.12", rewind=0.2, particles=10)
    with pytest.raises(DeclarationError, match="a run that is rewound is not smoothed"):
        ran("ekf", "0.12", rewind=0.2, smooth="rts")


def test_places_are_counted_over_the_stamps():
    a = Series(np.arange(10) * 10, np.zeros(10))
    b = Series(np.arange(10) * 10 + 53, np.zeros(10), stamp=np.arange(10) * 10 + 3)
    given: Mapping[str, Series] = {"a": a, "b": b}
    assert late_streams(given) == ["b"]
    assert places(given, 20) == 5 + 4
