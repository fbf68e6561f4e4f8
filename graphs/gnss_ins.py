"""Inertial navigation outdoors: a loosely coupled error-state filter, aided by satellites and what else there is.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-7;
P. Groves, "Principles of GNSS, inertial, and multisensor integrated navigation systems", 2nd ed., 2013, ch. 14.
"""

from __future__ import annotations

from typing import Any

from flowgraph import Stream, collect, delay, graph, latest
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.inertial.navigation import Earth, predict_navigation
from flowgraph.blocks.inertial.outdoors import (
    Antenna,
    Resting,
    aid_antennas,
    aid_compass,
    aid_gnss_position,
    aid_gnss_velocity,
    aid_height,
    aid_wheels,
    standing,
)
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.signals import (
    GnssHeading,
    GnssPosition,
    GnssVelocity,
    Height,
    Imu,
    MagneticField,
    WheelSpeed,
)


@graph
def gnss_ins(
    imu: Stream[Imu],
    gnss: Stream[GnssPosition] | None = None,
    gnss_velocity: Stream[GnssVelocity] | None = None,
    heading: Stream[GnssHeading] | None = None,
    magnetometer: Stream[MagneticField] | None = None,
    barometer: Stream[Height] | None = None,
    wheels: Stream[WheelSpeed] | None = None,
    *,
    start: Any,
    noise: ImuNoise,
    antenna: Antenna = Antenna(),
    estimated: tuple[str, ...] = (),
    baseline: tuple[float, float, float] = (1.0, 0.0, 0.0),
    north: float = 0.0,
    compass_noise: float = 0.1,
    height_noise: float = 0.5,
    speed_noise: float = 0.1,
    slip: float = 0.1,
    axle: tuple[float, float, float] = (0.0, 0.0, 0.0),
    resting: Resting | None = None,
    gate: float | None = None,
    gravity: tuple[float, float, float] = GRAVITY,
    earth: Earth | None = None,
    held: Held | None = None,
    invariant: bool = False,
    patience: int = PATIENCE,
):
    """Error-state Kalman filter of 15 states and more, aided by whichever of its sensors there are.

    State: position, velocity, attitude, gyroscope and accelerometer bias, and what is `estimated` beside them.
    Every tick predicts to now; each measurement that is there then corrects, one after the other, and each has a
    gate and a way back of its own. Collected: `belief` at every tick, and the innovation of each sensor.
    """
    aids = {
        "gnss": gnss, "gnss_velocity": gnss_velocity, "heading": heading, "magnetometer": magnetometer,
        "barometer": barometer, "wheels": wheels,
    }  # fmt: skip
    ticks: Any = imu
    for stream in aids.values():
        ticks = ticks if stream is None else ticks | stream
    belief = delay(start, name="belief")
    control = latest(imu, init=Imu.at_rest(gravity), at=ticks, name="control")
    prior = predict_navigation(
        belief, control, noise=noise, gravity=gravity, earth=earth, estimated=estimated, name="predict"
    )
    now = bridged(belief, prior, imu, held=held, position=0, velocity=3, attitude=6)

    def told(corrected: tuple[Any, Any], name: str) -> Any:
        posterior, innovation = corrected
        collect(innovation, f"{name}_innovation")
        if gate is None:
            return posterior
        return find_back(posterior, innovation, patience=patience, moving=9, name=f"find_back_{name}")

    if gnss is not None:
        aided = aid_gnss_position(
            now, gnss, antenna=antenna, estimated=estimated, gate=gate, invariant=invariant, name="fuse_gnss"
        )
        now = told(aided, "gnss")
    if gnss_velocity is not None:
        aided = aid_gnss_velocity(
            now, gnss_velocity, control, antenna=antenna, estimated=estimated, gate=gate, invariant=invariant,
            name="fuse_gnss_velocity",
        )  # fmt: skip
        now = told(aided, "gnss_velocity")
    if heading is not None:
        now = told(aid_antennas(now, heading, baseline=baseline, gate=gate, name="fuse_heading"), "heading")
    if magnetometer is not None:
        aided = aid_compass(
            now, magnetometer, north=north, noise=compass_noise, gate=gate, name="fuse_magnetometer"
        )
        now = told(aided, "magnetometer")
    if barometer is not None:
        aided = aid_height(
            now, barometer, noise=height_noise, estimated=estimated, gate=gate, name="fuse_barometer"
        )
        now = told(aided, "barometer")
    if wheels is not None:
        aided = aid_wheels(
            now, wheels, control, noise=speed_noise, slip=slip, at=axle, gate=gate, name="fuse_wheels"
        )
        now = told(aided, "wheels")
    if resting is not None:
        still = standing(now, imu, resting=resting, name="standing")
        now, innovation = aid_gnss_velocity(now, still, control, estimated=(), name="fuse_rest")
        collect(innovation, "rest_innovation")
    belief.feed(now)
    return {"belief": now}
