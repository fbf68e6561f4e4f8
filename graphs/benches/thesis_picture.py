"""The picture of `bench thesis`: bars of the errors with their intervals and bounds, beside the thesis's own.

A smoothed filter stands beside the filters; the dashed line is the bound of these.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["draw"]


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Bars of the errors with their intervals and the bound, and the thesis's metric beside its figures."""
    from matplotlib.figure import Figure  # slow to import, and only a picture needs it

    codes, names = (list(dict.fromkeys(row[key] for row in rows)) for key in ("setting", "filter"))
    figure = Figure(figsize=(13, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    panels = (
        ("position_rmse_m", None, "position RMSE [m]"),
        ("attitude_rmse_deg", None, "attitude RMSE [deg]"),
        ("thesis_metric_position", "thesis_position", "mean squared position error [m²]"),
        ("thesis_metric_attitude", "thesis_attitude", "mean of |R − R_true|⁴ (Frobenius)"),
    )
    width = 0.8 / len(names)
    for ax, (key, published, label) in zip(axes.flat, panels, strict=True):
        for n, name in enumerate(names):
            mine = [row for row in rows if row["filter"] == name]
            at = (
                np.array([codes.index(row["setting"]) for row in mine]) + (n - 0.5 * (len(names) - 1)) * width
            )
            values = np.array([row[key] for row in mine])
            ax.bar(at, values, width * 0.95, label=name)
            if key == "position_rmse_m":
                ends = [[row["position_rmse_low_m"], row["position_rmse_high_m"]] for row in mine]
                ax.errorbar(at, values, np.abs(np.array(ends).T - values), fmt="none", ecolor="0.2", lw=1)
            if published:
                seen = [np.nan if row[published] is None else row[published] for row in mine]
                ax.plot(at, seen, "k_", ms=9, mew=2, label="thesis's figure" if n == 0 else None)
                ax.set_yscale("log")
        if key.endswith(("rmse_m", "rmse_deg")):
            for n, code in enumerate(codes):
                least = next(row[f"bound_{key}"] for row in rows if row["setting"] == code)
                ax.hlines(least, n - 0.45, n + 0.45, "k", "--", lw=1, label="bound" if n == 0 else None)
        ax.set_xticks(range(len(codes)), codes)
        ax.set_ylabel(label)
        ax.grid(axis="y", alpha=0.3)
        ax.legend(fontsize=8, ncols=2)
    figure.suptitle("Five filters on the thesis's flights (motion capture, accelerometer, gyroscope)")
    figure.savefig(path, dpi=110)
