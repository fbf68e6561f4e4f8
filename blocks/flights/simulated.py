"""Simulated flights. `sim`: 1 s at rest, then a smooth figure in space, with an IMU and a motion capture.

`sim:thesis`, `sim:roundtrip` and `sim:hover` go through the simulated world with sensors of choice: see
`worlds`; `sim:plane` is a point in the plane: see `plane`; `sim:drive` is a car: see
`drive`. What follows is the figure of `sim`, whose motion is that of `world.smooth`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.adjust import stream_settings
from flowgraph.blocks.datasets.placed import PLACED, parted, placed_flight
from flowgraph.blocks.flights import drive, figure, plane, worlds
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import Imu, NavigationState, Pose
from flowgraph.blocks.world import AT_REST, generator, shaped, smooth_motion
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["DEFAULTS", "SETTINGS", "load", "trajectory"]

DEFAULTS: Mapping[str, float] = {
    "duration": 20.0,
    "imu.rate": 200.0,
    "vicon.rate": 4.0,
    "gyro.noise": 1e-3,
    "accelerometer.noise": 1e-2,
    "gyro.walk": 2e-5,
    "accelerometer.walk": 3e-4,
    "gyro.bias": 0.01,
    "accelerometer.bias": 0.1,
    "position.noise": 0.01,
    "attitude.noise": 0.01,
}
"""Settings: seconds, Hz, continuous densities, standard deviations of the constant biases, and of the motion
capture in m and rad."""

SETTINGS: Mapping[str, str | float] = {
    **drive.DEFAULTS,
    "road": "of a drive: its number, that of the seed if left out",
    "unit": "of a drive: " + ", ".join(drive.GRADES),
    **worlds.SETTINGS,
    **plane.DEFAULTS,
    **stream_settings("STREAM", only=PLACED),
    **DEFAULTS,
}
"""All settings that `load` understands: `DEFAULTS` for the figure, `worlds.SETTINGS` for the worlds, whose
values when left out are their own; those of any stream are of a flight that was made, as of a recording."""


def load(argument: str = "", *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Make a flight with the streams `imu` (`Imu`) and `vicon` (`Pose`), or one through a world.

    Args:
        argument: "" or "quadrotor" for the figure; thesis, roundtrip or hover for a world (see `worlds`);
            plane for a point in the plane (see `plane`); drive for a car (see `drive`); figure for the figure
            made by a graph (see `figure`).
        seed: of the figure and of all noise. Each noise has a random stream of its own name, so that a
            change of one setting does not change the draws of another.
        settings: any of `DEFAULTS`; of a world, any of `worlds.SETTINGS` that concern it.

    Returns:
        Of the figure, a `Flight`: truth is a `NavigationState` at the IMU's times; info has `still` (s),
        `imu_noise` (`ImuNoise`), `position_noise` (m), `attitude_noise` (rad), `imu_period_ns` and
        `vicon_period_ns`.

    Raises:
        UnknownNameError: for another shape or an unknown setting.
        DeclarationError: for a setting that is not a number in its range.
    """
    own, placed = parted(settings or {}, SETTINGS)
    return placed_flight(_made(argument, seed, own), placed, "sim")


def _made(argument: str, seed: int, settings: Mapping[str, str | float]) -> Flight:
    if argument in worlds.WORLDS:
        return worlds.load_world(argument, seed=seed, settings=settings)
    if argument == "plane":
        return plane.load_plane(seed=seed, settings=settings)
    if argument == "drive":
        return drive.load_drive(seed=seed, settings=settings)
    if argument not in ("", "quadrotor", "figure"):
        kinds = ["quadrotor", "figure", "plane", "drive", *worlds.WORLDS]
        raise UnknownNameError("simulated flight", argument, kinds, path="sim")
    s = _settings(settings)
    if argument == "figure":
        return figure.load_figure(seed=seed, settings=s)
    imu_period, vicon_period = round(1e9 / s["imu.rate"]), round(1e9 / s["vicon.rate"])
    end = round(s["duration"] * 1e9)
    time = np.arange(0, end + 1, imu_period, dtype=np.int64)
    draw = lambda name, *shape: generator(seed, name).standard_normal(shape)

    motion = trajectory(time * 1e-9, seed=seed)
    n, rate = len(time), 1e9 / imu_period
    biases = {}
    for sensor in ("gyro", "accelerometer"):
        start = draw(f"{sensor}.bias", 3) * s[f"{sensor}.bias"]
        steps = draw(f"{sensor}.walk", n - 1, 3) * s[f"{sensor}.walk"] / math.sqrt(rate)
        biases[sensor] = start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    white = {name: draw(f"{name}.noise", n, 3) * s[f"{name}.noise"] * math.sqrt(rate) for name in biases}
    imu = Imu(
        gyro=motion["rate"] + biases["gyro"] + white["gyro"],
        specific_force=motion["force"] + biases["accelerometer"] + white["accelerometer"],
    )

    seen = np.arange(0, end + 1, vicon_period, dtype=np.int64)
    there = trajectory(seen * 1e-9, seed=seed)
    turn = from_rotation_vector(draw("vicon.attitude", len(seen), 3) * s["attitude.noise"], xp=np)
    vicon = Pose(
        position=there["position"] + draw("vicon.position", len(seen), 3) * s["position.noise"],
        attitude=multiply(there["attitude"], turn, xp=np),
    )
    truth = NavigationState(
        position=motion["position"],
        velocity=motion["velocity"],
        attitude=motion["attitude"],
        gyro_bias=biases["gyro"],
        accelerometer_bias=biases["accelerometer"],
    )
    return Flight(
        name=f"sim-{seed}",
        streams={"imu": Series(time, imu, name="imu"), "vicon": Series(seen, vicon, name="vicon")},
        truth=Series(time, truth, name="truth"),
        info={
            "imu_noise": ImuNoise(
                s["gyro.noise"], s["accelerometer.noise"], s["gyro.walk"], s["accelerometer.walk"]
            ),
            "position_noise": s["position.noise"],
            "attitude_noise": s["attitude.noise"],
            "imu_period_ns": imu_period,
            "vicon_period_ns": vicon_period,
            "still": AT_REST,
        },
        notes=(note("info", f"simulated with seed {seed}: 1 s at rest, then a smooth figure"),),
    )


def trajectory(seconds: np.ndarray, *, seed: int = 0) -> dict[str, np.ndarray]:
    """The exact motion at times (n,) in s: arrays (n, 3), the attitude (n, 4).

    Returns:
        position, velocity (m, m/s, world); attitude (body to world); rate (rad/s) and force (specific force,
        m/s^2), both in the body.
    """
    random = generator(seed, "figure")
    shape = shaped(lambda name, low, high, size: random.uniform(low, high, size), xp=np)
    motion = smooth_motion(np.asarray(seconds, dtype=float), shape, xp=np)
    attitude = _quaternion(np.stack(motion["axes"], axis=-1))
    return {
        **{name: motion[name] for name in ("position", "velocity", "rate", "force")},
        "attitude": attitude,
    }


def _quaternion(R: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) of rotation matrices (n, 3, 3), each with the sign nearest to the one before it."""
    q = scipy.spatial.transform.Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]
    flips = np.sign(np.einsum("ni,ni->n", q[1:], q[:-1]))
    signs = np.cumprod(np.concatenate([[math.copysign(1.0, q[0, 0])], flips]))
    return np.asarray(q * signs[:, None])


def _settings(given: Mapping[str, str | float]) -> dict[str, float]:
    known = dict(DEFAULTS)
    for name, text in given.items():
        if name not in known:
            raise UnknownNameError("setting", name, known, path="sim")
        positive = name in ("duration", "imu.rate", "vicon.rate")
        try:
            number = float(text)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number) or number < 0.0 or (positive and number == 0.0):
            raise DeclarationError(
                f"setting {name!r} is not usable",
                path="sim",
                expected="a positive number" if positive else "a number that is not negative",
                got=repr(text),
                fix=f"for example {name}={DEFAULTS[name]:g}",
            )
        known[name] = number
    worlds.check_samples(known, ("imu.rate", "vicon.rate"), "sim")
    return known
