"""Calibration of raw inertial counts against a motion capture, by least squares as the data come.

    window    c = mean counts,  w = log(R_0^T R_1) / dt,  f = R_m^T (0, 0, g)      every motion capture
    collect   A^T A += [c, 1] [c, 1]^T,  A^T y += [c, 1] y^T
    solve     beta = (A^T A)^-1 A^T y

The rate is the body's, log(R_0^T R_1), which is what a gyroscope reads; log(R_1 R_0^T) would be the world's.
A window of several samples, because the stamps of both sides jitter. The equations stand in
`blocks/inertial/imu_calibration.py`.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Case, DataError, Flight, Result, Series, Stream, clocks_of, delay, graph, latest
from flowgraph.blocks.inertial.imu_calibration import (
    LEAST,
    SAMPLES,
    CountsCalibration,
    collect_equations,
    solve_equations,
    sum_counts,
    window_means,
    windows_of,
)
from flowgraph.blocks.signals import Attitude, ImuCounts, NormalEquations
from flowgraph.language.checks import need_numbers

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


@imu_calibration.on_flight
def for_flight(
    flight: Flight,
    *,
    samples: int = SAMPLES,
    gate_rate: float = 0.2,
    gate_force: float = 1.0,
    gated: bool = True,
) -> Case:
    """Calibrate the flight's unit by its truth.

    Args:
        flight: with the stream `counts` (ImuCounts), a truth with `attitude`, and in info perhaps
            `calibration`, by which windows are judged.
        samples: motion capture samples on either side of a window's middle.
        gate_rate, gate_force: rad/s and m/s^2, the most by which a window may differ from that calibration.
        gated: whether windows are judged at all.

    The score is over the windows that counted: `rate_r2` and `force_r2`, the part of the variance that is
    explained, on average over the axes; `rate_rms_rad_s` and `force_rms_m_s2`, of what is left.

    Raises:
        DataError: where the flight lacks counts or a truth. DeclarationError: for a setting out of range.
    """
    need_numbers(
        "imu_calibration", positive={"samples": samples, "gate_rate": gate_rate, "gate_force": gate_force}
    )
    inputs = flight.need("imu_calibration", "counts")
    if flight.truth is None:
        raise DataError(
            "this flight lacks what imu_calibration needs",
            path=flight.name,
            expected="a truth with attitudes",
            got="no truth",
            fix="choose a recording with a motion capture",
        )
    seen = flight.truth[np.isfinite(flight.truth["attitude"]).all(axis=1)]
    inputs["vicon"] = Series(seen.time, Attitude(attitude=seen["attitude"]), name="vicon")
    prior = flight.info.get("calibration") if gated else None
    built = imu_calibration.build(
        **clocks_of(inputs),
        samples=samples,
        prior=prior,
        gate=(gate_rate, gate_force) if prior is not None else None,
    )
    readings = np.concatenate([inputs["counts"]["gyro"], inputs["counts"]["force"]], axis=1)
    windows = windows_of(inputs["counts"].time, readings, seen.time, seen["attitude"], samples=samples)

    def score(result: Result) -> dict[str, float]:
        found: dict[str, float] = {}
        if not len(result["gyro"]) or not len(result["force"]):
            raise DataError(
                "too few windows count for a calibration",
                path=flight.name,
                expected=f"at least {LEAST} of rate and of force",
                got=f"{len(windows.counts)} windows",
                fix="choose a longer recording, or larger gates",
            )
        for k, (name, y, gate) in enumerate(
            (("rate", windows.rate, gate_rate), ("force", windows.force, gate_force))
        ):
            x = windows.counts[:, 3 * k : 3 * k + 3]
            kept = np.ones(len(x), dtype=bool)
            if prior is not None:
                scale = np.array(prior.gyro if k == 0 else prior.force)
                constant = np.array(prior.gyro_constant if k == 0 else prior.force_constant)
                kept = np.linalg.norm(y - x @ scale.T - constant, axis=1) <= gate
            beta = result["gyro" if k == 0 else "force"]["value"][-1]
            off = (y - x @ beta[:3] - beta[3])[kept]
            found[f"{name}_r2"] = float(np.mean(1.0 - off.var(axis=0) / y[kept].var(axis=0)))
            found["rate_rms_rad_s" if k == 0 else "force_rms_m_s2"] = float(np.sqrt(np.mean(off**2)))
        used = result["equations"]["used"][-1]
        return {**found, "rate_windows": float(used[0]), "force_windows": float(used[1])}

    return Case(built, inputs, score, estimate="window")
