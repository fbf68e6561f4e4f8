"""Inertial navigation outdoors: a loosely coupled error-state filter, aided by satellites and what else
there is.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-7;
P. Groves, "Principles of GNSS, inertial, and multisensor integrated navigation systems", 2nd ed., 2013, ch.
14.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from flowgraph import Case, Stream, collect, delay, graph, latest
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.inertial.navigation import Earth, navigation_crossing, predict_navigation
from flowgraph.blocks.inertial.outdoors import (
    AT_UNIT,
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
from flowgraph.blocks.kalman.backward import collect_steps
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.models.navigation import navigation_recording, navigation_steps
from flowgraph.blocks.outdoor.errors import antenna_errors
from flowgraph.blocks.outdoor.tracks import track_files
from flowgraph.blocks.scoring.cases import OnFlight, on_flight
from flowgraph.blocks.scoring.outdoors import Outdoors
from flowgraph.blocks.scoring.tuning import reading_of, with_imu
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
    antenna: Antenna = AT_UNIT,
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
    robust: Robust | None = None,
    adaptive: float | None = None,
    smoothing: bool = False,
):
    """Error-state Kalman filter of 15 states and more, aided by whichever of its sensors there are.

    State: position, velocity, attitude, gyroscope and accelerometer bias, and what is `estimated` beside
    them. Every tick predicts to now; each measurement that is there then corrects, one after the other, and
    each has a gate and a way back of its own. Collected: `belief` at every tick, and the innovation of each
    sensor; with `smoothing` what a smoother needs too.
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
    if smoothing:
        crossing = navigation_crossing(gravity, earth, estimated)
        collect_steps(belief, now, control, crossing=crossing, held=held)

    scales: dict[str, Any] = {}

    def trust(name: str) -> dict[str, Any]:
        scales[name] = scale_of(adaptive, name)
        return {"gate": gate, "robust": robust, "scale": scales[name], "name": f"fuse_{name}"}

    def told(corrected: tuple[Any, Any], name: str) -> Any:
        posterior, innovation = corrected
        feed_scale(scales[name], innovation, adaptive, name)
        collect(innovation, f"{name}_innovation")
        if gate is None:
            return posterior
        return find_back(posterior, innovation, patience=patience, moving=9, name=f"find_back_{name}")

    if gnss is not None:
        aided = aid_gnss_position(
            now,
            gnss,
            antenna=antenna,
            estimated=estimated,
            invariant=invariant,
            **trust("gnss"),
        )
        now = told(aided, "gnss")
    if gnss_velocity is not None:
        aided = aid_gnss_velocity(
            now, gnss_velocity, control, antenna=antenna, estimated=estimated, invariant=invariant,
            **trust("gnss_velocity"),
        )  # fmt: skip
        now = told(aided, "gnss_velocity")
    if heading is not None:
        now = told(
            aid_antennas(now, heading, baseline=baseline, **trust("heading")),
            "heading",
        )
    if magnetometer is not None:
        aided = aid_compass(
            now,
            magnetometer,
            north=north,
            noise=compass_noise,
            **trust("magnetometer"),
        )
        now = told(aided, "magnetometer")
    if barometer is not None:
        aided = aid_height(
            now,
            barometer,
            noise=height_noise,
            estimated=estimated,
            **trust("barometer"),
        )
        now = told(aided, "barometer")
    if wheels is not None:
        aided = aid_wheels(
            now,
            wheels,
            control,
            noise=speed_noise,
            slip=slip,
            axle=axle,
            **trust("wheels"),
        )
        now = told(aided, "wheels")
    if resting is not None:
        still = standing(now, control, resting=resting, name="standing")
        now, innovation = aid_gnss_velocity(
            now, still, control, antenna=None, estimated=estimated, name="fuse_rest"
        )
        collect(innovation, "rest_innovation")
    belief.feed(now)
    return {"belief": now}


@on_flight(gnss_ins, told=with_imu)
def for_flight(on: OnFlight, *, filter: Outdoors) -> Case:
    """Start and tune the filter for a flight with an inertial unit and any of the other sensors.

    The start is the truth's, or that of a body at rest, or of an alignment in motion, which finds the
    heading by the first seconds of positions. Where the truth is positions alone it is that of the antenna,
    and the estimate is compared there.

    Args:
        flight: with the stream `imu` and any of `gnss`, `gps`, `rtk` (positions, in m or as latitude,
            longitude and
            height, with a covariance or none), `gnss_velocity`, `heading`, `magnetometer`, `barometer`,
            `wheels`.
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. If left out, 15 and 20 for a
            real unit, whose data sheet knows nothing of vibration, aliasing and held samples; 1 for simulated
            noise, which is what it says.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError, UnknownNameError: for a setting that is out of range.
    """
    inputs, world, name = filter.inputs(on)
    antenna, measured = filter.antenna(on, name)
    estimated = filter.estimated(on, inputs, name, measured)
    start, inputs, invariant = filter.started(on, inputs, world, estimated, antenna)
    simulated = "noise" in on.flight.info or "still" in on.flight.info
    known: dict[str, Any] = {
        "start": start,
        "noise": filter.imu_noise(on, (1.0, 1.0) if simulated else (15.0, 20.0)),
        "antenna": antenna,
        "estimated": estimated,
        "height_noise": filter.height_noise,
        "gravity": world.gravity,
        "earth": world.earth,
        "held": filter.held(on, inputs["imu"], inputs),
        "north": filter.north(on, world) if "magnetometer" in inputs else 0.0,
        "compass_noise": filter.compass_noise,
        "speed_noise": filter.speed_noise,
        "slip": filter.slip,
    }
    if "heading" in inputs and "heading_baseline" in on.flight.info:
        known["baseline"] = on.flight.info["heading_baseline"]
    return on.case(
        filter.score(
            on,
            partial(antenna_errors, antenna=antenna, estimated=estimated),
            steps=partial(navigation_steps, estimated=estimated),
            recording=navigation_recording(inputs, reading=reading_of(on.flight), **known),
        ),
        inputs=inputs,
        files=track_files(world.origin, on.flight.name, on.flight.truth),
        resting=filter.resting(),
        invariant=invariant,
        smoothing=filter.smoothed,
        **known,
        **filter.gating(),
    )
