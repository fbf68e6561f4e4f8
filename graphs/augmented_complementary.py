"""The asynchronous augmented complementary filter (AACF): position and velocity as well as attitude.

Fast and right for a moment, the IMU is integrated at its own rate; slow and right on average, a motion
capture corrects what has drifted, when it comes:

    each tick    q' = q * Exp(w dt)          v' = v + a dt         p' = p + v dt + a dt^2/2,    a = R(q) f + g
    each pose    p = alpha p- + (1 - alpha) z        q = q- * Exp((1 - alpha_q) Log(q-^-1 q_z))
                 v = v- + (1 - alpha_v) ((z - z_last) - (p- - p_last)) / dt_pose

The shares are of a pose, not of a tick: rates may be any, and vary. There is no covariance; the shares stand
for it and are set by hand.

Source: R. Fiszel, thesis (2017), section on the asynchronous augmented complementary filter (in scala-flow:
AugmentedComplementaryFilter). Three things are mended. The thesis adds the accelerometer to the velocity in
body coordinates, without R_b2f. Its accelerometer knows no gravity; a real one reads specific force, and
gravity is put back. And its (z - z_last) / dt, a mean velocity that is half an interval late, is compared
with the filter's own mean over the same interval, not with its velocity now.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Case, Flight, Result, Stream, delay, graph, latest, merge, timing_of
from flowgraph.blocks.complementary import check_alpha, correct_by_pose, dead_reckon, needed
from flowgraph.blocks.inertial import GRAVITY
from flowgraph.blocks.metrics import pose_errors
from flowgraph.blocks.signals import Imu, Pose, PoseEstimate


@graph
def augmented_complementary(
    imu: Stream[Imu],
    vicon: Stream[Pose],
    *,
    start: PoseEstimate,
    alpha: float = 0.4,
    velocity_alpha: float = 0.6,
    attitude_alpha: float = 0.85,
    gravity: tuple[float, float, float] = GRAVITY,
):
    """Complementary filter of pose and velocity: an IMU for what is fast, a motion capture for what is slow.

    The three shares are the IMU's, of position, velocity and attitude, at each pose; 1 is the IMU alone.
    Collected: `pose` at every tick.
    """
    previous = delay(start, name="previous")
    control = latest(imu, init=Imu.at_rest(), name="control")
    prior = dead_reckon(previous, control, gravity=gravity, at=imu | vicon)
    corrected = correct_by_pose(
        latest(prior, at=vicon),
        vicon,
        alpha=alpha,
        velocity_alpha=velocity_alpha,
        attitude_alpha=attitude_alpha,
    )
    pose = merge(corrected, prior, tie="left", name="now")
    previous.feed(pose)
    return {"pose": pose}


@augmented_complementary.on_flight
def for_flight(
    flight: Flight,
    *,
    alpha: float = 0.4,
    velocity_alpha: float = 0.6,
    attitude_alpha: float = 0.85,
    settle: float = 1.0,
) -> Case:
    """Start the filter on a flight with an IMU and a motion capture, at the first measured pose, at rest.

    Args:
        flight: with the streams `imu` and `vicon` (Pose).
        alpha, velocity_alpha, attitude_alpha: the IMU's shares at each pose, in (0, 1].
        settle: seconds at the start that the errors leave out.
    """
    check_alpha("augmented_complementary", alpha, velocity_alpha, attitude_alpha)
    inputs = needed("augmented_complementary", flight, dict(flight.streams), "imu", "vicon")
    vicon = inputs["vicon"]
    clocks: dict[str, Any] = {name: timing_of(series) for name, series in inputs.items()}
    built = augmented_complementary.build(
        **clocks,
        start=PoseEstimate(
            position=vicon["position"][0], velocity=np.zeros(3), attitude=vicon["attitude"][0]
        ),
        alpha=alpha,
        velocity_alpha=velocity_alpha,
        attitude_alpha=attitude_alpha,
    )
    truth = flight.truth

    def score(result: Result) -> dict[str, float]:
        return {} if truth is None else pose_errors(result["pose"], truth, settle=settle)

    return Case(built, inputs, score, estimate="pose")
