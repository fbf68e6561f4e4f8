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

from flowgraph import Case, Flight, Stream, delay, graph, latest, merge
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.models.euler_ins import euler_angles, navigation_belief
from flowgraph.blocks.models.particle_ins import (
    average_state,
    propagate_states,
    resample_states,
    start_states,
    weigh_states,
)
from flowgraph.blocks.models.pose import between_imu
from flowgraph.blocks.particles.resampling import MOST_PARTICLES
from flowgraph.blocks.signals import Imu, PoseMeasurement, StateCloud
from flowgraph.graphs.euler_flight import need_settings, pose_case
from flowgraph.language.checks import need_count, need_numbers


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
    resample_below: float = 0.5,
    spread: float = 0.1,
    scheme: str = "systematic",
    draws: str = "ins_particle",
):
    """Particle filter of 15 states with Euler angles: IMU control, camera pose.

    Collected: `belief` (the particles' mean and covariance, before resampling) and `angles` at every tick;
    `effective_sample_size` and `ancestors` at every pose.
    """
    cloud = delay(start, name="cloud")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | pose, name="control")
    prior = propagate_states(
        cloud, between_imu(last, control), order=order, noise=noise, draws=f"{draws}.process", name="predict"
    )
    weighed = weigh_states(prior, pose, order=order, R=R, factor=factor, at=pose, name="update")
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


@ins_particle.on_flight
def for_flight(
    flight: Flight,
    *,
    particles: int = 1000,
    seed: int = 0,
    order: str = "zxy",
    tags: str = "all",
    gyro_factor: float = 3.0,
    accelerometer_factor: float = 3.0,
    position_noise: float | None = None,
    attitude_noise: float | None = None,
    inflate: float = 2.0,
    resample_below: float = 0.5,
    spread: float = 0.1,
    scheme: str = "systematic",
    settle: float = 1.0,
) -> Case:
    """Start the particles around the first measured pose of a flight, at rest and without biases.

    Args:
        flight: with the stream `imu`, and one of `pose`, `tags` (of which PnP makes poses first) and `vicon`.
        particles: how many; the course asks for 5,000.
        seed: of the start's draws; that of the run is given to `simulate`.
        order: zxy (the course's) or zyx (the report's).
        tags: all, even or odd: the ids that PnP uses.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU: particles need room.
        position_noise, attitude_noise: as in `ins_ukf_pose`.
        inflate: on all standard deviations of the measured pose.
        resample_below: resample when the effective sample size is below this part of the particles.
        spread: by what part of the cloud's deviations the copies are shaken apart.
        scheme: systematic, stratified, residual or multinomial.
        settle: seconds at the start that the errors leave out.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    shared: dict[str, Any] = {
        "gyro_factor": gyro_factor,
        "accelerometer_factor": accelerometer_factor,
        "position_noise": position_noise,
        "attitude_noise": attitude_noise,
        "inflate": inflate,
    }
    need_settings("ins_particle", order, settle, **shared)
    need_numbers("ins_particle", not_negative={"resample_below": resample_below, "spread": spread})
    need_count("ins_particle", "particles", particles, least=1, most=MOST_PARTICLES)
    return pose_case(
        ins_particle,
        flight,
        order=order,
        tags=tags,
        settle=settle,
        start=lambda first: start_states(particles, first, seed=seed),
        factor=inflate**2,
        resample_below=resample_below,
        spread=spread,
        scheme=scheme,
        **shared,
    )
