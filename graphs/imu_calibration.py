"""Calibration of raw inertial counts against a motion capture, by least squares as the data come.

    window    c = mean counts,  w = log(R_0^T R_1) / dt,  f = R_m^T (0, 0, g)      every motion capture
    collect   A^T A += [c, 1] [c, 1]^T,  A^T y += [c, 1] y^T
    solve     beta = (A^T A)^-1 A^T y

The rate is the body's, log(R_0^T R_1), which is what a gyroscope reads; log(R_1 R_0^T) would be the world's.
A window of several samples, because the stamps of both sides jitter. The equations stand in
`blocks/inertial/imu_calibration.py`.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

import numpy as np

from flowgraph import Case, DataError, Series, Stream, delay, graph, latest
from flowgraph.blocks.inertial.imu_calibration import (
    SAMPLES,
    CountsCalibration,
    collect_equations,
    solve_equations,
    sum_counts,
    window_means,
    windows_of,
)
from flowgraph.blocks.scoring.calibration import calibration_fit
from flowgraph.blocks.scoring.cases import OnFlight, on_flight
from flowgraph.blocks.scoring.settings import Positive, positive
from flowgraph.blocks.signals import Attitude, ImuCounts, NormalEquations

_NOTHING = NormalEquations(
    gyro_square=np.zeros((4, 4)),
    gyro_right=np.zeros((4, 3)),
    force_square=np.zeros((4, 4)),
    force_right=np.zeros((4, 3)),
    used=np.zeros(2),
)


@graph
def imu_calibration(
    counts: Stream[ImuCounts],
    vicon: Stream[Attitude],
    *,
    samples: int = SAMPLES,
    prior: CountsCalibration | None = None,
    gate: tuple[float, float] | None = None,
):
    """What a count of an inertial unit is worth, by a motion capture.

    `prior` and `gate` (rad/s, m/s^2) leave out windows that do not fit. Collected at every motion capture:
    `gyro` and `force`, beta (4, 3) of each, once there are enough windows; `equations`; and each `window`.
    """
    sums = sum_counts(counts, vicon, name="sums")
    window = window_means(latest(sums, at=vicon), vicon, samples=samples, name="window")
    so_far = delay(_NOTHING, name="so_far")
    equations = collect_equations(so_far, window, prior=prior, gate=gate, at=vicon, name="collect")
    so_far.feed(equations)
    gyro, force = solve_equations(equations, name="solve")
    return {"gyro": gyro, "force": force, "equations": equations, "window": window}


_UNSMOOTHED = "what it finds stays the same all along, so its last belief is the smoothed one already"


@on_flight(imu_calibration, "counts", measured=None, ranged=False, unsmoothed=_UNSMOOTHED)
def for_flight(
    on: OnFlight,
    *,
    samples: Annotated[int, positive] = SAMPLES,
    gate_rate: Positive = 0.2,
    gate_force: Positive = 1.0,
    gated: bool = True,
) -> Case:
    """Calibrate the flight's unit by its truth; the score is `calibration_fit`.

    Args:
        flight: with the stream `counts` (ImuCounts), a truth with `attitude`, and in info perhaps
            `calibration`, by which windows are judged.
        samples: motion capture samples on either side of a window's middle.
        gate_rate, gate_force: rad/s and m/s^2, the most by which a window may differ from that calibration.
        gated: whether windows are judged at all.

    Raises:
        DataError: where the flight lacks counts or a truth. DeclarationError: for a setting out of range.
    """
    flight, counts, gates = on.flight, on.inputs["counts"], (gate_rate, gate_force)
    if flight.truth is None:
        raise DataError(
            "this flight lacks what imu_calibration needs",
            path=flight.name,
            expected="a truth with attitudes",
            got="no truth",
            fix="choose a recording with a motion capture",
        )
    seen = flight.truth[np.isfinite(flight.truth["attitude"]).all(axis=1)]
    vicon = Series(seen.time, Attitude(attitude=seen["attitude"]), name="vicon")
    prior = flight.info.get("calibration") if gated else None
    both = np.concatenate([counts["gyro"], counts["force"]], axis=1)
    windows = windows_of(counts.time, both, seen.time, seen["attitude"], samples=samples)
    return on.case(
        partial(calibration_fit, windows=windows, prior=prior, gates=gates, path=flight.name),
        inputs={"counts": counts, "vicon": vicon},
        estimate="window",
        samples=samples,
        prior=prior,
        gate=gates if prior is not None else None,
    )
