"""A flight like those of a small aerial vehicle in a machine hall: what its inertial unit and a tracker see.

The figure of `sim`, flown by a vehicle whose inertial unit lies with its x axis upwards, in another corner
of the hall each time, with the biases of a cheap unit and the jolts of a vehicle that is carried, started and
set down. A laser tracker finds a prism late, loses it at times, tells its position alone, and is switched off
after the unit. Number formats for fixed point are found on such flights:

    flowgraph quantise ins_eskf --data examples/mav_flight.py:mav --width 32 -o formats

The sizes of everything matter there, more than the beauty of the path.
"""

from __future__ import annotations

import math

import numpy as np

from flowgraph import Flight, Series, load_flight
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, to_matrix
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu, Pose, Position

UPRIGHT = np.array([math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0])
"""How the unit is turned in the vehicle, about: its x axis points upwards."""

PRISM = (0.0749, -0.0185, -0.1201)
"""The tracker's prism in the unit's axes, m."""


def mav(*, seed: int = 0, duration: float = 40.0, jolt: float = 50.0) -> Flight:
    """One flight.

    Args:
        seed: of the path, the place and all noise.
        duration: s.
        jolt: the largest specific force of a jolt, m/s^2; a jolt back follows each.
    """
    unit = {"gyro.bias": 0.08, "accelerometer.bias": 0.4, "gyro.noise": 1.7e-4, "accelerometer.noise": 2e-3,
            "gyro.walk": 2e-5, "accelerometer.walk": 3e-3}  # fmt: skip
    flown_with = {**unit, "duration": duration, "vicon.rate": 20.0}
    flown = load_flight("sim", seed=seed, settings={n: str(x) for n, x in flown_with.items()})
    draw = np.random.default_rng([seed, 77])
    truth, imu, seen = flown.truth, flown.streams["imu"], flown.streams["vicon"]
    assert truth is not None
    mount = multiply(UPRIGHT, from_rotation_vector(draw.uniform(-0.4, 0.4, 3), xp=np), xp=np)
    turn = to_matrix(mount, xp=np)
    place = draw.uniform(-5.0, 5.0, 3) * [1.0, 1.0, 0.2]

    gyro, force = imu["gyro"] @ turn, imu["specific_force"] @ turn
    for k in draw.integers(1, len(force) - 1, 12):
        push = draw.uniform(-jolt, jolt, 3) * draw.choice([0.1, 0.3, 1.0])
        rate = draw.uniform(-3.0, 3.0, 3)
        force[k], force[k - 1] = force[k] + push, force[k - 1] - push
        gyro[k], gyro[k - 1] = gyro[k] + rate, gyro[k - 1] - rate
    attitude = multiply(truth["attitude"], mount, xp=np)
    position = truth["position"] + place
    at = np.searchsorted(truth.time, seen.time)
    prism = seen["position"] + place + np.einsum("nij,j->ni", to_matrix(attitude[at], xp=np), np.array(PRISM))
    after = (seen.time - seen.time[0]) / 1e9
    lost = after < draw.uniform(0.3, 1.0)  # the tracker finds the prism late, and loses it now and then
    for begin in draw.uniform(2.0, duration, 3):
        lost |= (after > begin) & (after < begin + draw.uniform(0.3, 1.0))
    # the unit's recording ends first: then one reading holds from one sight of the prism to the next
    ended = imu.time > truth.time[-1] - int(draw.uniform(1.0, 2.0) * 1e9)
    return Flight(
        f"mav-{seed}",
        {
            "imu": Series(imu.time[~ended], Imu(gyro=gyro[~ended], specific_force=force[~ended]), name="imu"),
            "leica": Series(seen.time[~lost], Position(position=prism[~lost]), name="leica"),
        },
        truth=Series(truth.time, Pose(position=position, attitude=attitude), name="truth"),
        info={
            "imu_noise": ImuNoise(*(unit[k] for k in ("gyro.noise", "accelerometer.noise", "gyro.walk",
                                                      "accelerometer.walk"))),
            "imu_period_ns": flown.info["imu_period_ns"],
            "leica_lever": PRISM,
        },
    )  # fmt: skip


def main() -> None:
    """Print how large everything becomes on three flights."""
    for seed in range(3):
        flight = mav(seed=seed, duration=10.0)
        sizes = {
            "force": np.abs(flight.streams["imu"]["specific_force"]).max(),
            "rate": np.abs(flight.streams["imu"]["gyro"]).max(),
            "place": np.abs(flight.streams["leica"]["position"]).max(),
        }
        print(f"{flight.name}: " + ", ".join(f"{name} up to {size:.1f}" for name, size in sizes.items()))


if __name__ == "__main__":
    main()
