"""What `outdoor_eskf` was given, as a batch estimate takes it: a motion over pose and clone, and its sensors.

The clone is the pose at the last picture, so the motion has a part that is no motion: a step that begins at a
picture first makes the pose of then the clone. That a picture was taken is therefore told with the readings
of the IMU that drive the step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph import Array, Series
from flowgraph.blocks.filtering.batch import Aged, Derived, Recording
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.models.recordings import drive_at
from flowgraph.blocks.outdoor.belief import (
    FLOW,
    FieldObserver,
    PositionObserver,
    clone_transition,
    observe_distance,
    observe_flow,
    outdoor_space,
    picture_taken,
    predict_clone,
)
from flowgraph.blocks.outdoor.flight import OutdoorSensors
from flowgraph.blocks.signals import CloneDrive, Gaussian, Imu
from flowgraph.blocks.statespace import Measurement, MeasurementModel

__all__ = ["outdoor_recording"]


def outdoor_recording(
    inputs: Mapping[str, Series], *, start: Gaussian, sensors: OutdoorSensors, reading: str,
    held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `outdoor_eskf` is given: `imu`, and any of the sensors; over the space of the start."""
    space, size = outdoor_space(start.mean), start.covariance.shape[-1]
    imu, flow = inputs["imu"], inputs.get("optical_flow")

    def drive(time: np.ndarray) -> Series:
        driven = drive_at(time, imu, reading)
        taken = np.zeros(len(time)) if flow is None else np.isin(time, flow.time).astype(float)
        began = np.concatenate([[0.0], taken[:-1]])
        return driven.holding(CloneDrive(driven["gyro"], driven["specific_force"], began))

    def linearised(x: Array, drive: CloneDrive, dt: Any, xp: Any) -> tuple[Array, Array, Array]:
        taken = drive.picture > 0.5
        cloned, T = picture_taken(x, xp)
        x, T = xp.where(taken, cloned, x), xp.where(taken, T, xp.eye(size, dtype=x.dtype))
        step = Imu(gyro=drive.gyro, specific_force=drive.specific_force)
        exactly = Gaussian(mean=x, covariance=xp.zeros((size, size), dtype=x.dtype))
        after = predict_clone.step(exactly, step, noise=sensors.imu, dt=dt, xp=xp)
        return after.mean, clone_transition(x, step, dt, xp) @ T, after.covariance

    places = {"position": 0, "velocity": 3, "attitude": 6}
    aged = None if held is None else Aged(imu, held, places)
    seen = {model: inputs[name] for name, model in _models(sensors, space).items() if name in inputs}
    longest = None if held is None else held.longest
    return Recording(Derived(space, linearised), seen, start, drive, longest, aged)


def _models(s: OutdoorSensors, space: StateSpace) -> dict[str, Measurement]:
    """What each sensor that is there sees, as the filter takes it."""
    found: dict[str, Measurement] = {}
    for name, noise, lever in (("gps", s.gps, s.gps_lever), ("gps2", s.gps2, s.gps2_lever)):
        if noise is not None:
            place = PositionObserver(lever)
            found[name] = MeasurementModel(space, place, np.repeat(noise**2, 3))
    if s.magnetometer is not None:
        field, tesla = FieldObserver(s.field, s.magnetometer), s.magnetometer
        found["magnetometer"] = MeasurementModel(space, field, np.ones(3), read=lambda z: z.field / tesla)
    if s.altimeter is not None:
        read = lambda z: z.distance[..., None]
        found["altimeter"] = MeasurementModel(space, observe_distance, [s.altimeter**2], read=read)
    if s.displacement is not None and s.turn is not None:
        found["optical_flow"] = MeasurementModel(
            space, observe_flow, np.repeat(np.square([s.displacement, s.turn]), 3),
            measured_space=FLOW, read=lambda z: (z.displacement, z.turn),
        )  # fmt: skip
    return found
