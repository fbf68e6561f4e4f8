"""The bound of a pose: its Jacobians are those of the motion, and an error-state filter keeps to it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import load_flight, simulate_many
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.models import pose_bound as bound
from flowgraph.blocks.models.pose import start_pose
from flowgraph.blocks.models.unscented_pose import STATE, carry_pose
from flowgraph.blocks.signals import Imu
from flowgraph.graphs import ekf

NOISE = ImuNoise(0.02, 0.03, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_is_that_of_the_filters_own_motion(seed, monkeypatch):
    """By the Jacobian of `ekf`, in whose world there is gravity, along a flight that turns."""
    truth = load_flight("sim", seed=seed, settings={"duration": "4"}).truth
    assert truth is not None
    kept: dict[str, Any] = {}
    monkeypatch.setattr(bound, "posterior_bound", lambda F, Q, *rest, **more: kept.update(F=F, Q=Q))
    bound.pose_bound(
        truth.time, truth["velocity"], truth["attitude"], measured=np.zeros(len(truth), dtype=bool),
        noise=NOISE, position_noise=0.1, attitude_noise=0.1,
    )  # fmt: skip
    quiet = {
        f"{part}.{what}": "0" for part in ("gyro", "accelerometer") for what in ("noise", "walk", "bias")
    }
    world = load_flight("sim", seed=seed, settings={"duration": "4", **quiet})
    carry = carry_pose()
    imu, q, dt = world.streams["imu"], truth["attitude"], 0.005
    for k in range(300, 790, 70):
        control = Imu(
            gyro=0.5 * (imu["gyro"][k] + imu["gyro"][k + 1]),
            specific_force=0.5 * (imu["specific_force"][k] + imu["specific_force"][k + 1]),
        )
        x = np.concatenate([np.zeros(6), q[k]])
        step = lambda x, xp, control=control: carry(x, control, np.zeros((1, 6)), dt, xp)
        _, F = linearised(step, x[None], STATE, np, seen=STATE)
        np.testing.assert_allclose(kept["F"][k], F[0], rtol=0.0, atol=2e-4)
    np.testing.assert_allclose(np.diag(kept["Q"][0])[3:], np.repeat([0.03**2 * dt, 0.02**2 * dt], 3))


def test_no_filter_is_below_it_and_one_that_knows_the_noise_is_near():
    quiet = {"sensors": "imu,vicon", "duration": "10", "gyro.noise": "0.01", "accelerometer.noise": "0.03"}
    flights = [load_flight("sim:thesis", seed=seed, settings=quiet) for seed in range(32)]
    truths = [flight.truth for flight in flights if flight.truth is not None]
    time = truths[0].time
    velocity, attitude = (np.stack([t[name] for t in truths], axis=1) for name in ("velocity", "attitude"))
    P = bound.pose_bound(
        time, velocity, attitude, measured=np.isin(time, flights[0].streams["vicon"].time),
        noise=flights[0].info["imu_noise"], position_noise=0.1, attitude_noise=0.1, gravity=GRAVITY,
        start=np.diag([0.7**2] * 6 + [0.3**2] * 3),
    )  # fmt: skip
    least = np.diagonal(P, axis1=-2, axis2=-1)[time >= 1_000_000_000, :, 6:].sum(-1).mean()
    inputs = [{name: flight.streams[name] for name in ("imu", "vicon")} for flight in flights]
    starts = [{"belief": start_pose(t["position"][0], t["attitude"][0])} for t in truths]
    graph = ekf.case(flights[0]).graph
    many = simulate_many(
        graph, inputs, range(len(flights)), engine="c", init=starts, keep=["belief.attitude"]
    )
    off = geodesic_angle(many["belief"].attitude, attitude.swapaxes(0, 1))[:, time >= 1_000_000_000]
    assert 0.9 < np.mean(np.radians(off) ** 2) / least < 1.15
