"""A particle filter of the fifteen states of inertial navigation, corrected by a pose.

    x = (p, e, v, b_g, b_a)      each particle is one

The same process and observation model as `ins_ukf_pose`, without a Gaussian: every tick moves the particles
with the IMU and noises drawn for each; a tick with a pose corrects kernels about them, weighs these, and
draws new particles of them. A cloud that has lost track grows until the pose is plausible.

Source: the course's particle filter on AprilTags; equations: `blocks/models/euler_ins.py`,
`blocks/models/particle_ins.py` and `blocks/particles/guided.py`.
"""

from __future__ import annotations

from typing import Any

from flowgraph import Case, Stream, collect, delay, graph, latest, merge
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.lost import PATIENCE, Held, stay
from flowgraph.blocks.models.euler_ins import euler_angles, navigation_belief
from flowgraph.blocks.models.particle_ins import (
    BANDWIDTH,
    average_kernels,
    average_state,
    correct_states,
    propagate_states,
    resample_states,
    start_states,
)
from flowgraph.blocks.models.pose import driving
from flowgraph.blocks.models.spread import spread_states
from flowgraph.blocks.particles.lost import depletion
from flowgraph.blocks.scoring.cases import Gated, HeldControl, OnFlight, Particles, on_flight
from flowgraph.blocks.scoring.euler import EulerPose, on_measured_pose
from flowgraph.blocks.scoring.settings import NotNegative, Positive, Share
from flowgraph.blocks.scoring.tuning import with_imu
from flowgraph.blocks.signals import Imu, PoseMeasurement, StateCloud
from flowgraph.graphs.tag_pose import poses_of


@graph
def ins_particle(
    imu: Stream[Imu],
    pose: Stream[PoseMeasurement],
    *,
    start: StateCloud,
    noise: ImuNoise,
    R: Any,
    order: str = "zxy",
    gravity: tuple[float, float, float] = GRAVITY,
    factor: float = 1.0,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    reading: str = "instant",
    resample_below: float = 0.5,
    spread: float = 0.0,
    bandwidth: float = BANDWIDTH,
    gate: float | None = None,
    patience: int = PATIENCE,
    scheme: str = "systematic",
    draws: str = "ins_particle",
    held: Held | None = None,
):
    """Particle filter of 15 states with Euler angles: IMU control, camera pose.

    A `reading` of the IMU is of an "instant", or the "mean" over the time since the one before (`driving`).
    Collected: `belief` (the particles' mean and covariance, before resampling) and `angles` at every tick;
    `innovation` of the cloud, `effective_sample_size`, `depleted` and `ancestors` at every pose.
    """
    cloud = delay(start, name="cloud")
    last = delay(Imu.at_rest(gravity), name="last_control")
    control = latest(imu, init=Imu.at_rest(gravity), at=imu | pose, name="control")
    prior = propagate_states(
        cloud,
        driving(last, control, reading),
        order=order,
        noise=noise,
        gravity=gravity,
        draws=f"{draws}.process",
        name="predict",
    )
    if held is not None:
        prior = prior if held.longest is None else stay(cloud, prior, longest=held.longest)
        prior = spread_states(prior, imu, held=held, draws=f"{draws}.held")
    kernels, innovation = correct_states(
        prior,
        pose,
        order=order,
        R=R,
        factor=factor,
        lever=lever,
        bandwidth=bandwidth,
        gate=gate,
        patience=patience,
        at=pose,
        name="update",
    )
    fresh, size, ancestors = resample_states(
        kernels,
        below=resample_below,
        spread=spread,
        scheme=scheme,
        draws=f"{draws}.resample",
        name="resample",
    )
    cloud.feed(merge(fresh, prior, tie="left", name="next"))
    last.feed(control)
    mean = merge(average_kernels(kernels), average_state(prior), tie="left", name="now")
    collect(innovation, "innovation")
    collect(depletion(size, numbers=15), "depleted")
    return {
        "belief": navigation_belief(mean, order=order),
        "angles": euler_angles(mean, order=order),
        "effective_sample_size": size,
        "ancestors": ancestors,
    }


_UNSMOOTHED = (
    "its particles are moved by the pose too, so the density of a step to go back by is not the motion's"
)


@on_flight(ins_particle, "imu", told=with_imu, unsmoothed=_UNSMOOTHED)
def for_flight(
    on: OnFlight,
    *,
    cloud: Particles,
    filter: EulerPose,
    control: HeldControl,
    gated: Gated,
    inflate: Positive = 1.0,
    spread: NotNegative = 0.0,
    bandwidth: Share = BANDWIDTH,
) -> Case:
    """Start the particles around the first measured pose of a flight, at rest and without biases.

    Args:
        flight: with the stream `imu`, and one of `pose`, `tags` (of which PnP makes poses first) and `vicon`.
        particles: how many; the course asks for 5,000.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU.
        inflate: on all standard deviations of the measured pose.
        spread: by what part of the sample's range, over particles^(1/15), copies are shaken apart; 0.2 is
            Gordon's.
        bandwidth: of the kernels in deviations of the cloud: 1 makes it a Gaussian filter, 0 draws the
            particles without a look at the pose.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    poses = poses_of(on.name, on.flight, tags=filter.tags)
    return on_measured_pose(
        on,
        filter,
        poses,
        inflate=inflate,
        start=lambda first: start_states(cloud.particles, first, seed=cloud.seed),
        factor=inflate**2,
        spread=spread,
        held=control.held(on, on.inputs["imu"], {**on.inputs, "pose": poses}),
        bandwidth=bandwidth,
        **gated.gating(),
        **cloud.resampling(),
    )
