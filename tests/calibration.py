"""A lever and a mount that were put in, sought on many simulated flights: `python -m tests.calibration`.

Each flight is written to a table as a motion capture would have recorded it, whose markers sit away from the
inertial unit and are turned against it. Printed is, a seed, how many of its own deviations each of the six
numbers is off, and over all their root mean square, which is 1 where the deviations are honest.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flowgraph import Series, load_flight, write_table
from flowgraph.blocks.geometry.rotations import multiply, rotate
from flowgraph.blocks.signals import Pose
from flowgraph.study.calibrate import calibrate
from flowgraph.study.tune import Fit, Recording

LEVER = np.array([0.10, -0.05, 0.07])
MOUNT = np.array([3.0, -2.0, 5.0])
"""m; rotation vector, degrees."""


def recorded(folder: Path, seed: int, duration: float) -> tuple[str, dict[str, float | str]]:
    """The SPEC of a table of a simulated flight, and its settings."""
    made = {"duration": duration, "imu.rate": 100.0, "vicon.rate": 20.0}
    flight = load_flight("sim", seed=seed, settings={n: str(v) for n, v in made.items()})
    vicon = flight.streams["vicon"]
    q, p = vicon["attitude"], vicon["position"]
    x, y, z, w = Rotation.from_rotvec(MOUNT, degrees=True).as_quat()
    moved = Pose(
        position=p + np.asarray(rotate(q, np.broadcast_to(LEVER, p.shape), xp=np)),
        attitude=np.asarray(multiply(q, np.broadcast_to([w, x, y, z], q.shape), xp=np)),
    )
    streams = {"imu": flight.streams["imu"], "vicon": Series(vicon.time, moved, name="vicon")}
    file = folder / f"flight_{seed}.csv"
    write_table(replace(flight, streams=streams, truth=None), file)
    noise = flight.info["imu_noise"]
    columns = {
        f"{stream}.{field}": ",".join(f"{stream}.{field}.{k}" for k in axes)
        for stream, field, axes in (
            ("imu", "gyro", "xyz"), ("imu", "specific_force", "xyz"), ("vicon", "position", "xyz"),
            ("vicon", "attitude", "wxyz"),
        )
    }  # fmt: skip
    densities = {
        "gyro.noise": noise.gyro, "accelerometer.noise": noise.accelerometer,
        "gyro.walk": noise.gyro_bias, "accelerometer.walk": noise.accelerometer_bias,
        "position.noise": flight.info["position_noise"], "attitude.noise": flight.info["attitude_noise"],
    }  # fmt: skip
    return f"csv:{file}", columns | densities


def off(seed: int, duration: float = 20.0, engine: str = "c") -> np.ndarray:
    """By how many of their own deviations the six numbers that are found are off (6)."""
    with tempfile.TemporaryDirectory() as folder:
        spec, settings = recorded(Path(folder), seed, duration)
        fits = [Fit("vicon.lever", -0.3, 0.3), Fit("vicon.mount", -10.0, 10.0)]
        found = calibrate("ins_eskf", fits, [Recording(spec)], settings=settings, engine=engine)
    apart = [
        (found.parameters[name] - true) / found.deviations[name]
        for name, true in (("vicon.lever", LEVER), ("vicon.mount", MOUNT))
    ]
    return np.concatenate(apart)


def main() -> None:
    parser = argparse.ArgumentParser(description="Calibration of a simulated lever and mount.")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--duration", type=float, default=20.0)
    chosen = parser.parse_args()
    rows = []
    for seed in range(chosen.seeds):
        rows.append(off(seed, chosen.duration))
        print(seed, " ".join(f"{x:6.2f}" for x in rows[-1]), flush=True)
    every = np.array(rows)
    print(f"largest {np.abs(every).max():.2f}, root mean square {np.sqrt(np.mean(every**2)):.2f}")


if __name__ == "__main__":
    main()
