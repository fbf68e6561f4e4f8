"""A particle filter of the fifteen states of inertial navigation, corrected by a pose.

    x = (p, e, v, b_g, b_a)      each particle is one

The same process and observation model as `ins_ukf_pose`, without a Gaussian: every tick moves the particles
with the IMU and noises drawn for each; a tick with a pose weighs them, and resamples when few carry the
weight.

Source: the course's particle filter on AprilTags; equations: `blocks/models/euler_ins.py`,
`blocks/particles/states.py`.
"""

from __future__ import annotations

from typing import Any

from flowgraph import Case, Stream, delay, graph, latest, merge
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.models.euler_ins import euler_angles, navigation_belief
from flowgraph.blocks.models.particle_ins import (
    average_state,
    propagate_states,
    resample_states,
    start_states,
    weigh_states,
)
from flowgraph.blocks.models.pose import driving
from flowgraph.blocks.scoring.cases import OnFlight, Particles, on_flight
from flowgraph.blocks.scoring.euler import EulerPose, on_measured_pose
from flowgraph.blocks.scoring.settings import NotNegative, Positive
from flowgraph.blocks.signals import Imu, PoseMeasurement, StateCloud
from flowgraph.graphs.tag_pose import poses_of

_ROOM = EulerPose(gyro_factor=3.0, accelerometer_factor=3.0)


@graph
def ins_particle(
    imu: Stream[Imu],
    pose: Stream[PoseMeasurement],
    *,
    start: StateCloud,
    noise: ImuNoise,
    R: Any,
    order: str = "zxy",
    factor: float = 1.0,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    reading: str = "instant",
    resample_below: float = 0.5,
    spread: float = 0.1,
    scheme: str = "systematic",
    draws: str = "ins_particle",
):
    """Particle filter of 15 states with Euler angles: IMU control, camera pose.

    A `reading` of the IMU is of an "instant", or the "mean" over the time since the one before (`driving`).
    Collected: `belief` (the particles' mean and covariance, before resampling) and `angles` at every tick;
    `effective_sample_size` and `ancestors` at every pose.
    """
    cloud = delay(start, name="cloud")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | pose, name="control")
    prior = propagate_states(
        cloud,
        driving(last, control, reading),
        order=order,
        noise=noise,
        draws=f"{draws}.process",
        name="predict",
    )
    weighed = weigh_states(prior, pose, order=order, R=R, factor=factor, lever=lever, at=pose, name="update")
    fresh, size, ancestors = resample_states(
        weighed,
        below=resample_below,
        spread=spread,
        scheme=scheme,
        draws=f"{draws}.resample",
        name="resample",
    )
    cloud.feed(merge(fresh, prior, tie="left", name="next"))
    last.feed(control)
    mean = average_state(merge(weighed, prior, tie="left", name="now"))
    return {
        "belief": navigation_belief(mean, order=order),
        "angles": euler_angles(mean, order=order),
        "effective_sample_size": size,
        "ancestors": ancestors,
    }


@on_flight(ins_particle, "imu")
def for_flight(
    on: OnFlight,
    *,
    cloud: Particles,
    filter: EulerPose = _ROOM,
    inflate: Positive = 2.0,
    spread: NotNegative = 0.1,
) -> Case:
    """Start the particles around the first measured pose of a flight, at rest and without biases.

    Args:
        flight: with the stream `imu`, and one of `pose`, `tags` (of which PnP makes poses first) and `vicon`.
        particles: how many; the course asks for 5,000.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU: particles need room.
        inflate: on all standard deviations of the measured pose.
        spread: by what part of the cloud's deviations the copies are shaken apart.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    return on_measured_pose(
        on,
        filter,
        poses_of(on.name, on.flight, tags=filter.tags),
        inflate=inflate,
        start=lambda first: start_states(cloud.particles, first, seed=cloud.seed),
        factor=inflate**2,
        spread=spread,
        **cloud.resampling(),
    )
