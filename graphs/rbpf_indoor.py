"""rbpf_indoor: a Rao-Blackwellized particle filter on an IMU and a motion capture.

The attitude is sampled: each particle turns by the gyroscope's reading and a drawn error. Given its attitude,
a particle's velocity and position are Gaussian and have a Kalman filter of their own. A pose measurement
corrects these, and weighs each particle by how likely it was. So the hard, nonlinear part of the state, three
numbers, is all that particles must cover, and a start with an unknown heading is no difficulty.

Source: R. Fiszel's thesis on reactive pose estimation, Stanford 2017; A. Doucet, N. de Freitas, K. Murphy and
S. Russell, "Rao-Blackwellised particle filtering for dynamic Bayesian networks", UAI 2000.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph, latest, merge
from flowgraph.blocks.geometry.rotations import level, to_matrix
from flowgraph.blocks.inertial.alignment import StartSpread, rest_seconds
from flowgraph.blocks.inertial.calibration import subtract_rest_bias
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.lost import PATIENCE, Held, stay
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.pose import driving
from flowgraph.blocks.models.spread import spread_cloud
from flowgraph.blocks.particles.cloud import (
    START_DRAWS,
    attitude_likelihood,
    average_attitude,
    average_pose,
    cloud_at_start,
    cloud_belief,
    dominant_eigenvector,
    effective_sample_size,
    propagate_attitude,
    reweight,
    start_cloud,
    weights,
)
from flowgraph.blocks.particles.lost import believe_pose, depletion, judge_pose, pose_within_reach
from flowgraph.blocks.particles.rao_blackwell import correct_motion, predict_motion
from flowgraph.blocks.particles.resampling import draw_ancestors, take_ancestors
from flowgraph.blocks.scoring.cases import Gated, HeldControl, OnFlight, Particles, PoseAided, on_flight
from flowgraph.blocks.scoring.settings import NotNegative
from flowgraph.blocks.scoring.start import StartPose, turned
from flowgraph.blocks.scoring.tuning import given, reading_of, with_imu
from flowgraph.blocks.signals import Cloud, Imu, Pose

LEVEL = 0.1
"""rad: a body that is tilted by less at the start stands level."""


@graph
def predict(
    cloud: Stream[Cloud],
    imu: Stream[Imu],
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    draws: str,
    at: Any,
):
    """Carry the cloud to now: attitudes drawn through the gyroscope, motion by a Kalman prediction each."""
    turned = propagate_attitude(cloud, imu, gyro_noise=noise.gyro, draws=draws, at=at, name="attitude")
    return predict_motion(
        turned, imu, accelerometer_noise=noise.accelerometer, gravity=gravity, name="kalman"
    )


@graph
def update(
    prior: Stream[Cloud],
    measured: Stream[Pose],
    *,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float],
    gate: float | None,
    patience: int,
    draws: str,
):
    """Correct the cloud with a pose that is believed: likelihood of position times likelihood of attitude."""
    measured = pose_within_reach(measured, name="reach")
    corrected, position = correct_motion(
        prior, measured, noise=position_noise, lever=lever, at=measured, name="kalman"
    )
    attitude = attitude_likelihood(prior, measured, noise=attitude_noise, at=measured, name="attitude")
    weighed = reweight(corrected, position, attitude, name="weights")
    noises = {"position_noise": position_noise, "attitude_noise": attitude_noise, "lever": lever}
    innovation, grow = judge_pose(
        prior, measured, **noises, gate=gate, patience=patience, at=measured, name="judge"
    )
    posterior = believe_pose(
        prior, weighed, measured, innovation, grow, **noises, draws=draws,
        at=measured, name="believe",
    )  # fmt: skip
    return posterior, innovation


@graph
def resample(cloud: Stream[Cloud], *, below: float, scheme: str, draws: str):
    """Draw the cloud anew where its effective sample size has fallen below a fraction of its size."""
    size = effective_sample_size(cloud, name="size")
    ancestors = draw_ancestors(cloud, size, below=below, scheme=scheme, draws=draws, name="ancestors")
    return take_ancestors(cloud, ancestors, name="cloud"), size, ancestors


@graph
def average(cloud: Stream[Cloud], *, covariance: bool = True):
    """The weighted expectation of the pose, and its covariance."""
    weight = weights(cloud)
    attitude = average_attitude(cloud, weight, name="attitude")
    pose = average_pose(cloud, weight, attitude, name="pose")
    return (pose, cloud_belief(cloud, weight, pose, name="spread")) if covariance else (pose, None)


@graph
def rbpf_indoor(
    imu: Stream[Imu],
    vicon: Stream[Pose],
    *,
    start: Cloud,
    noise: ImuNoise,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = GRAVITY,
    still: float = 0.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    reading: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    resample_below: float = 0.5,
    scheme: str = "systematic",
    covariance: bool = True,
    draws: str = "rbpf_indoor",
    held: Held | None = None,
):
    """Rao-Blackwellized particle filter: attitude by particles, motion by a Kalman filter each.

    Every tick predicts to now; a tick with a pose also updates and resamples. There are no bias states: when
    the body stands `still` for some seconds at first, what the IMU reads then is its bias and is subtracted.
    The pose is averaged before resampling, which only adds noise to it. A `reading` of the IMU is of an
    "instant" or the "mean" since the one before, as for `ekf`.

    With a gate, a pose that is too far from the cloud is refused. After `patience` such poses in a row the
    cloud starts anew about the next one, without a gate too (`lost.verdict`).

    Collected: at every tick `pose`, and `belief`, with its covariance, where that is asked for; at every
    measured pose the `innovation` of the cloud, `effective_sample_size`, `depleted` and `ancestors` (whether
    it resampled, and the index of each new particle).
    """
    if still > 0.0:
        imu = subtract_rest_bias(imu, seconds=still, up=up, gravity=-gravity[2], name="calibrate")
    cloud = delay(start, name="cloud")
    last = delay(Imu.at_rest(gravity), name="last_control")
    control = latest(imu, init=Imu.at_rest(gravity), at=imu | vicon, name="control")
    drive = driving(last, control, reading)
    prior = predict(cloud, drive, noise=noise, gravity=gravity, draws=f"{draws}.attitude", at=imu | vicon)
    if held is not None:
        prior = prior if held.longest is None else stay(cloud, prior, longest=held.longest)
        prior = spread_cloud(prior, imu, held=held, draws=f"{draws}.held")
    posterior, innovation = update(
        prior, vicon, position_noise=position_noise, attitude_noise=attitude_noise, lever=lever, gate=gate,
        patience=patience, draws=f"{draws}.anew",
    )  # fmt: skip
    fresh, size, ancestors = resample(
        posterior, below=resample_below, scheme=scheme, draws=f"{draws}.resample"
    )
    cloud.feed(merge(fresh, prior, tie="left", name="next"))
    last.feed(control)
    pose, belief = average(merge(posterior, prior, tie="left", name="now"), covariance=covariance)
    if covariance:
        collect(belief, "belief")
    collect(innovation, "innovation")
    collect(depletion(size, numbers=3), "depleted")
    return {"pose": pose, "effective_sample_size": size, "ancestors": ancestors}


_UNSMOOTHED = (
    "each particle has a Kalman filter of its own, and particles that are resampled take their past with them"
)


@on_flight(rbpf_indoor, "imu", "vicon", told=with_imu, unsmoothed=_UNSMOOTHED)
def for_flight(
    on: OnFlight,
    *,
    cloud: Particles,
    unknown_yaw: bool = True,
    filter: PoseAided,
    control: HeldControl,
    gated: Gated,
    covariance: bool = True,
    still: NotNegative | None = None,
) -> Case:
    """Start and tune the filter for a flight with an IMU and a motion capture.

    The start is the first measured position, and zero velocity. With an unknown yaw, which is what is taken
    if nothing is said, the yaw is uniform over the circle, and roll and pitch are zero, or those of the first
    pose where it is tilted; else the attitude is the mean that was measured at rest, or the first one,
    levelled with the specific force.

    Args:
        flight: with the streams `imu` and `vicon` (Pose). In place of `imu` it may have the thesis's unit:
            `gyro` and `coordinate_acceleration`, with the same times.
        unknown_yaw: True is start=unknown_yaw and False start=file, where `start` is left out.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. For real units as in
            `ins_eskf`: a data sheet knows nothing of vibration. The simulated one gets 3 and 2: what
            calibration leaves of a bias is no white noise, and particles need room to move after the first
            pose has left a few of them.
        covariance: whether to give one too, and score it.
        still: seconds at the start in which the body does not move; told by the flight or its readings if
            left out.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError: for a setting that is out of range.
        UnknownNameError: for a scheme that is not there.
    """
    imu, vicon = on.inputs["imu"], on.inputs["vicon"]
    info, simulated = on.flight.info, "position_noise" in on.flight.info
    still = given(still, info.get("still"))
    still = rest_seconds(imu) if still is None else float(still)
    begin = filter.pose(
        on,
        on.inputs,
        position=vicon,
        attitude=vicon,
        usual="unknown_yaw" if unknown_yaw else "file",
        rests=still,
    )
    still = max(still - (begin.time - int(imu.time[0])) * 1e-9, 0.0)
    attitude: np.ndarray | None = begin.attitude
    spread = StartSpread()
    if begin.unknown and to_matrix(begin.attitude, xp=np)[2, 2] > math.cos(LEVEL):
        attitude = None
    elif begin.unknown:
        spread = StartSpread(tilt=filter.measured(on)["attitude_noise"], heading=math.inf)
    elif not begin.told:
        attitude = _levelled(on, begin, still)
        if filter.start_heading is not None:
            attitude = turned(attitude, filter.start_heading)
    up = np.array([0.0, 0.0, 1.0]) if attitude is None else to_matrix(attitude, xp=np)[2]
    start = start_cloud(
        cloud.particles, seed=cloud.seed, position=begin.position, attitude=attitude, spread=spread
    )

    def begun(first: Callable[[str], Any], at: Stream[Any]) -> dict[str, Stream[Any]]:
        drawn = cloud_at_start(first("vicon"), particles=cloud.particles, draws=START_DRAWS, at=at)
        return {"cloud": drawn}

    return on.case(
        filter.score(on, pose_errors, estimate="belief" if covariance else "pose"),
        inputs=begin.inputs,
        begin=begun if attitude is None else None,
        start=start,
        noise=filter.imu_noise(on, (3.0, 2.0) if simulated else (15.0, 20.0)),
        **filter.measured(on),
        lever=info.get("vicon_lever", (0.0, 0.0, 0.0)),
        gravity=on.gravity,
        still=still,
        up=tuple(up.tolist()),
        held=control.held(on, begin.inputs["imu"], begin.inputs),
        reading=reading_of(on.flight),
        covariance=covariance,
        **gated.gating(),
        **cloud.resampling(),
    )


def _levelled(on: OnFlight, begin: StartPose, still: float) -> np.ndarray:
    """The mean attitude (4) measured at rest; without a rest the first one, levelled with the force."""
    imu, vicon = begin.inputs["imu"], begin.inputs["vicon"]
    if still <= 0.0:
        if on.weightless:
            return begin.attitude
        return np.asarray(level(begin.attitude, on.first_up("imu", imu["specific_force"]), xp=np))
    seen = vicon["attitude"][vicon.time - vicon.time[0] <= round(still * 1e9)]
    seen = seen[np.isfinite(seen).all(axis=-1)]
    return np.asarray(dominant_eigenvector(seen.T @ seen / len(seen), begin.attitude, xp=np))
