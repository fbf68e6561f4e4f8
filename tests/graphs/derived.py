"""An extended filter of the pose whose Jacobians nobody wrote: `jacobian` of what the unscented filter takes.

Beside it the filter by hand, with the same outputs, so that one can be held to the other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Array, Stream, block, collect, delay, graph, latest, lower
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.filters import update_extended
from flowgraph.blocks.models.pose import POSE, between_imu, pose_belief, predict_pose, update_pose
from flowgraph.blocks.models.unscented_pose import STATE, carry_pose, imu_density, named_pose, see_pose
from flowgraph.blocks.signals import Gaussian, Imu, Pose, QuaternionBelief
from flowgraph.graphs.ukf import stacked_pose
from flowgraph.language.graph import Graph
from flowgraph.pipeline.costs import Costs
from flowgraph.pipeline.optimise import COMPILED

Function = Callable[[Array, Any], Array]


def moving(control: Imu, dt: Any, gravity: tuple[float, float, float] = GRAVITY) -> Function:
    carry = carry_pose(gravity)
    return lambda s, xp: carry(s[..., None, :10], control, s[..., None, 10:], dt, xp)[..., 0, :]


@block
def predict_derived(
    belief: Gaussian,
    control: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float],
    dt: float,
    xp: Any,
) -> Gaussian:
    after, J = linearised(moving(control, dt, gravity), belief.mean, STATE, xp, seen=STATE, more=6)
    F, G = J[..., :9], J[..., 9:]
    P = F @ belief.covariance @ F.mT + G @ xp.asarray(imu_density(noise), dtype=F.dtype) @ G.mT * dt
    return Gaussian(mean=STATE.plus(after, xp.zeros((9,)), xp), covariance=0.5 * (P + P.mT))


@graph
def derived_ekf(
    imu: Stream[Imu],
    vicon: Stream[Pose],
    *,
    start: Gaussian,
    noise: ImuNoise,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = GRAVITY,
):
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | vicon, name="control")
    prior = predict_derived(belief, between_imu(last, control), noise=noise, gravity=gravity)
    posterior, innovation = update_extended(
        prior,
        vicon.map(stacked_pose, name="pose"),
        observe=see_pose(lever),
        R=np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3),
        space=STATE,
        measured_space=POSE,
    )
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    return {"belief": named_pose(posterior)}


@graph
def ekf_by_hand(
    imu: Stream[Imu],
    vicon: Stream[Pose],
    *,
    start: QuaternionBelief,
    noise: ImuNoise,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = GRAVITY,
):
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(), name="last_control")
    control = latest(imu, init=Imu.at_rest(), at=imu | vicon, name="control")
    prior = predict_pose(belief, between_imu(last, control), noise=noise, gravity=gravity)
    posterior, innovation = update_pose(
        prior, vicon, position_noise=position_noise, attitude_noise=attitude_noise, lever=lever
    )
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    return {"belief": pose_belief(posterior)}


def operations(built: Graph) -> int:
    """Scalar operations of a tick with an IMU reading and a pose, as C has them."""
    return sum(Costs(lower(built), 3, COMPILED).operations.values())
