"""The 15-state error-state Kalman filter of inertial navigation, aided by position and attitude.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-7.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import (
    Case,
    DataError,
    Flight,
    Result,
    Series,
    Stream,
    collect,
    delay,
    graph,
    latest,
    timing_of,
)
from flowgraph.blocks.aiding import aid_attitude, aid_position
from flowgraph.blocks.alignment import StartSpread, start_belief
from flowgraph.blocks.inertial import GRAVITY, ImuNoise, predict
from flowgraph.blocks.metrics import interpolate_pose, pose_errors
from flowgraph.blocks.signals import Attitude, Belief, Imu, Position
from flowgraph.checks import need_numbers


@graph
def ins_eskf(
    imu: Stream[Imu],
    position: Stream[Position],
    attitude: Stream[Attitude] | None = None,
    *,
    start: Belief,
    noise: ImuNoise,
    position_noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    attitude_noise: float = 0.01,
    gravity: tuple[float, float, float] = GRAVITY,
    gate: float | None = None,
):
    """15-state error-state Kalman filter: every tick predicts to now; a tick with a measurement also updates.

    State: position, velocity, attitude, gyroscope and accelerometer bias. The error is local: a right (body)
    rotation vector. Collected: `belief` at every tick, and the innovation of each aid where there was one.
    """
    ticks = imu | position if attitude is None else imu | position | attitude
    belief = delay(start, name="belief")
    control = latest(imu, init=Imu.at_rest(), name="control")
    prior = predict(belief, control, noise=noise, gravity=gravity, at=ticks)
    posterior, innovation = aid_position(prior, position, noise=position_noise, lever=lever, gate=gate)
    collect(innovation, "position_innovation")
    if attitude is not None:
        posterior, turn = aid_attitude(posterior, attitude, noise=attitude_noise, gate=gate)
        collect(turn, "attitude_innovation")
    belief.feed(posterior)
    return {"belief": posterior}


@ins_eskf.on_flight
def for_flight(
    flight: Flight,
    *,
    gyro_factor: float | None = None,
    accelerometer_factor: float | None = None,
    position_noise: float | None = None,
    attitude_noise: float | None = None,
    gate: float | None = None,
    settle: float = 1.0,
) -> Case:
    """Start and tune the filter for a flight with an IMU and a position: EuRoC, or the simulated one.

    The start is the truth's position, the attitude that takes the measured specific force to +z and is
    nearest to the truth's, and zero velocity and biases.

    Args:
        flight: with the streams `imu` and one of `leica` (Position) or `vicon` (Pose).
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. If left out, 15 and 20 for a
            real unit, whose data sheet knows nothing of vibration, aliasing and held samples; 1 for simulated
            noise, which is what it says.
        position_noise, attitude_noise: standard deviations in m and rad; the flight's own if left out.
        gate: a measurement with a larger normalised innovation squared changes nothing.
        settle: seconds at the start that the errors leave out.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError: for a setting that is out of range.
    """
    need_numbers(
        "ins_eskf",
        positive={
            "gyro_factor": gyro_factor,
            "accelerometer_factor": accelerometer_factor,
            "position_noise": position_noise,
            "attitude_noise": attitude_noise,
            "gate": gate,
        },
        not_negative={"settle": settle},
    )
    aids = _aids(flight)
    inputs = {"imu": flight.streams["imu"], **aids}
    real = "position_noise" not in flight.info
    noise = flight.info["imu_noise"].scaled(
        gyro=_given(gyro_factor, 15.0 if real else 1.0),
        accelerometer=_given(accelerometer_factor, 20.0 if real else 1.0),
    )
    truth = flight.truth
    imu = flight.streams["imu"]
    if truth is None:
        place, turn = aids["position"].position[0], np.array([1.0, 0.0, 0.0, 0.0])
    else:
        places, turns = interpolate_pose(truth, imu.time[:1])
        place, turn = places[0], turns[0]
    clocks: dict[str, Any] = {name: timing_of(series) for name, series in inputs.items()}
    built = ins_eskf.build(
        **clocks,
        start=start_belief(place, turn, specific_force=imu.specific_force[0], spread=StartSpread()),
        noise=noise,
        position_noise=_given(position_noise, flight.info.get("position_noise", 0.004)),
        attitude_noise=_given(attitude_noise, flight.info.get("attitude_noise", 0.01)),
        lever=flight.info.get("leica_lever" if "leica" in flight.streams else "vicon_lever", (0.0, 0.0, 0.0)),
        gate=gate,
    )

    def score(result: Result) -> dict[str, float]:
        return {} if truth is None else pose_errors(result["belief"], truth, settle=settle)

    return Case(built, inputs, score)


def _aids(flight: Flight) -> dict[str, Series]:
    """The flight's position and, from a motion capture, attitude."""
    if "imu" in flight.streams and "leica" in flight.streams:
        return {"position": flight.streams["leica"]}
    if "imu" in flight.streams and "vicon" in flight.streams:
        vicon = flight.streams["vicon"]
        return {
            "position": Series(vicon.time, Position(position=vicon.position), name="position"),
            "attitude": Series(vicon.time, Attitude(attitude=vicon.attitude), name="attitude"),
        }
    raise DataError(
        "this flight lacks what ins_eskf needs",
        path=flight.name,
        expected="streams imu, and leica or vicon",
        got=", ".join(flight.streams),
        fix="choose another recording, or build ins_eskf with your own sources",
    )


def _given(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
