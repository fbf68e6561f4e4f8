"""The 15-state error-state Kalman filter of inertial navigation, aided by position and attitude.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-7.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Case, Flight, Series, Stream, clocks_of, collect, delay, graph, latest
from flowgraph.blocks.inertial.aiding import aid_attitude, aid_position
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, predict
from flowgraph.blocks.metrics.errors import interpolate_pose, pose_errors
from flowgraph.blocks.scoring.scorer import scorer
from flowgraph.blocks.scoring.tuning import check_settings, given, imu_noise_of, noise_of
from flowgraph.blocks.signals import Attitude, Belief, Imu, Position


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
    gate: float | None = None,
    gravity: tuple[float, float, float] = GRAVITY,
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
        gate: below 1 the probability with which an honest measurement passes, from 1 on the largest NIS.
        settle: seconds at the start that the errors leave out.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError: for a setting that is out of range.
    """
    factors = {"gyro_factor": gyro_factor, "accelerometer_factor": accelerometer_factor}
    noises = {"position_noise": position_noise, "attitude_noise": attitude_noise}
    check_settings("ins_eskf", {**factors, **noises, "gate": gate}, settle=settle)
    inputs, lever = _inputs(flight)
    real, imu, truth = "position_noise" not in flight.info, inputs["imu"], flight.truth
    noise = imu_noise_of(
        "ins_eskf",
        flight,
        given(gyro_factor, 15.0 if real else 1.0),
        given(accelerometer_factor, 20.0 if real else 1.0),
    )
    if truth is None:
        place, turn = inputs["position"].position[0], np.array([1.0, 0.0, 0.0, 0.0])
    else:
        places, turns = interpolate_pose(truth, imu.time[:1])
        place, turn = places[0], turns[0]
    built = ins_eskf.build(
        **clocks_of(inputs),
        start=start_belief(place, turn, specific_force=imu.specific_force[0], spread=StartSpread()),
        noise=noise,
        position_noise=noise_of("ins_eskf", flight, "position_noise", position_noise, 0.004),
        attitude_noise=noise_of("ins_eskf", flight, "attitude_noise", attitude_noise, 0.01),
        lever=flight.info.get(lever, (0.0, 0.0, 0.0)),
        gate=gate,
    )
    return Case(built, inputs, scorer(flight, pose_errors, settle=settle))


def _inputs(flight: Flight) -> tuple[dict[str, Series], str]:
    """The flight's imu, position and, from a motion capture, attitude; and the name of the lever."""
    if "leica" in flight.streams:
        streams = flight.need("ins_eskf", "imu", "leica")
        return {"imu": streams["imu"], "position": streams["leica"]}, "leica_lever"
    streams = flight.need("ins_eskf", "imu", "vicon", fix="choose a flight with an imu, and leica or vicon")
    vicon = streams["vicon"]
    aids = {
        "position": Series(vicon.time, Position(position=vicon.position), name="position"),
        "attitude": Series(vicon.time, Attitude(attitude=vicon.attitude), name="attitude"),
    }
    return {"imu": streams["imu"], **aids}, "vicon_lever"
