"""A case of a filter on an inertial unit and a motion capture, which begins where the capture first sees it.

Filters without biases have it in common: they start at the capture's first pose and at rest, and are told the
noise of both sensors, where the capture's markers sit, and what the unit's readings stand for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flowgraph import Case, Result, Stream
from flowgraph.blocks.kalman.smoothing import Smoothing
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.recordings import pose_recording
from flowgraph.blocks.scoring.cases import OnFlight, PoseFilter
from flowgraph.blocks.scoring.start import StartPose
from flowgraph.blocks.scoring.tuning import reading_of, unbiased_factors
from flowgraph.blocks.signals import Gaussian

__all__ = ["on_capture"]


def on_capture(
    on: OnFlight,
    filter: PoseFilter,
    *,
    start: Callable[..., Any],
    believed: Callable[[Any], Gaussian],
    steps: Callable[[Result], Smoothing] | None = None,
    begin: Callable[..., dict[str, Stream[Any]]] | None = None,
    **settings: Any,
) -> Case:
    """A filter without biases on `imu` and `vicon`, at the capture's first pose and at rest.

    Args:
        on: with both streams.
        filter: its factors, where they are left out, are those of `unbiased_factors`.
        start: `(position, attitude)`, makes what the graph starts from.
        believed: of that, the belief over position, velocity and attitude.
        steps: what a smoother needs of a result.
        begin: that of `Case`, where nothing else is told of the start.
        settings: of the graph itself.
    """
    vicon, info = on.inputs["vicon"], on.flight.info
    pose = filter.pose(on, on.inputs, position=vicon, attitude=vicon, usual="file")
    begun = _started(start, pose)
    known: dict[str, Any] = {
        "noise": filter.imu_noise(on, unbiased_factors(on.name, on.flight)),
        **filter.measured(on),
        "lever": tuple(info.get("vicon_lever", (0.0, 0.0, 0.0))),
        "reading": reading_of(on.flight),
        "gravity": on.gravity,
        "held": filter.held(on, pose.inputs["imu"]),
    }

    recording = pose_recording(pose.inputs, start=believed(begun), **known)
    return on.case(
        filter.score(on, pose_errors, steps=steps, recording=recording),
        inputs=pose.inputs,
        begin=None if pose.told else begin,
        start=begun,
        **known,
        **filter.gating(),
        **settings,
    )


def _started(start: Callable[..., Any], pose: StartPose) -> Any:
    """What the graph starts from; with a heading of which nothing is known, as wide about all axes."""
    more = {} if pose.heading is None else {"attitude_deviation": pose.heading}
    return start(pose.position, pose.attitude, **more)
