"""What a batch takes each outdoor sensor to see is what the filter's correction of it sees."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.blocks.geometry.rotations import from_rotation_vector
from flowgraph.blocks.inertial.outdoors import (
    Antenna,
    aid_antennas,
    aid_compass,
    aid_gnss_position,
    aid_gnss_velocity,
    aid_height,
    aid_wheels,
)
from flowgraph.blocks.kalman.filters import correct
from flowgraph.blocks.models.navigation import navigation_space
from flowgraph.blocks.models.navigation_seen import (
    antenna_seen,
    antennas_seen,
    compass_seen,
    height_seen,
    velocity_seen,
    wheels_seen,
)
from flowgraph.blocks.signals import (
    Belief,
    GnssHeading,
    GnssPosition,
    GnssVelocity,
    Height,
    Imu,
    MagneticField,
    TurningSpeed,
    TurningVelocity,
    WheelSpeed,
)

SPACE, ANTENNA = navigation_space(()), Antenna((0.4, -0.2, 0.7), 0.05)
AXLE, BASELINE, P3 = (0.5, 0.1, -0.2), (0.9, 0.3, 0.1), np.diag([0.4, 0.9, 1.6])
IMU = Imu(gyro=np.array([0.3, -0.2, 0.8]), specific_force=np.array([0.1, 0.3, 9.7]))


def belief() -> Belief:
    random = np.random.default_rng(2)
    root = random.normal(size=(15, 15)) * 0.05
    return Belief(
        position=np.array([1.0, 2.0, 3.0]), velocity=np.array([4.0, -1.0, 0.5]),
        attitude=np.asarray(from_rotation_vector(np.array([0.2, -0.1, 0.9]), xp=np)),
        gyro_bias=np.array([0.01, 0.02, -0.01]), accelerometer_bias=np.zeros(3),
        covariance=root @ root.T + 0.01 * np.eye(15),
    )  # fmt: skip


HEADING = GnssHeading(np.float64(1.1), np.float64(0.1))
FIX, MOVED = np.array([1.6, 1.8, 3.9]), np.array([4.2, -1.3, 0.4])
PAIRS = {
    "position": (
        lambda b: aid_gnss_position.step(b, GnssPosition(FIX, P3), antenna=ANTENNA, xp=np),
        antenna_seen(SPACE, ANTENNA, ()), GnssPosition(FIX, P3),
    ),
    "velocity": (
        lambda b: aid_gnss_velocity.step(b, GnssVelocity(MOVED, P3), IMU, antenna=ANTENNA, xp=np),
        velocity_seen(SPACE, ANTENNA, ()), TurningVelocity(MOVED, P3, IMU.gyro),
    ),
    "height": (
        lambda b: aid_height.step(b, Height(np.float64(3.4)), noise=0.3, xp=np),
        height_seen(SPACE, 0.3, ()), Height(np.float64(3.4)),
    ),
    "compass": (
        lambda b: aid_compass.step(b, MagneticField(np.array([2.0, 1.0, -3.0])), north=1.4, noise=0.2, xp=np),
        compass_seen(SPACE, 1.4, 0.2), MagneticField(np.array([2.0, 1.0, -3.0])),
    ),
    "antennas": (
        lambda b: aid_antennas.step(b, HEADING, baseline=BASELINE, xp=np),
        antennas_seen(SPACE, BASELINE), HEADING,
    ),
    "wheels": (
        lambda b: aid_wheels.step(b, WheelSpeed(np.float64(3.0)), IMU, noise=0.2, slip=0.3, axle=AXLE, xp=np),
        wheels_seen(SPACE, 0.2, 0.3, AXLE), TurningSpeed(np.float64(3.0), IMU.gyro),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PAIRS)
def test_a_model_corrects_as_the_filter_does(name):
    aided, model, message = PAIRS[name]
    before = belief()
    after, innovation = aided(before)
    x = np.concatenate([getattr(before, part) for part in SPACE.names])
    z, H, R = model.linearised(x, np.zeros(15), message, np)
    apart = model.apart(model.vector(message, np), z, np)
    np.testing.assert_allclose(apart, innovation.residual, atol=1e-12)
    np.testing.assert_allclose(H @ before.covariance @ H.T + R, innovation.covariance, atol=1e-12)
    shift = correct(before.covariance, apart, H, R, xp=np).shift
    found = SPACE.plus(x, shift, np)
    want = np.concatenate([getattr(after, part) for part in SPACE.names])
    np.testing.assert_allclose(found, want, atol=1e-9)
