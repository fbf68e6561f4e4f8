"""The tick that the Kalman filters of fifteen numbers with Euler angles share, whatever predicts.

The belief of the tick before is predicted to now with what the IMU says of the step, made less sure where
the reading is old, corrected where there is a measurement, and doubted where a
gate has refused a run of them. What differs is handed in: `ins_ekf_pose`, `ins_ukf_pose` and
`ins_ukf_velocity` are their predictions, their corrections, and this.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flowgraph import collect, delay, latest
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.kalman.backward import Crossing, collect_steps
from flowgraph.blocks.kalman.learned import feed_scale, scale_of
from flowgraph.blocks.kalman.lost import Held, bridged, find_back
from flowgraph.blocks.models.euler_ins import euler_angles, navigation_belief
from flowgraph.blocks.models.pose import driving
from flowgraph.blocks.signals import Gaussian, Imu

__all__ = ["euler_loop"]


def euler_loop(
    imu: Any,
    measured: Any,
    *,
    start: Gaussian,
    order: str,
    reading: str,
    predict: Callable[[Any, Any], Any],
    update: Callable[[Any, Any, Any], Any],
    gate: float | None,
    patience: int,
    adaptive: float | None,
    held: Held | None,
    gravity: tuple[float, float, float] = GRAVITY,
    crossing: Crossing | None = None,
) -> dict[str, Any]:
    """Wire the loop, and name what a graph collects: `belief`, `angles` and the `innovation`.

    Args:
        imu, measured: the sources.
        start: the belief over `euler_ins.STATE`.
        order: "zxy" or "zyx".
        reading: of the IMU, "instant" or "mean"; see `driving`.
        predict: `(belief, drive)`, the prior.
        update: `(prior, control, scale)`, the posterior and the innovation.
        gate, patience: whether `update` refuses measurements, and how many in a row are taken for outliers.
        adaptive: over about how many measurements the scale of their noise is learned; None: it is told.
        held: from which age on a reading is old.
        gravity: in the world, m/s^2, for what a unit at rest reads.
        crossing: of the prediction, where a smoother is to go back over the run; then what it needs is
            collected too.
    """
    belief = delay(start, name="belief")
    last = delay(Imu.at_rest(gravity), name="last_control")
    control = latest(imu, init=Imu.at_rest(gravity), at=imu | measured, name="control")
    drive = driving(last, control, reading)
    prior = predict(belief, drive)
    prior = bridged(belief, prior, imu, held=held, position=0, velocity=6, attitude=3)
    scale = scale_of(adaptive, "measured")
    posterior, innovation = update(prior, control, scale)
    feed_scale(scale, innovation, adaptive, "measured")
    if gate is not None:
        posterior = find_back(posterior, innovation, patience=patience, moving=9, attitude=3)
    belief.feed(posterior)
    last.feed(control)
    collect(innovation, "innovation")
    if crossing is not None:
        collect_steps(belief, prior, drive, crossing=crossing, held=held)
        collect(posterior, "posterior")
    return {
        "belief": navigation_belief(posterior, order=order),
        "angles": euler_angles(posterior, order=order),
    }
