"""outdoor_eskf: an error-state Kalman filter on the outdoor sensors, each whenever it comes.

What `rbpf_outdoor` is measured against: the same streams, the same knowledge of them, and one Gaussian in
place of particles. Every tick predicts to now with the IMU; each sensor that is present then corrects, one
after the other. Optical flow measures from a clone of the pose at the last picture.

Sources: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017; S. I.
Roumeliotis and J. W. Burdick, "Stochastic cloning", ICRA 2002. The equations stand in
`blocks/outdoor/belief.py`.
"""

from __future__ import annotations

import functools
import operator
from typing import Any

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph, latest
from flowgraph.blocks.kalman.backward import collect_steps
from flowgraph.blocks.kalman.filters import update_extended
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.pose import driving
from flowgraph.blocks.outdoor.belief import (
    FLOW,
    OUTDOOR,
    FieldObserver,
    PositionObserver,
    clone_crossing,
    flow_vector,
    new_picture,
    observe_distance,
    observe_flow,
    outdoor_navigation,
    outdoor_pose,
    outdoor_space,
    outdoor_steps,
    picture_cross,
    predict_clone,
    start_outdoor,
)
from flowgraph.blocks.outdoor.flight import OutdoorSensors
from flowgraph.blocks.outdoor.recording import outdoor_recording
from flowgraph.blocks.scoring.cases import Adapted, HeldControl, OnFlight, Smoothed, on_flight
from flowgraph.blocks.scoring.outdoor_start import StartedOutdoor
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.blocks.signals import Gaussian, Imu, MagneticField, OpticalFlow, Position, Range


@graph
def outdoor_eskf(
    imu: Stream[Imu],
    gps: Stream[Position] | None = None,
    gps2: Stream[Position] | None = None,
    altimeter: Stream[Range] | None = None,
    magnetometer: Stream[MagneticField] | None = None,
    optical_flow: Stream[OpticalFlow] | None = None,
    *,
    start: Gaussian,
    sensors: OutdoorSensors,
    reading: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
    smoothing: bool = False,
):
    """Error-state Kalman filter of pose and velocity, with a clone of the pose at the last picture.

    Of the sensors beside the IMU any are there. With a `start` that has them (`start_outdoor`) the biases of
    the IMU are estimated too. A `reading` of the IMU is of an "instant", or the "mean" over
    the time since the one before (`driving`).
    Collected: `belief` at every tick, and the innovation of each sensor where there was a reading;
    with `smoothing` what a smoother needs too.
    """
    s, space = sensors, outdoor_space(start.mean)
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    aids = [aid for aid in (gps, gps2, altimeter, magnetometer, optical_flow) if aid is not None]
    ticks = functools.reduce(operator.or_, aids, imu)
    control = latest(imu, init=Imu.at_rest(), at=ticks, name="control")
    drive = driving(last, control, reading)
    now = predict_clone(belief, drive, noise=s.imu, name="predict")
    now = bridged(belief, now, imu, held=held, position=0, velocity=3, attitude=6)
    if smoothing:
        taken = delay(start, name="taken")
        collect_steps(taken, now, drive, crossing=clone_crossing, held=held)

    scales: dict[str, Any] = {}

    def trust(name: str) -> dict[str, Any]:
        scales[name] = scale_of(adaptive, name)
        return {"gate": gate, "robust": robust, "scale": scales[name]}

    def told(now: Stream[Gaussian], innovation: Any, name: str) -> Stream[Gaussian]:
        feed_scale(scales[name], innovation, adaptive, name)
        collect(innovation, f"{name}_innovation")
        if gate is None:
            return now
        lost: dict[str, Any] = {"moving": 9, "attitude": 6, "shown": name == "optical_flow"}
        if name == "magnetometer":
            lost = {"moving": (6, 9), "attitude": 6}
        return find_back(now, innovation, patience=patience, name=f"find_back_{name}", **lost)

    def fused(now: Stream[Gaussian], seen: Any, name: str, block: str, **sees: Any) -> Stream[Gaussian]:
        now, innovation = update_extended(now, seen, space=space, name=block, **trust(name), **sees)
        return told(now, innovation, name)

    for name, seen, lever in (("gps", gps, s.gps_lever), ("gps2", gps2, s.gps2_lever)):
        if seen is not None:
            R, place = np.eye(3) * s.noise(name) ** 2, seen.map(lambda z: z.position)
            now = fused(now, place, name, f"fuse_{name}", observe=PositionObserver(lever), R=R)
    if magnetometer is not None:
        tesla = s.noise("magnetometer")
        seen = magnetometer.map(lambda z: z.field / tesla)
        sees = FieldObserver(s.field, tesla)
        now = fused(now, seen, "magnetometer", "fuse_magnetometer", observe=sees, R=np.eye(3))
    if altimeter is not None:
        seen, R = altimeter.map(lambda z: z.distance[..., None]), np.eye(1) * s.noise("altimeter") ** 2
        now = fused(now, seen, "altimeter", "fuse_altimeter", observe=observe_distance, R=R)
    if optical_flow is not None:
        R = np.diag(np.repeat(np.square([s.noise("displacement"), s.noise("turn")]), 3))
        now = fused(
            now, optical_flow.map(flow_vector), "optical_flow", "fuse_flow", observe=observe_flow, R=R,
            measured_space=FLOW,
        )  # fmt: skip
    if smoothing:  # what is smoothed has the clone that its readings were measured from
        collect(now, "posterior")
        taken.feed(now if optical_flow is None else picture_cross(now, optical_flow, name="picture_cross"))
    if optical_flow is not None:
        now = new_picture(now, optical_flow, name="picture")
    last.feed(control)
    belief.feed(now)
    return {"belief": outdoor_pose(now) if space is OUTDOOR else outdoor_navigation(now)}


@on_flight(outdoor_eskf)
def for_flight(
    on: OnFlight, *, gated: Adapted, control: HeldControl, started: StartedOutdoor, scored: Smoothed
) -> Case:
    """Start the filter on an outdoor flight, at rest, and at its first readings if nothing else is set.

    Args:
        flight: with the streams and the knowledge that `outdoor_flight` asks for.
    """
    inputs, sensors, first = started.begin(on)
    known: dict[str, Any] = {
        "start": start_outdoor(first, biases=started.estimates(on)),
        "sensors": sensors,
        "reading": reading_of(on.flight),
        "held": control.held(on, inputs["imu"], inputs),
    }
    recording = outdoor_recording(inputs, **known)
    score = scored.score(on, pose_errors, steps=outdoor_steps, recording=recording)
    return on.case(score, inputs=inputs, smoothing=scored.smoothed, **known, **gated.gating())
