"""Simulated flights of the course: a quadrotor over the mat of 108 tags, in the form of its files.

    course     seed chooses the flight; what is made is what a studentdataN.mat holds, and is read as one

The body follows sums of sines, tilted so that its thrust explains the acceleration, while it slowly turns.
Its camera sees every tag whose four corners are in the image, with noise on each coordinate; the IMU has
white noise, constant biases that walk, and nothing else that real ones have; the motion capture is exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.parameters import Parameters
from flowgraph.blocks.datasets.shape import known, number
from flowgraph.blocks.datasets.studentdata import SETTINGS as READING
from flowgraph.blocks.datasets.studentdata import flight_of
from flowgraph.blocks.geometry.euler import angles_from_matrix
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.signals import CameraMotion
from flowgraph.blocks.vision.camera import Camera
from flowgraph.blocks.vision.motion import camera_motion_of
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError

__all__ = ["SETTINGS", "Motion", "load", "motion", "see", "simulated_content"]

DEFAULTS: Mapping[str, float] = {
    "duration": 30.0,
    "rate": 100.0,
    "pixel_noise": 0.5,
    "gyro.noise": 0.003,
    "accelerometer.noise": 0.03,
    "gyro.bias": 0.02,
    "accelerometer.bias": 0.1,
    "gyro.walk": 1e-4,
    "accelerometer.walk": 1e-3,
    "motion.rate": 50.0,
    "motion.velocity_noise": 0.05,
    "motion.rate_noise": 0.1,
}
"""s; Hz of packets; px; continuous densities; standard deviations of the constant biases; their walks; and
the camera's velocity, as optical flow would give it: Hz, m/s and rad/s."""

SETTINGS: Mapping[str, str] = {
    **READING,
    **{name: f"{value:g} if left out" for name, value in DEFAULTS.items()},
}
"""The settings of `load`: `DEFAULTS`, and those of studentdata."""

IMAGE = (376, 240)  # px
_STEP = 1e-4  # s, for the rate by central difference


class Motion:
    """Where a simulated quadrotor is: position (m) as sums of two sines an axis, and a yaw of its own.

    Args:
        seed: of frequencies, amplitudes and phases.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 7])
        self.centre = np.array([1.8, 1.35, 1.3])
        self.size = np.array([[0.55, 0.25], [0.45, 0.2], [0.25, 0.12]]) * rng.uniform(0.8, 1.2, (3, 2))
        self.rate = 2.0 * np.pi * rng.uniform([0.08, 0.2], [0.14, 0.35], (3, 2))
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (3, 2))
        self.yaw = rng.uniform(-0.5, 0.5), 0.6, 2.0 * np.pi * rng.uniform(0.04, 0.08)

    def _sum(self, t: np.ndarray, order: int) -> np.ndarray:
        angle = self.rate * t[:, None, None] + self.phase + order * np.pi / 2.0
        return np.sum(self.size * self.rate**order * np.sin(angle), axis=-1)

    def position(self, t: np.ndarray) -> np.ndarray:
        """(n, 3), m."""
        return self.centre + self._sum(t, 0)

    def velocity(self, t: np.ndarray) -> np.ndarray:
        """(n, 3), m/s."""
        return self._sum(t, 1)

    def acceleration(self, t: np.ndarray) -> np.ndarray:
        """(n, 3), m/s^2."""
        return self._sum(t, 2)

    def attitude(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3), body to world: z along the thrust, x towards the yaw."""
        z = self.acceleration(t) - np.asarray(GRAVITY)
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        yaw = self.yaw[0] + self.yaw[1] * np.sin(self.yaw[2] * t)
        y = np.cross(z, np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1))
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        return np.stack([np.cross(y, z), y, z], axis=-1)

    def gyro(self, t: np.ndarray) -> np.ndarray:
        """(n, 3), rad/s, body."""
        turned = scipy.spatial.transform.Rotation.from_matrix
        before, after = turned(self.attitude(t - _STEP)), turned(self.attitude(t + _STEP))
        return np.asarray((before.inv() * after).as_rotvec() / (2.0 * _STEP))


def motion(seed: int) -> Motion:
    """The flight of a seed."""
    return Motion(seed)


def see(
    parameters: Parameters, camera: Camera, position: np.ndarray, attitude: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The ids (k,) and exact corners (k, 4, 2) px of the tags that lie wholly in the image."""
    R, t = parameters.mount.view(position, attitude)
    seen = parameters.tag_map.corners @ R.T + t
    front = (seen[..., 2] > 0.05).all(axis=1)
    ideal = seen[..., :2] / np.where(front[:, None], seen[..., 2], 1.0)[..., None]
    near = (np.linalg.norm(ideal, axis=-1) < 0.8).all(axis=1)  # beyond, the polynomial folds back
    pixels = camera.project(np.where((front & near)[:, None, None], seen, [0.0, 0.0, 1.0]))
    inside = ((pixels >= 0.0) & (pixels <= np.array(IMAGE) - 1.0)).all(axis=(1, 2)) & front & near
    return parameters.tag_map.ids[inside], pixels[inside]


def simulated_content(seed: int = 0, **settings: float) -> dict[str, Any]:
    """The variables `data`, `time` and `vicon` of a simulated flight, as `scipy.io.savemat` takes them.

    Args:
        seed: of the flight and its noise.
        settings: any of `DEFAULTS`, with _ for the dot.
    """
    use = {name: settings.get(name.replace(".", "_"), value) for name, value in DEFAULTS.items()}
    rng = np.random.default_rng(seed)
    flight, parameters = motion(seed), Parameters.of_the_course()
    dt = 1.0 / use["rate"]
    t = np.arange(round(use["duration"] * use["rate"])) * dt
    p, R, w = flight.position(t), flight.attitude(t), flight.gyro(t)
    force = np.einsum("nji,nj->ni", R, flight.acceleration(t) - np.asarray(GRAVITY))

    def noisy(exact: np.ndarray, kind: str) -> np.ndarray:
        bias = rng.normal(size=3) * use[f"{kind}.bias"]
        walk = np.cumsum(rng.normal(size=exact.shape), axis=0) * use[f"{kind}.walk"] * dt**0.5
        return exact + bias + walk + rng.normal(size=exact.shape) * use[f"{kind}.noise"] / dt**0.5

    gyro, specific = noisy(w, "gyro"), noisy(force, "accelerometer")
    angles = np.asarray(angles_from_matrix(R, order="zxy", xp=np))
    data = []
    for k in range(len(t)):
        ids, corners = see(parameters, parameters.camera, p[k], R[k])
        corners = corners + rng.normal(size=corners.shape) * use["pixel_noise"]
        quads = {f"p{n + 1}": corners[:, n].T for n in range(4)}
        data.append(
            {
                "id": ids.astype(float),
                **quads,
                "t": t[k],
                "rpy": angles[k],
                "omg": gyro[k],
                "acc": specific[k],
            }
        )
    vicon = np.concatenate([p, angles, flight.velocity(t), w], axis=1).T
    return {"data": np.array(data, dtype=object), "time": t, "vicon": vicon}


def load(argument: str = "", *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """A simulated flight: streams `imu` and `tags`, truth and info as of `studentdata`.

    Args:
        argument: not used.
        seed: of the flight and its noise.
        settings: any of `SETTINGS`.

    Raises:
        DeclarationError, UnknownNameError: for settings.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "course")
    ours = {
        name: number(given, name, value, "course", signed=True)
        for name, value in DEFAULTS.items()
        if name in given
    }
    if (
        min(ours.get("motion.rate", 1.0), ours.get("rate", 1.0)) == 0.0
        or ours.get("duration", 1.0) * ours.get("rate", 100.0) < 1.0
        or min(ours.values(), default=0.0) < 0.0
    ):
        raise DeclarationError(
            "this flight has no packet",
            path="course",
            expected="duration and rate with a product of one or more, and no negative noise",
            got=", ".join(f"{name}={value:g}" for name, value in ours.items()),
            fix="leave the settings out",
        )
    content = simulated_content(seed, **{name.replace(".", "_"): value for name, value in ours.items()})
    rest = {name: value for name, value in given.items() if name in READING and name not in DEFAULTS}
    use = {**DEFAULTS, **ours}
    unit = ImuNoise(
        use["gyro.noise"], use["accelerometer.noise"], use["gyro.walk"], use["accelerometer.walk"]
    )
    flight = flight_of(content, Parameters.of_the_course(), Path(f"course-{seed}"), rest, unit)
    streams = {**flight.streams, "motion": _optical_flow(flight, seed, use)}
    notes = (note("info", f"simulated with seed {seed}"), *flight.notes)
    return Flight(flight.name, streams, flight.truth, flight.info, notes)


def _optical_flow(flight: Flight, seed: int, use: Mapping[str, float]) -> Series:
    """The camera's velocity and rate with white noise, at a rate of its own."""
    truth = flight.truth
    assert truth is not None
    time = np.arange(truth.time[0], truth.time[-1] + 1, round(1e9 / use["motion.rate"]))
    rng = np.random.default_rng([seed, 11])
    velocity, rate = camera_motion_of(truth, time, flight.info["mount"])
    velocity = velocity + rng.normal(size=velocity.shape) * use["motion.velocity_noise"]
    rate = rate + rng.normal(size=rate.shape) * use["motion.rate_noise"]
    return Series(time, CameraMotion(velocity=velocity, rate=rate), name="motion")
