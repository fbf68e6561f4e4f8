"""The 15-state error-state Kalman filter of inertial navigation, aided by position and attitude.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-7.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import Case, Series, Stream, clocks_of, collect, delay, graph, latest, simulate
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.inertial.aiding import aid_attitude, aid_position
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, predict
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.scoring.cases import OnFlight, PoseFilter, on_flight
from flowgraph.blocks.scoring.point import positions
from flowgraph.blocks.signals import Attitude, Belief, Imu, Position

SEARCHED, HEADINGS = 15.0, 12
"""Over how many seconds a heading is sought of which nothing is known, and how many are tried."""


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
    held: Held | None = None,
    invariant: bool = False,
    patience: int = PATIENCE,
):
    """15-state error-state Kalman filter: every tick predicts to now; a tick with a measurement also updates.

    State: position, velocity, attitude, gyroscope and accelerometer bias. The error is local: a right (body)
    rotation vector. Collected: `belief` at every tick, and the innovation of each aid where there was one.
    """
    ticks = imu | position if attitude is None else imu | position | attitude
    belief = delay(start, name="belief")
    control = latest(imu, init=Imu.at_rest(gravity), name="control")
    prior = predict(belief, control, noise=noise, gravity=gravity, at=ticks)
    prior = bridged(belief, prior, imu, held=held, position=0, velocity=3, attitude=6)
    posterior, innovation = aid_position(
        prior, position, noise=position_noise, lever=lever, gate=gate, invariant=invariant
    )
    collect(innovation, "position_innovation")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=9, name="find_back")
    if attitude is not None:
        posterior, turn = aid_attitude(
            posterior, attitude, noise=attitude_noise, gate=gate, invariant=invariant
        )
        collect(turn, "attitude_innovation")
        if gate is not None:
            posterior = find_back(posterior, turn, patience=patience, moving=9, name="find_back_attitude")
    belief.feed(posterior)
    return {"belief": posterior}


@on_flight(ins_eskf)
def for_flight(on: OnFlight, *, filter: PoseFilter) -> Case:
    """Start and tune the filter for a flight with an IMU and a position: EuRoC, or the simulated one.

    The start is the truth's position, the attitude that takes the measured specific force to +z and is
    nearest to the truth's, and zero velocity and biases. Without a truth it is the first measured position
    and attitude; without attitudes nothing is known of the heading.

    Args:
        flight: with the streams `imu` and one of `leica` (Position) or `vicon` (Pose).
        gyro_factor, accelerometer_factor: on the densities of the flight's IMU. If left out, 15 and 20 for a
            real unit, whose data sheet knows nothing of vibration, aliasing and held samples; 1 for simulated
            noise, which is what it says.

    Raises:
        DataError: where the flight lacks a stream.
        DeclarationError: for a setting that is out of range.
    """
    inputs, lever = _inputs(on)
    imu, info = inputs["imu"], on.flight.info
    seen = inputs["attitude"]["attitude"][0] if "attitude" in inputs else None
    begin = filter.pose(on, int(imu.time[0]), inputs["position"]["position"][0], seen)
    force = on.first_up("imu", imu["specific_force"])
    settings = {
        "noise": filter.imu_noise(on, (1.0, 1.0) if "position_noise" in info else (15.0, 20.0)),
        **filter.measured(on),
        "lever": info.get(lever, (0.0, 0.0, 0.0)),
        "held": filter.held(on, imu, inputs),
        "invariant": begin.heading is not None,
        **filter.gating(),
    }
    turn, spread = begin.attitude, StartSpread()
    if begin.heading is not None:
        spread = StartSpread(heading=0.5)
        turn = _likeliest_heading(on, inputs, begin.position, turn, force, spread, settings)
    return on.case(
        filter.score(on, pose_errors),
        inputs=inputs,
        start=start_belief(begin.position, turn, specific_force=force, spread=spread),
        **settings,
    )


def _likeliest_heading(
    on: OnFlight,
    inputs: dict[str, Series],
    position: np.ndarray,
    attitude: np.ndarray,
    force: np.ndarray,
    spread: StartSpread,
    settings: dict[str, Any],
) -> np.ndarray:
    """The attitude (4), turned about the vertical by the heading of a circle of them with which the filter
    best foretells the first measurements, those of `SEARCHED` seconds.

    One Gaussian cannot hold a whole circle: from the wrong side of it the innovations look like errors of
    velocity and bias, and the filter grows sure of a wrong heading. Each of `HEADINGS` is near enough.
    """
    end = inputs["imu"].time[0] + round(SEARCHED * 1e9)
    first = {name: series[series.time <= end] for name, series in inputs.items()}
    clocks = clocks_of(first)
    best, found = math.inf, attitude
    for k in range(HEADINGS):
        about_z = from_rotation_vector(np.array([0.0, 0.0, 2.0 * math.pi * k / HEADINGS]), xp=np)
        turn = np.asarray(multiply(about_z, attitude, xp=np))
        start = start_belief(position, turn, specific_force=force, spread=spread)
        result = simulate(ins_eskf.build(**clocks, start=start, **{**settings, "gate": None}), first)
        seen = [result[name] for name in result.series if name.endswith("innovation")]
        cost = sum(float(np.sum(s["nis"] + np.linalg.slogdet(s["covariance"])[1])) for s in seen)
        if cost < best:
            best, found = cost, turn
    on.note("info", f"the heading at the start was sought in the first {SEARCHED:g} s of measurements")
    return found


def _inputs(on: OnFlight) -> tuple[dict[str, Series], str]:
    """The flight's imu, position and, from a motion capture, attitude; and the name of the lever."""
    if "leica" in on.flight.streams:
        streams = on.need("imu", "leica")
        return {"imu": streams["imu"], "position": streams["leica"]}, "leica_lever"
    streams = on.need("imu", "vicon", fix="choose a flight with an imu, and leica or vicon")
    vicon = streams["vicon"]
    turns = Series(vicon.time, Attitude(attitude=vicon["attitude"]), name="attitude", gaps=vicon.gaps)
    return {"imu": streams["imu"], "position": positions(vicon), "attitude": turns}, "vicon_lever"
