"""The multiplicative extended Kalman filter of an attitude: commanded body rate, magnetic attitude.

No inertial unit is read. The vehicle turns as it is commanded, but for noise, and a magnetometer of the
thesis's kind reads the whole attitude, noisily:

    predict   q' = q * Exp(w dt)      P' = E P E^T + s_w^2 dt I      E = R(Exp(w dt))^T
    correct   r = Log(q^-1 z)         K = P (P + s_z^2 I)^-1         q' = q * Exp(K r)

State: a quaternion, with an error of three numbers in the body.

Sources: E. J. Lefferts, F. L. Markley, M. D. Shuster, "Kalman filtering for spacecraft attitude estimation",
1982; F. L. Markley, "Attitude error representations for Kalman filtering", 2003. The sensors are those of R.
Fiszel's thesis (2017), sections on control inputs and magnetometer. The equations stand in
`blocks/orientation/commanded.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import Case, Stream, collect, delay, graph, latest
from flowgraph.blocks.kalman.backward import collect_steps
from flowgraph.blocks.kalman.filters import update_extended
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import PATIENCE, Held, bridged, find_back
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.metrics.errors import attitude_errors
from flowgraph.blocks.orientation.commanded import (
    TURN,
    attitude_belief,
    attitude_vector,
    between_rates,
    predict_turn,
    see_attitude,
    start_turn,
    turn_crossing,
    turn_steps,
)
from flowgraph.blocks.orientation.recording import turn_recording
from flowgraph.blocks.scoring.cases import Adapted, HeldControl, OnFlight, Smoothed, on_flight
from flowgraph.blocks.scoring.settings import Positive
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.blocks.signals import Attitude, BodyRate, Gaussian

_STILL = BodyRate(rate=np.zeros(3))


@graph
def attitude_mekf(
    body_rate: Stream[BodyRate],
    magnetic_attitude: Stream[Attitude],
    *,
    start: Gaussian,
    rate_noise: float,
    attitude_noise: float,
    reading: str = "instant",
    gate: float | None = None,
    patience: int = PATIENCE,
    robust: Robust | None = None,
    adaptive: float | None = None,
    held: Held | None = None,
    smoothing: bool = False,
):
    """Multiplicative extended Kalman filter: commanded body rate, corrected by measured attitudes.

    `rate_noise` is a density, rad/s/sqrt(Hz); `attitude_noise` a deviation about each body axis, rad. A
    `reading` of the rate is of an "instant", and a step is driven by the mean of the two at its ends; or it
    is the "mean" over the time since the one before. Before the first, the vehicle is still.

    Collected: `belief` at every tick, and the `innovation` at every measured attitude; with `smoothing` what
    a smoother needs too.
    """
    belief = delay(start, name="belief")
    last = delay(_STILL, name="last_rate")
    rate = latest(body_rate, init=_STILL, at=body_rate | magnetic_attitude, name="rate")
    drive = rate if reading == "mean" else between_rates(last, rate)
    prior = predict_turn(belief, drive, noise=rate_noise, name="predict")
    prior = bridged(belief, prior, body_rate, held=held, attitude=0)
    if smoothing:
        collect_steps(belief, prior, drive, crossing=turn_crossing, held=held)
    scale = scale_of(adaptive, "attitude")
    posterior, innovation = update_extended(
        prior,
        magnetic_attitude.map(attitude_vector, name="measured"),
        observe=see_attitude,
        R=np.eye(3) * attitude_noise**2,
        space=TURN,
        measured_space=TURN,
        gate=gate,
        robust=robust,
        scale=scale,
        name="update",
    )
    feed_scale(scale, innovation, adaptive, "attitude")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=3, attitude=0)
    belief.feed(posterior)
    last.feed(rate)
    collect(innovation, "innovation")
    if smoothing:
        collect(posterior, "posterior")
    return {"belief": attitude_belief(posterior)}


_STREAMS = ("body_rate", "magnetic_attitude")
_FIX = f"simulated, with the sensors: --data sim:thesis --set sensors={','.join(_STREAMS)}"


@on_flight(attitude_mekf, *_STREAMS, fix=_FIX, ranged=False)
def for_flight(
    on: OnFlight,
    *,
    rate_noise: Positive | None = None,
    attitude_noise: Positive | None = None,
    control: HeldControl,
    gated: Adapted,
    scored: Smoothed,
) -> Case:
    """Start the filter on a flight with commanded body rates and measured attitudes, at the first of these.

    `sim:thesis` with sensors=body_rate,magnetic_attitude is such a flight. The start is the first measured
    attitude with a deviation of 1 rad, so that the first correction believes it.

    Args:
        flight: with the streams `body_rate` (BodyRate) and `magnetic_attitude` (Attitude).
        rate_noise, attitude_noise: standard deviations of one reading, rad/s and rad; the flight's own if
            left out.

    Raises:
        DataError: where a stream is missing, or nobody says its noise.
    """
    rate, seen = on.inputs.values()
    told = on.flight.info.get("noise", {})
    own = [told.get(name, {}).get("noise") for name in _STREAMS]
    step = float(np.median(np.diff(rate.time))) * 1e-9 if len(rate) > 1 else 1.0
    known: dict[str, Any] = {
        "start": start_turn(seen["attitude"][0]),
        "rate_noise": on.noise("rate_noise", rate_noise, own[0]) * math.sqrt(step),
        "attitude_noise": on.noise("attitude_noise", attitude_noise, own[1]),
        "reading": reading_of(on.flight, "body_rate"),
        "held": control.held(on, rate, on.inputs),
    }
    recording = turn_recording(on.inputs, **known)
    score = scored.score(on, attitude_errors, steps=turn_steps, recording=recording)
    return on.case(score, smoothing=scored.smoothed, **known, **gated.gating())
