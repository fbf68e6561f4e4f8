"""The 15-state error-state Kalman filter of inertial navigation, aided by position and attitude.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-7.
"""

from __future__ import annotations

from flowgraph import Case, Series, Stream, collect, delay, graph, latest
from flowgraph.blocks.inertial.aiding import aid_attitude, aid_position
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, predict
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridge, find_back
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.scoring.cases import OnFlight, PoseFilter, on_flight
from flowgraph.blocks.scoring.point import positions
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
    control = latest(imu, init=Imu.at_rest(), name="control")
    prior = predict(belief, control, noise=noise, gravity=gravity, at=ticks)
    if held is not None:
        prior = bridge(prior, imu, held=held, position=0, velocity=3, attitude=6)
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
    spread = StartSpread() if begin.heading is None else StartSpread(heading=begin.heading)
    force = on.first_up("imu", imu["specific_force"])
    return on.case(
        filter.score(on, pose_errors),
        inputs=inputs,
        start=start_belief(begin.position, begin.attitude, specific_force=force, spread=spread),
        noise=filter.imu_noise(on, (1.0, 1.0) if "position_noise" in info else (15.0, 20.0)),
        **filter.measured(on),
        lever=info.get(lever, (0.0, 0.0, 0.0)),
        held=filter.held(on, imu),
        invariant=begin.heading is not None,
        **filter.gating(),
    )


def _inputs(on: OnFlight) -> tuple[dict[str, Series], str]:
    """The flight's imu, position and, from a motion capture, attitude; and the name of the lever."""
    if "leica" in on.flight.streams:
        streams = on.need("imu", "leica")
        return {"imu": streams["imu"], "position": streams["leica"]}, "leica_lever"
    streams = on.need("imu", "vicon", fix="choose a flight with an imu, and leica or vicon")
    vicon = streams["vicon"]
    turns = Series(vicon.time, Attitude(attitude=vicon["attitude"]), name="attitude")
    return {"imu": streams["imu"], "position": positions(vicon), "attitude": turns}, "vicon_lever"
