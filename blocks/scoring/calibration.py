"""How well a calibration explains the windows that it was made of."""

from __future__ import annotations

import numpy as np

from flowgraph import DataError, Result
from flowgraph.blocks.inertial.imu_calibration import LEAST, CountsCalibration
from flowgraph.blocks.signals import Window

__all__ = ["calibration_fit"]


def calibration_fit(
    result: Result,
    windows: Window,
    *,
    prior: CountsCalibration | None,
    gates: tuple[float, float],
    path: str,
) -> dict[str, float]:
    """The fit of a run of `imu_calibration`, over the windows that counted.

    Args:
        windows: all that there were.
        prior: the calibration by which they are judged, none where they are not.
        gates: rad/s and m/s^2, the most by which a window may differ from it.
        path: the flight's name, for messages.

    Returns:
        `rate_r2` and `force_r2`, the part of the variance that is explained, on average over the axes;
        `rate_rms_rad_s` and `force_rms_m_s2`, of what is left; `rate_windows` and `force_windows`, how many.

    Raises:
        DataError: where too few counted.
    """
    if not len(result["gyro"]) or not len(result["force"]):
        raise DataError(
            "too few windows count for a calibration",
            path=path,
            expected=f"at least {LEAST} of rate and of force",
            got=f"{len(windows.counts)} windows",
            fix="choose a longer recording, or larger gates",
        )
    found: dict[str, float] = {}
    for k, (name, y) in enumerate((("rate", windows.rate), ("force", windows.force))):
        x = windows.counts[:, 3 * k : 3 * k + 3]
        kept = np.ones(len(x), dtype=bool)
        if prior is not None:
            scale = np.array(prior.gyro if k == 0 else prior.force)
            constant = np.array(prior.gyro_constant if k == 0 else prior.force_constant)
            kept = np.linalg.norm(y - x @ scale.T - constant, axis=1) <= gates[k]
        beta = result["gyro" if k == 0 else "force"]["value"][-1]
        off = (y - x @ beta[:3] - beta[3])[kept]
        found[f"{name}_r2"] = float(np.mean(1.0 - off.var(axis=0) / y[kept].var(axis=0)))
        found["rate_rms_rad_s" if k == 0 else "force_rms_m_s2"] = float(np.sqrt(np.mean(off**2)))
    used = result["equations"]["used"][-1]
    return {**found, "rate_windows": float(used[0]), "force_windows": float(used[1])}
