"""A world and sensors of choice in one graph, of which flights of `sim:thesis` and its kin are runs.

Each sensor has a clock of its own, a source without data, and is there where its clock is. One that is late
fires when its reading arrives, and reads the motion of then. How late a reading is that trembles is drawn
beside it: only a recording can put it where it arrives, for the ticks of a graph are those of its sources.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial, reduce
from typing import Any

import numpy as np

from flowgraph import Scalar, Stream, Tick, block, graph, latest
from flowgraph.blocks import sensors as s
from flowgraph.blocks.signals import GRAVITY, Drawn, Vector
from flowgraph.blocks.world import World, hover_waves, motion_over, world_motion

__all__ = ["begins", "late", "lateness", "period", "sensed"]

Numbers = Mapping[str, float]


@block
def lateness(*, draw: Any) -> Scalar:
    """How much later than usual a reading is, in standard deviations of its latency."""
    return draw.normal("late", ())  # type: ignore[no-any-return]


@graph
def sensed(
    truth: Stream[Tick],
    start: Stream[Tick] | None = None,
    plan: Stream[Drawn] | None = None,
    imu: Stream[Tick] | None = None,
    gyro: Stream[Tick] | None = None,
    accelerometer: Stream[Tick] | None = None,
    coordinate_acceleration: Stream[Tick] | None = None,
    position: Stream[Tick] | None = None,
    attitude: Stream[Tick] | None = None,
    vicon: Stream[Tick] | None = None,
    gps: Stream[Tick] | None = None,
    gps2: Stream[Tick] | None = None,
    magnetometer: Stream[Tick] | None = None,
    magnetic_attitude: Stream[Tick] | None = None,
    altimeter: Stream[Tick] | None = None,
    optical_flow: Stream[Tick] | None = None,
    thrust: Stream[Tick] | None = None,
    body_rate: Stream[Tick] | None = None,
    *,
    world: World,
    sensors: Mapping[str, Numbers],
) -> dict[str, Stream[Any]]:
    """A body in a world, and the sensors that have clocks.

    `start` ticks once, at 0, and is there where something is drawn once (`begins`): the constant biases, and
    what the world leaves open if no `plan` tells it, which then comes at 0. There
    is a truth at each `truth`. `sensors` has the settings of each, and of the parts of the IMU, as
    `worlds.SENSORS` lists them.
    """
    given = {
        "imu": imu, "gyro": gyro, "accelerometer": accelerometer,
        "coordinate_acceleration": coordinate_acceleration, "position": position, "attitude": attitude,
        "vicon": vicon, "gps": gps, "gps2": gps2, "magnetometer": magnetometer,
        "magnetic_attitude": magnetic_attitude, "altimeter": altimeter, "optical_flow": optical_flow,
        "thrust": thrust, "body_rate": body_rate,
    }  # fmt: skip
    clocks = {name: clock for name, clock in given.items() if clock is not None}
    made: dict[str, Stream[Any]] = {}
    shape = None
    if world.numbers:
        made["shape"] = hover_waves(at=start) if plan is None else plan
        shape = latest(made["shape"], init=Drawn(numbers=np.zeros(world.numbers)), name="shape")

    now = [name for name in clocks if not (late(sensors[name]) or _of_a_time(sensors[name]))]
    here: dict[str, Any] = {}
    everyone = ["truth", *now]
    for k in range(0, len(everyone), _TOGETHER):
        some = everyone[k : k + _TOGETHER]
        at = _any([clocks.get(name, truth) for name in some])
        here.update(dict.fromkeys(some, world_motion(shape, at=at, world=world)))

    def motion(name: str) -> Any:
        n = sensors[name]
        if name in here:
            return here[name]
        if not _of_a_time(n):
            return world_motion(shape, at=clocks[name], world=world, late=late(n), name=f"{name}_motion")
        return motion_over(
            shape, at=clocks[name], world=world, seconds=period(n) * 1e-9, looks=int(n.get("oversample", 1)),
            turn=bool(n.get("turn", 0)), late=late(n), name=f"{name}_motion",
            gravity=(0.0, 0.0, 0.0) if name == "coordinate_acceleration" else GRAVITY,
        )  # fmt: skip

    def bias(name: str, clock: Stream[Any], constant: float, walk: float) -> Any:
        if not (constant or walk):
            return None
        first = s.bias_at_start(at=start, deviation=constant, name=f"{name}_start", draws=f"{name}_start")
        held = latest(first, init=Vector(vector=np.zeros(3)), name=f"{name}_bias")
        if not walk:
            return held
        moved = s.drift(held, at=clock, walk=walk, name=f"{name}_drift", draws=f"{name}_drift")
        return latest(moved, init=Vector(vector=np.zeros(3)), name=f"{name}_now")

    errors: dict[str, list[Any]] = {}
    for part in _OF_IMU:  # of the IMU as of one alone: a body has one of each
        users = [clocks[name] for name in ("imu", part) if name in clocks]
        n = sensors.get(part, {})
        errors[part] = [bias(part, _any([truth, *users]), n["bias"], n["walk"]) if users else None]
    errors["imu"] = [errors[part][0] for part in _OF_IMU]
    for name in clocks.keys() - errors.keys():
        n = sensors[name]
        parts = [""] if "attitude_bias" not in n else ["", "attitude_"]
        errors[name] = [bias(name + p, clocks[name], n[f"{p}bias"], n[f"{p}walk"]) for p in parts]

    for name, clock in clocks.items():
        n = sensors[name]
        read = _reader(name, sensors)
        made[name] = read(motion(name), *errors[name], at=clock, name=f"{name}_reading", draws=name)
        if n.get("geodetic"):
            origin = n["latitude"], n["longitude"], n["height"]
            made[name] = s.to_geodetic(made[name], origin=origin, name=f"{name}_geodetic")
        if n["jitter"]:
            made[f"{name}_lateness"] = lateness(at=clock, name=f"{name}_lateness", draws=f"{name}_lateness")
    made["truth"] = s.true_state(here["truth"], *errors["imu"], at=truth)
    return made


_TOGETHER = 4
"""Sensors that read one motion: it is found once where they tick together, but to compare the clocks of many
takes long."""

_OF_IMU = ("gyro", "accelerometer")


def _reader(name: str, sensors: Mapping[str, Numbers]) -> Callable[..., Stream[Any]]:
    """The block of a sensor with its settings; white noise of densities is that of a sample."""
    n = sensors[name]
    sampled = lambda part: sensors[part]["noise"] * math.sqrt(n["rate"])
    if name == "imu":
        return partial(s.read_imu, gyro=sampled("gyro"), accelerometer=sampled("accelerometer"))
    if name in _SAMPLED:
        return partial(_SAMPLED[name], noise=sampled(name))
    if name == "vicon":
        return partial(s.read_pose, position_noise=n["noise"], attitude_noise=n["attitude_noise"])
    if name == "optical_flow":
        return partial(s.read_flow, noise=n["noise"], turn_noise=n["attitude_noise"])
    if name == "magnetometer":
        field = s.earth_field(n["declination"], n["dip"], n["strength"])
        return partial(s.read_magnetometer, noise=n["noise"], field=tuple(field.tolist()))
    if name == "altimeter":
        return partial(s.read_altimeter, noise=n["noise"], most_tilt=n["most_tilt"])
    if name in ("position", "gps", "gps2"):
        lever = n["lever_x"], n["lever_y"], n["lever_z"]
        return partial(s.read_position, noise=n["noise"], lever=lever)
    return partial(_PLAIN[name], noise=n["noise"])


_SAMPLED: Mapping[str, Any] = {
    "gyro": s.read_gyro,
    "accelerometer": s.read_accelerometer,
    "coordinate_acceleration": s.read_acceleration,
}
_PLAIN: Mapping[str, Any] = {
    "attitude": s.read_attitude,
    "magnetic_attitude": s.read_attitude,
    "thrust": s.read_thrust,
    "body_rate": s.read_body_rate,
}


def begins(world: World, sensors: Mapping[str, Numbers], *, planned: bool) -> bool:
    """Whether something is drawn once for a flight."""
    drift = any(
        value for n in sensors.values() for part, value in n.items() if part.endswith(("bias", "walk"))
    )
    return drift or (world.numbers > 0 and not planned)


def late(n: Numbers) -> float:
    """s, how late a sensor's readings are in the graph."""
    return 0.0 if n["jitter"] else n["latency"]


def period(n: Numbers) -> int:
    """ns, between the readings of a sensor."""
    return round(1e9 / n["rate"])


def _of_a_time(n: Numbers) -> bool:
    return n.get("oversample", 1.0) > 1.0 or n.get("turn", 0.0) > 0.0


def _any(clocks: list[Any]) -> Any:
    return reduce(lambda a, b: a | b, clocks)
