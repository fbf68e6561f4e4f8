"""Orientation from gyroscope, accelerometer and magnetometer (MARG), with the gyroscope's bias.

Two error-state filters, of the tilt and of the heading, so that a magnet cannot tilt the estimate:

    level     predict   v' = v + (R f + g) dt,  q' = q * Exp((w - b) dt)      every reading of the IMU
              correct   0 = v + noise;  at rest also  w = b + noise
    heading   predict   var' = var + (drift^2 + (scale w_z)^2) dt
              correct   north - atan2(m_y, m_x),  m = R field                 every reading of the field

An acceleration is told from a tilt by the velocity, which must stay small; a disturbed field by its strength
and its dip, and doubt fades slowly. The equations stand in `blocks/orientation/marg.py` and
`blocks/orientation/heading.py`.

Sources: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs.
5-7; D. Laidig and T. Seel, "VQF", Information Fusion 91, 2023.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flowgraph import Case, Stream, delay, graph, latest
from flowgraph.blocks.inertial.alignment import static_alignment, usable
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.kalman.lost import Held, bridged, stay
from flowgraph.blocks.orientation.heading import (
    FieldTrust,
    doubt_heading,
    join_orientation,
    predict_heading,
    start_heading,
    update_heading,
)
from flowgraph.blocks.orientation.marg import (
    UNIT,
    RestRule,
    detect_rest,
    hold_velocity,
    predict_level,
    start_level,
)
from flowgraph.blocks.scoring.cases import HeldControl, OnFlight, Scored, on_flight
from flowgraph.blocks.scoring.orientation import counted_errors
from flowgraph.blocks.scoring.settings import NotNegative, Positive
from flowgraph.blocks.scoring.tuning import given
from flowgraph.blocks.signals import HeadingBelief, Imu, LevelBelief, MagneticField

_REST, _TRUST = RestRule(), FieldTrust()


@graph
def marg(
    imu: Stream[Imu],
    magnetometer: Stream[MagneticField],
    *,
    start: LevelBelief,
    heading: HeadingBelief,
    noise: ImuNoise,
    speed: float = 0.6,
    speed_memory: float = 0.3,
    drift: float = 5e-3,
    scale: float = 0.0035,
    rest: RestRule = _REST,
    trust: FieldTrust = _TRUST,
    north: float = np.pi / 2.0,
    held: Held | None = None,
):
    """Orientation and gyroscope bias from nine axes, tilt and heading apart.

    Collected: `belief` at every reading, and `rest` and `heading` beside it.
    """
    ticks = imu | magnetometer
    tilt, angle = delay(start, name="tilt"), delay(heading, name="angle")
    reading = latest(imu, init=Imu.at_rest(), at=ticks, name="reading")
    still = detect_rest(reading, rule=rest, name="rest")
    moved = predict_level(tilt, reading, noise=noise, scale=scale)
    moved = bridged(tilt, moved, imu, held=held, velocity=0, attitude=3)
    level = hold_velocity(
        moved, reading, still, noise=noise, speed=speed, speed_memory=speed_memory, name="level"
    )
    wandered = predict_heading(angle, level, reading, still, drift=drift, scale=scale)
    if held is not None:
        wandered = doubt_heading(wandered, imu, held=held)
    found = update_heading(wandered, level, magnetometer, trust=trust, north=north, name="heading")
    if held is not None and held.longest is not None:  # nor is anything corrected by its length
        level = stay(moved, level, longest=held.longest, name="stay_level")
        found = stay(wandered, found, longest=held.longest, name="stay_heading")
    tilt.feed(level)
    angle.feed(found)
    return {"belief": join_orientation(level, found, name="belief"), "rest": still, "heading": found}


_UNSMOOTHED = (
    "its heading is filtered on what its tilt has come to, which is no one belief that a"
    " smoother goes back over"
)


@on_flight(marg, "imu", "magnetometer", measured=None, unsmoothed=_UNSMOOTHED)
def for_flight(
    on: OnFlight,
    *,
    speed: Positive | None = None,
    speed_memory: Positive = 0.3,
    drift: NotNegative = 5e-3,
    scale: NotNegative = 0.0035,
    force: NotNegative = 0.05,
    heading_density: Positive = 0.085,
    hold: NotNegative = 0.3,
    align: Positive = 2.0,
    control: HeldControl,
    scored: Scored,
) -> Case:
    """Start the filter on a flight with an IMU and a magnetometer, aligned by its first readings.

    Where the body rests at the start, the alignment is the mean of up to `align` seconds, and gives the
    gyroscope's bias; otherwise it is that of one reading. No truth is used.

    Args:
        flight: with the streams `imu` and `magnetometer` (MagneticField).
        speed: m/s, how fast the body usually moves; the flight's `speed`, or else 0.6.
        speed_memory: s, for how long it moves one way.
        drift: rad/s/sqrt(Hz), of the heading without a field.
        scale: s^(1/2), how fast an error of the gyroscope's scale adds up.
        force: m/s^2, error of the accelerometer by its bias and scale, over `speed_memory` seconds the same.
        heading_density: rad/sqrt(Hz), of the heading that an undisturbed field shows.
        hold: s, for how long the doubt of a disturbed field is held.
        align: s, the longest alignment.
        settle: seconds at the start that the errors leave out, unless the flight says which times count.

    Raises:
        DataError: where the flight lacks a stream. DeclarationError: for a setting that is out of range.
    """
    imu, field = on.inputs.values()
    earth = on.flight.info.get("magnetic_field", (0.0, 1.0, -1.0))
    north = math.atan2(earth[1], earth[0])
    noise = on.flight.info.get("imu_noise", UNIT)
    accelerometer = math.sqrt(noise.accelerometer**2 + 2.0 * force**2 * speed_memory)
    found = static_alignment(imu, field, seconds=align, north=north)
    return on.case(
        scored.score(on, counted_errors(on.flight), innovations=False),
        start=start_level(found),
        heading=start_heading(found, field["field"][int(np.argmax(usable(field["field"], 0.0)))]),
        noise=replace(noise, accelerometer=accelerometer),
        speed=given(speed, on.flight.info.get("speed", 0.6)),
        speed_memory=speed_memory,
        drift=drift,
        scale=scale,
        trust=FieldTrust(density=heading_density, hold=hold),
        north=north,
        held=control.held(on, imu),
    )
