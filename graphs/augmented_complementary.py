"""The asynchronous augmented complementary filter (AACF): position and velocity as well as attitude.

Fast and right for a moment, the IMU is integrated at its own rate; slow and right on average, a motion
capture corrects what has drifted, when it comes:

    each tick    q' = q * Exp(w dt)          v' = v + a dt         p' = p + v dt + a dt^2/2,    a = R(q) f + g
    each pose    p = alpha p- + (1 - alpha) z        q = q- * Exp((1 - alpha_q) Log(q-^-1 q_z))
                 v = v- + (1 - alpha_v) ((z - z_last) - (p- - p_last)) / dt_pose

The shares are of a pose, not of a tick: rates may be any, and vary. They stand for a covariance, and are set
by hand; how large the errors are that they leave can be asked for (`blocks/orientation/fixed_gain.py`).

Source: R. Fiszel, thesis (2017), section on the asynchronous augmented complementary filter (in scala-flow:
AugmentedComplementaryFilter). Three things are mended. The thesis adds the accelerometer to the velocity in
body coordinates, without R_b2f. Its accelerometer knows no gravity; a real one reads specific force, and
gravity is put back. And its (z - z_last) / dt, a mean velocity that is half an interval late, is compared
with the filter's own mean over the same interval, not with its velocity now.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph, latest, merge
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.kalman.lost import stay
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.orientation.complementary import correct_by_pose, dead_reckon
from flowgraph.blocks.orientation.fixed_gain import PoseNoise, pose_spread
from flowgraph.blocks.scoring.cases import OnFlight, PoseNoises, Scored, on_flight
from flowgraph.blocks.scoring.orientation import Share
from flowgraph.blocks.scoring.start import Started
from flowgraph.blocks.scoring.tuning import given, imu_noise_of, reading_of, with_imu
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
    reading: str = "instant",
    covariance: PoseNoise | None = None,
    longest: float | None = None,
):
    """Complementary filter of pose and velocity: an IMU for what is fast, a motion capture for what is slow.

    The three shares are the IMU's, of position, velocity and attitude, at each pose; 1 is the IMU alone.
    A `reading` of the IMU is of an "instant", or the "mean" over the time since the one before.
    Collected: `pose` at every tick; with the noise of a `covariance`, `belief` too.
    """
    previous = delay(start, name="previous")
    control = latest(imu, init=Imu.at_rest(gravity), name="control")
    prior = dead_reckon(previous, control, gravity=gravity, reading=reading, at=imu | vicon)
    if longest is not None:
        prior = stay(previous, prior, longest=longest)
    shares = {"alpha": alpha, "velocity_alpha": velocity_alpha, "attitude_alpha": attitude_alpha}
    corrected = correct_by_pose(latest(prior, at=vicon), vicon, **shares)
    pose = merge(corrected, prior, tie="left", name="now")
    previous.feed(pose)
    if covariance is not None:
        collect(pose_spread(previous, control, pose, vicon, noise=covariance, **shares), "belief")
    return {"pose": pose}


_UNSMOOTHED = (
    "its gains are set by hand, so nothing says how much of a later correction belongs to an earlier time"
)


@on_flight(augmented_complementary, "imu", "vicon", told=with_imu, measured=None, unsmoothed=_UNSMOOTHED)
def for_flight(
    on: OnFlight,
    *,
    alpha: Share = 0.4,
    velocity_alpha: Share = 0.6,
    attitude_alpha: Share = 0.85,
    covariance: bool = False,
    pose: PoseNoises,
    scored: Scored,
    started: Started,
) -> Case:
    """Start the filter on a flight with an IMU and a motion capture, at the first measured pose, at rest.

    Args:
        flight: with the streams `imu` and `vicon` (Pose). In place of `imu` it may have the thesis's unit:
            `gyro` and `coordinate_acceleration`, with the same times.
        alpha, velocity_alpha, attitude_alpha: the IMU's shares at each pose, in (0, 1].
        covariance: whether to give one too, and score it.
        position_noise, attitude_noise: standard deviations in m and rad, for the covariance; the flight's own
            if left out.
    """
    vicon, noise = on.inputs["vicon"], None
    begin = started.pose(on, on.inputs, position=vicon, attitude=vicon, usual="file", deviates=covariance)
    if covariance:
        place = on.noise("position_noise", pose.position_noise)
        turn = on.noise("attitude_noise", pose.attitude_noise)
        noise = PoseNoise(
            imu_noise_of(on.name, on.flight), place, turn, start=(place, 0.7, given(begin.heading, turn))
        )
    return on.case(
        scored.score(on, pose_errors, estimate="belief" if covariance else "pose"),
        inputs=begin.inputs,
        start=PoseEstimate(position=begin.position, velocity=np.zeros(3), attitude=begin.attitude),
        alpha=alpha,
        velocity_alpha=velocity_alpha,
        attitude_alpha=attitude_alpha,
        gravity=on.gravity,
        covariance=noise,
        longest=on.longest(),
        reading=reading_of(on.flight),
    )
