"""The 15-state error-state Kalman filter of inertial navigation, aided by position and attitude.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs. 5-7.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Case, Series, Stream, clocks_of, collect, delay, graph, latest, simulate
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, tilt_and_heading
from flowgraph.blocks.inertial.aiding import aid_attitude, aid_position
from flowgraph.blocks.inertial.alignment import StartSpread, belief_at_start, start_belief
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, predict
from flowgraph.blocks.kalman.backward import collect_steps
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.inertial_pose import inertial_crossing, inertial_steps, stacked
from flowgraph.blocks.models.recordings import inertial_recording
from flowgraph.blocks.scoring.cases import OnFlight, SmoothedPoseFilter, on_flight
from flowgraph.blocks.scoring.point import positions
from flowgraph.blocks.scoring.start import StartPose
from flowgraph.blocks.scoring.tuning import reading_of, with_imu
from flowgraph.blocks.signals import Attitude, Belief, Imu, Position

SEARCHED, LONGEST, HEADINGS = 15.0, 60.0, 12
"""For how many seconds a heading is sought of which nothing is known, for how many at most where these do not
tell it, and how many are tried."""

NEAR, APART = 0.15, 30.0
"""The deviation of the heading of one of them, rad, and how far apart two are that are not one, degrees. A
wider one corrects by more than it is off, and the best of twelve is then another's."""

FINER, BESIDE = 4, (-3, -2, -1, 0, 1, 2, 3)
"""A finer step is such a part of that between two of them; where beside the best is tried, in finer steps."""

SURE = 40.0
"""By how much the best must foretell better than others, in -2 log of the likelihood."""

MOVED = 0.1
"""m: a body that has not come so far from where it was shows no heading."""


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
    robust: Robust | None = None,
    adaptive: float | None = None,
    smoothing: bool = False,
):
    """15-state error-state Kalman filter: every tick predicts to now; a tick with a measurement also updates.

    State: position, velocity, attitude, gyroscope and accelerometer bias. The error is local: a right (body)
    rotation vector. Collected: `belief` at every tick, and the innovation of each aid where there was one;
    with `smoothing` what a smoother needs too.
    """
    ticks = imu | position if attitude is None else imu | position | attitude
    belief = delay(start, name="belief")
    control = latest(imu, init=Imu.at_rest(gravity), name="control")
    prior = predict(belief, control, noise=noise, gravity=gravity, at=ticks)
    prior = bridged(belief, prior, imu, held=held, position=0, velocity=3, attitude=6)
    if smoothing:
        drive = latest(imu, init=Imu.at_rest(gravity), at=ticks, name="drive")
        collect_steps(belief, prior, drive, crossing=inertial_crossing, held=held)
    scale = scale_of(adaptive, "position")
    posterior, innovation = aid_position(
        prior,
        position,
        noise=position_noise,
        lever=lever,
        gate=gate,
        robust=robust,
        scale=scale,
        invariant=invariant,
    )
    collect(innovation, "position_innovation")
    feed_scale(scale, innovation, adaptive, "position")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=9, attitude=6, shown=False)
    if attitude is not None:
        scale = scale_of(adaptive, "attitude")
        posterior, turn = aid_attitude(
            posterior, attitude, scale, noise=attitude_noise, gate=gate, robust=robust, invariant=invariant
        )
        feed_scale(scale, turn, adaptive, "attitude")
        collect(turn, "attitude_innovation")
        if gate is not None:
            posterior = find_back(
                posterior, turn, patience=patience, moving=(6, 9), attitude=6, name="find_back_attitude"
            )
    belief.feed(posterior)
    return {"belief": posterior}


@on_flight(ins_eskf, told=with_imu)
def for_flight(on: OnFlight, *, filter: SmoothedPoseFilter) -> Case:
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
    attitude = inputs.get("attitude")
    begin = filter.pose(on, inputs, position=inputs["position"], attitude=attitude)
    inputs, info = begin.inputs, on.flight.info
    settings = {
        "noise": filter.imu_noise(on, (1.0, 1.0) if "position_noise" in info else (15.0, 20.0)),
        **filter.measured(on),
        "lever": info.get(lever, (0.0, 0.0, 0.0)),
        "gravity": on.gravity,
        "held": filter.held(on, inputs["imu"], inputs),
        **filter.gating(),
    }
    force = None if on.weightless else on.first_up("imu", inputs["imu"]["specific_force"])
    guess = Guess(begin.attitude) if begin.heading is None else Guess(begin.attitude, begin.heading, True)
    if attitude is None and (guess.invariant or filter.start_heading is not None):
        guess = _searched(on, inputs, begin, guess, force, settings)
    start = guess.belief(begin.position, force)
    known = {name: value for name, value in settings.items() if name not in filter.gating()}
    recording = inertial_recording(inputs, start=stacked(start), reading=reading_of(on.flight), **known)

    def begun(first: Callable[[str], Any], at: Stream[Any]) -> dict[str, Stream[Any]]:
        return {"belief": belief_at_start(first("truth"), first("imu"), levelled=force is not None, at=at)}

    return on.case(
        filter.score(on, pose_errors, steps=inertial_steps, recording=recording),
        inputs=inputs,
        begin=begun if begin.told else None,
        start=start,
        invariant=guess.invariant,
        smoothing=filter.smoothed,
        **settings,
    )


class Guess(NamedTuple):
    """An attitude (4) to start from, the deviation of its heading in rad, and whether corrections are
    invariant, since it is large."""

    attitude: np.ndarray
    heading: float = StartSpread().heading
    invariant: bool = False

    def belief(self, position: np.ndarray, force: np.ndarray | None) -> Belief:
        """That to start from, levelled by a force."""
        spread = StartSpread(heading=self.heading)
        return start_belief(position, self.attitude, specific_force=force, spread=spread)


def _searched(
    on: OnFlight,
    inputs: dict[str, Series],
    begin: StartPose,
    guess: Guess,
    force: np.ndarray | None,
    settings: dict[str, Any],
) -> Guess:
    """That of a circle of guesses with which the filter best foretells the first measurements; the guess
    itself, where it foretells them as well, or where they do not tell one heading from another.

    One Gaussian cannot hold a whole circle: from the wrong side of it the innovations look like errors of
    velocity and bias, and the filter grows sure of a wrong heading. One of `HEADINGS` is near enough to tell
    the side, and of finer steps beside it the best is taken. Nothing is told by a body that stays where it
    is, so the time of the search counts from when it has moved.
    """
    step = 2.0 * math.pi / HEADINGS
    circle = [Guess(_turned(begin.attitude, k * step), NEAR, True) for k in range(HEADINGS)]
    runs = circle if begin.unknown else [guess, *circle]
    since, end = _moved(inputs["position"], settings["position_noise"]), inputs["imu"].time[-1]
    seconds = SEARCHED
    while since is not None:
        until = since + round(seconds * 1e9)
        first = {name: series[series.time <= until] for name, series in inputs.items()}
        found = _foretold_all(runs, begin, force, first, settings)
        costs = np.array([cost for cost, _ in found])
        best = int(np.argmin(costs))
        ends = np.array([q for _, q in found])
        others = costs[np.abs(tilt_and_heading(ends, ends[best])[1]) > APART]
        if not len(others) or others.min() > costs[best] + SURE:
            if not begin.unknown and costs[0] <= costs[best] + SURE:
                return guess
            span = f"the first {(until - inputs['imu'].time[0]) * 1e-9:.3g} s of measurements"
            if begin.unknown:
                on.note("info", f"the heading at the start was sought in {span}")
            else:
                on.note("warning", f"{span} speak against the heading at the start: another was taken")
            near = [Guess(_turned(runs[best].attitude, k * step / FINER), NEAR / 2.0, True) for k in BESIDE]
            costs = np.array([cost for cost, _ in _foretold_all(near, begin, force, first, settings)])
            return near[int(np.argmin(costs))]
        if until >= end or seconds >= LONGEST:
            break
        seconds *= 2.0
    if begin.unknown:
        sentence = "it stays unknown, however sure the filter grows of it"
        on.note("warning", f"the measurements do not tell the heading at the start: {sentence}")
    return guess


def _turned(attitude: np.ndarray, heading: float) -> np.ndarray:
    turn = from_rotation_vector(np.array([0.0, 0.0, heading]), xp=np)
    return np.asarray(multiply(turn, attitude, xp=np))


def _foretold_all(
    runs: Sequence[Guess],
    begin: StartPose,
    force: np.ndarray | None,
    inputs: dict[str, Series],
    settings: dict[str, Any],
) -> list[tuple[float, np.ndarray]]:
    return [_foretold(run.belief(begin.position, force), run.invariant, inputs, settings) for run in runs]


def _foretold(
    start: Belief, invariant: bool, inputs: dict[str, Series], settings: dict[str, Any]
) -> tuple[float, np.ndarray]:
    """How badly a start foretells what was measured, -2 log of its likelihood, and the attitude (4) that it
    comes to."""
    settings = {**settings, "gate": None, "invariant": invariant}
    result = simulate(ins_eskf.build(**clocks_of(inputs), start=start, **settings), inputs)
    seen = [result[name] for name in result.series if name.endswith("innovation")]
    cost = sum(float(np.sum(s["nis"] + np.linalg.slogdet(s["covariance"])[1])) for s in seen)
    return cost if math.isfinite(cost) else math.inf, result["belief"]["attitude"][-1]


def _moved(position: Series, noise: float) -> int | None:
    """When (ns) the body had left the place where it was first seen; None where it stays."""
    place = position["position"]
    here = place[int(np.argmax(np.isfinite(place).all(axis=-1)))]
    away = np.linalg.norm(place - here, axis=-1) > max(MOVED, 6.0 * noise)
    return int(position.time[int(np.argmax(away))]) if away.any() else None


def _inputs(on: OnFlight) -> tuple[dict[str, Series], str]:
    """The flight's imu, position and, from a motion capture, attitude; and the name of the lever."""
    if "leica" in on.flight.streams:
        streams = on.need("imu", "leica")
        return {"imu": streams["imu"], "position": streams["leica"]}, "leica_lever"
    streams = on.need("imu", "vicon", fix="choose a flight with an imu, and leica or vicon")
    vicon = streams["vicon"]
    turns = vicon.holding(Attitude(attitude=vicon["attitude"]), "attitude")
    return {"imu": streams["imu"], "position": positions(vicon), "attitude": turns}, "vicon_lever"
