"""rbpf_outdoor: a Rao-Blackwellized particle filter on six sensors, each whenever it comes.

The attitude is sampled; given it, velocity, position and what the gyroscope's noise has turned since the
attitude was last drawn have a Kalman filter of their own. Two GPS receivers, an altimeter, a magnetometer and
optical flow are each a Kalman update of each particle, and weigh it. The attitude is drawn when optical flow
takes a picture, from what all readings since the last picture have left of it. No sensor waits for another.

Source: R. Fiszel's thesis on reactive pose estimation, Stanford 2017, section on the asynchronous
Rao-Blackwellized particle filter. Mended: the attitude is drawn after the readings, not before them (drawn at
every step, a thousand particles are too few for a sharp magnetometer); the altimeter reads p_z / cos(tilt)
(the thesis prints a sine), and optical flow q_0^-1 q_1, with the displacement in the body (the thesis: q_0
q_1, in the world). The equations stand in `blocks/outdoor/cloud.py` and
`blocks/outdoor/corrections.py`.
"""

from __future__ import annotations

import functools
import operator

from flowgraph import Case, Stream, collect, delay, graph, latest, merge
from flowgraph.blocks.kalman.lost import PATIENCE, Held, stay
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.models.pose import driving
from flowgraph.blocks.models.spread import spread_outdoor
from flowgraph.blocks.outdoor.cloud import (
    as_cloud,
    cloud_biases,
    outdoor_belief,
    predict_outdoor,
    start_outdoor_cloud,
    take_outdoor_ancestors,
    take_picture,
)
from flowgraph.blocks.outdoor.corrections import (
    correct_distance,
    correct_field,
    correct_flow,
    correct_position,
)
from flowgraph.blocks.outdoor.flight import OutdoorSensors
from flowgraph.blocks.outdoor.layout import particle_layout
from flowgraph.blocks.particles.cloud import average_attitude, average_pose, effective_sample_size, weights
from flowgraph.blocks.particles.lost import depletion
from flowgraph.blocks.particles.resampling import draw_ancestors
from flowgraph.blocks.scoring.cases import Gated, HeldControl, OnFlight, Particles, Scored, on_flight
from flowgraph.blocks.scoring.outdoor_start import StartedOutdoor
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.blocks.signals import Cloud, Imu, MagneticField, OpticalFlow, OutdoorCloud, Position, Range


@graph
def average(cloud: Stream[OutdoorCloud], plain: Stream[Cloud]):
    """The weighted expectation of the pose, and its covariance; and of the weights themselves."""
    weight = weights(plain)
    pose = average_pose(plain, weight, average_attitude(plain, weight, name="attitude"), name="pose")
    return pose, outdoor_belief(cloud, plain, weight, pose, name="spread"), weight


@graph
def rbpf_outdoor(
    imu: Stream[Imu],
    gps: Stream[Position] | None = None,
    gps2: Stream[Position] | None = None,
    altimeter: Stream[Range] | None = None,
    magnetometer: Stream[MagneticField] | None = None,
    optical_flow: Stream[OpticalFlow] | None = None,
    *,
    start: OutdoorCloud,
    sensors: OutdoorSensors,
    reading: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    resample_below: float = 0.5,
    scheme: str = "systematic",
    draws: str = "rbpf_outdoor",
    held: Held | None = None,
):
    """Rao-Blackwellized particle filter of pose and velocity on asynchronous sensors.

    Every tick predicts to now, and then fuses each reading there is; where there is one, the cloud is
    resampled if its weights have become too uneven; where a picture is taken, each attitude is then drawn.
    Of the sensors any are there; without optical flow the attitudes are drawn with the first of the others.
    A `reading` of the IMU is of an "instant", or the "mean" over the time since the one before (`driving`).
    With a gate, a reading that is too far from the cloud is refused; after `patience` readings of one sensor
    in a row the particles become as unsure as the reading was far, and believe it.
    Collected: `pose` and `belief`, with its covariance, at every tick, averaged before resampling; the
    innovation of each sensor where there was a reading; `effective_sample_size`, `depleted` and `ancestors`
    at every tick with a reading. With a `start` that has them (`start_outdoor_cloud`) the biases of the IMU
    are estimated, and collected as `biases` at every tick.
    """
    s = sensors
    cloud = delay(start, name="cloud")
    last = delay(Imu.at_rest(), name="last_control")
    aids = [aid for aid in (optical_flow, gps, gps2, altimeter, magnetometer) if aid is not None]
    seen = functools.reduce(operator.or_, aids)
    control = latest(imu, init=Imu.at_rest(), at=imu | seen, name="control")
    now = predict_outdoor(cloud, driving(last, control, reading), noise=s.imu, name="predict")
    if held is not None:
        now = now if held.longest is None else stay(cloud, now, longest=held.longest)
        now = spread_outdoor(now, imu, held=held)
    gated = {"gate": gate, "patience": patience}
    for name, place, lever in (("gps", gps, s.gps_lever), ("gps2", gps2, s.gps2_lever)):
        if place is not None:
            now, told = correct_position(
                now, place, noise=s.noise(name), lever=lever, **gated, name=f"fuse_{name}"
            )
            collect(told, f"{name}_innovation")
    if altimeter is not None:
        noise = s.noise("altimeter")
        now, told = correct_distance(now, altimeter, noise=noise, **gated, name="fuse_altimeter")
        collect(told, "altimeter_innovation")
    if magnetometer is not None:
        noise = s.noise("magnetometer")
        now, told = correct_field(now, magnetometer, earth=s.field, noise=noise, **gated, name="fuse_field")
        collect(told, "magnetometer_innovation")
    if optical_flow is not None:
        moved, turned = s.noise("displacement"), s.noise("turn")
        now, told = correct_flow(
            now, optical_flow, displacement=moved, turn=turned, **gated, name="fuse_flow"
        )
        collect(told, "optical_flow_innovation")

    plain = as_cloud(now, name="plain")
    size = effective_sample_size(plain, at=seen, name="size")
    ancestors = draw_ancestors(
        plain, size, below=resample_below, scheme=scheme, draws=f"{draws}.resample", at=seen, name="ancestors"
    )
    fresh = take_outdoor_ancestors(now, ancestors, at=seen, name="resample")
    fresh = take_picture(fresh, aids[0], draws=f"{draws}.attitude", name="picture")
    last.feed(control)
    cloud.feed(merge(fresh, now, tie="left", name="next"))
    pose, belief, weight = average(now, plain)
    collect(belief, "belief")
    if particle_layout(start.covariance).biased:
        collect(cloud_biases(now, weight, name="biases"), "biases")
    collect(depletion(size, numbers=3), "depleted")
    return {"pose": pose, "effective_sample_size": size, "ancestors": ancestors}


_UNSMOOTHED = (
    "each particle has a Kalman filter of its own, and particles that are resampled take their past with them"
)


@on_flight(rbpf_outdoor, unsmoothed=_UNSMOOTHED)
def for_flight(
    on: OnFlight,
    *,
    cloud: Particles,
    gated: Gated,
    control: HeldControl,
    started: StartedOutdoor,
    scored: Scored,
) -> Case:
    """Start the filter on an outdoor flight, at rest, and at its first readings if nothing else is set.

    Args:
        flight: with the streams and the knowledge that `outdoor_flight` asks for, such as that of
            `sim:thesis` with sensors=imu,gps,gps2,altimeter,magnetometer,optical_flow.

    Raises:
        DataError: where the flight lacks a stream, or optical flow has a gap.
        DeclarationError: for a setting that is out of range.
        UnknownNameError: for a scheme that is not there.
    """
    inputs, sensors, first = started.begin(on)
    return on.case(
        scored.score(on, pose_errors, estimate="belief"),
        inputs=inputs,
        start=start_outdoor_cloud(cloud.particles, first, seed=cloud.seed, biases=started.estimates(on)),
        sensors=sensors,
        held=control.held(on, inputs["imu"], inputs),
        reading=reading_of(on.flight),
        **gated.gating(),
        **cloud.resampling(),
    )
