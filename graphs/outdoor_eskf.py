"""outdoor_eskf: an error-state Kalman filter on the outdoor sensors, each whenever it comes.

What `rbpf_outdoor` is measured against: the same streams, the same knowledge of them, and one Gaussian in
place of particles. Every tick predicts to now with the IMU; each sensor that is present then corrects, one
after the other. Optical flow measures from a clone of the pose at the last picture.

Sources: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017; S. I.
Roumeliotis and J. W. Burdick, "Stochastic cloning", ICRA 2002. The equations stand in
`blocks/outdoor/belief.py`.
"""

from __future__ import annotations

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
    outdoor_pose,
    outdoor_steps,
    picture_cross,
    predict_clone,
    start_outdoor,
)
from flowgraph.blocks.outdoor.flight import OutdoorSensors
from flowgraph.blocks.scoring.cases import Adapted, HeldControl, OnFlight, Smoothed, on_flight
from flowgraph.blocks.scoring.outdoor_start import StartedOutdoor
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.blocks.signals import Gaussian, Imu, MagneticField, OpticalFlow, Position, Range


@graph
def outdoor_eskf(
    imu: Stream[Imu],
    gps: Stream[Position],
    gps2: Stream[Position],
    altimeter: Stream[Range],
    magnetometer: Stream[MagneticField],
    optical_flow: Stream[OpticalFlow],
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

    A `reading` of the IMU is of an "instant", or the "mean" over the time since the one before (`driving`).
    Collected: `belief` at every tick, and the innovation of each sensor where there was a reading;
    with `smoothing` what a smoother needs too.
    """
    s = sensors
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    ticks = imu | gps | gps2 | altimeter | magnetometer | optical_flow
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

    readings: dict[str, tuple[Stream, Any, float]] = {
        "gps": (gps.map(lambda z: z.position), PositionObserver(s.gps_lever), s.gps),
        "gps2": (gps2.map(lambda z: z.position), PositionObserver(s.gps2_lever), s.gps2),
        "magnetometer": (
            magnetometer.map(lambda z: z.field / s.magnetometer), FieldObserver(s.field, s.magnetometer), 1.0,
        ),
    }  # fmt: skip
    for name, (seen, observe, noise) in readings.items():
        R = np.eye(3) * noise**2
        now, innovation = update_extended(
            now, seen, observe=observe, R=R, space=OUTDOOR, name=f"fuse_{name}", **trust(name)
        )
        now = told(now, innovation, name)
    now, innovation = update_extended(
        now, altimeter.map(lambda z: z.distance[..., None]),
        observe=observe_distance, R=[[s.altimeter**2]], space=OUTDOOR, name="fuse_altimeter",
        **trust("altimeter"),
    )  # fmt: skip
    now = told(now, innovation, "altimeter")
    now, innovation = update_extended(
        now, optical_flow.map(flow_vector), observe=observe_flow, name="fuse_flow", measured_space=FLOW,
        R=np.diag([s.displacement**2] * 3 + [s.turn**2] * 3), space=OUTDOOR, **trust("optical_flow"),
    )  # fmt: skip
    now = told(now, innovation, "optical_flow")
    if smoothing:  # what is smoothed has the clone that its readings were measured from
        collect(now, "posterior")
        taken.feed(picture_cross(now, optical_flow, name="picture_cross"))
    now = new_picture(now, optical_flow, name="picture")
    last.feed(control)
    belief.feed(now)
    return {"belief": outdoor_pose(now)}


@on_flight(outdoor_eskf)
def for_flight(
    on: OnFlight, *, gated: Adapted, control: HeldControl, started: StartedOutdoor, scored: Smoothed
) -> Case:
    """Start the filter on an outdoor flight, at rest, and at its first readings if nothing else is set.

    Args:
        flight: with the streams and the knowledge that `outdoor_flight` asks for.
    """
    inputs, sensors, first = started.begin(on)
    score = scored.score(on, pose_errors, steps=outdoor_steps)
    return on.case(
        score,
        inputs=inputs,
        start=start_outdoor(first),
        sensors=sensors,
        reading=reading_of(on.flight),
        smoothing=scored.smoothed,
        held=control.held(on, inputs["imu"], inputs),
        **gated.gating(),
    )
